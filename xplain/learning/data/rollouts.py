"""Traces of the robot: from a random start along an optimal policy (docs/method.md, section 2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xplain.domains.mdp import TaskModel


def sample_trace(
    model: TaskModel,
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
        max_length: the trace is cut here if it reaches no terminal state before.
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


def expected_visits(
    model: TaskModel,
    optimal: NDArray[np.bool_],
    starts: NDArray[np.int64],
    transitions: NDArray[np.int64],
    max_length: int,
) -> NDArray[np.float64]:
    """Expected number of times that a trace of :func:`sample_trace` makes each transition: [T].

    Args:
        model, optimal, starts, max_length: as for :func:`sample_trace`.
        transitions: [T, 3] all that a trace can make, each once.
    """
    before, action, after = transitions.T
    leads = model.successor[before, action] == after[:, None]
    share = (model.probability[before, action] * leads).sum(axis=1) / optimal[before].sum(axis=1)
    here: NDArray[np.float64] = np.bincount(starts, minlength=model.n_states) / len(starts)
    visits = np.zeros(len(transitions))
    for _ in range(max_length):
        made = here[before] * share
        visits += made
        here = np.bincount(after, made, model.n_states).astype(np.float64)
    return visits
