"""Random problems for hypothesis, which reports the seed of a failure."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.strategies import composite

from xplain.explanation.problem import Problem
from xplain.testing.problems import random_problem as random_problem


@composite
def tiny_problems(
    draw: st.DrawFn, max_types: int = 3, max_steps: int = 3, max_messages: int = 2
) -> Problem:
    """Problems of up to so many types, steps and messages."""
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    return random_problem(rng, max_types, max_steps, max_messages)
