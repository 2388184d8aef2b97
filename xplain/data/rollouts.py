"""Traces: what the robot did, from a random start along an optimal policy
(docs/method.md, section 2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xplain.domains.mdp import Model


def sample_trace(
    model: Model,
    optimal: NDArray[np.bool_],
    starts: NDArray[np.int64],
    rng: np.random.Generator,
    max_length: int,
) -> NDArray[np.int64]:
    """One trace: [m, 3] transitions (s, a, s'), 1 ≤ m ≤ max_length.

    Args:
        model: the robot's.
        optimal: [S, A] its optimal actions; ties are broken at random.
        starts: states to start from, equally likely.
        rng: its stream.
        max_length: where the trace is cut if no terminal state comes first.
    """
    state = int(rng.choice(starts))
    steps: list[tuple[int, int, int]] = []
    while len(steps) < max_length and not model.terminal[state]:
        action = int(rng.choice(np.flatnonzero(optimal[state])))
        slot = rng.choice(model.probability.shape[2], p=model.probability[state, action])
        after = int(model.successor[state, action, slot])
        steps.append((state, action, after))
        state = after
    return np.array(steps, dtype=np.int64)
