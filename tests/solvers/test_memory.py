"""Too large tables are refused before they are allocated, and large ones are logged."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from xplain.errors import TooLargeError
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.solvers.base import GIB, check_memory
from xplain.solvers.greedy import QMDP


def test_what_fits_exactly_is_allowed_and_a_byte_more_is_not() -> None:
    check_memory("qmdp", GIB, 1.0, "fewer messages")
    with pytest.raises(TooLargeError, match=r"qmdp needs 1\.00 GiB.*fewer messages"):
        check_memory("qmdp", GIB + 1, 1.0, "fewer messages")


def test_planning_type_by_type_takes_what_the_types_take() -> None:
    """One message of 21 changes nothing; no table is over all sets of the 20 others."""
    types, steps, each = 10, 20, 3
    rng = np.random.default_rng(0)
    relevant = np.array([np.sort(rng.choice(20, each, replace=False)) for _ in range(types)])
    table = LabelTable.by_type(relevant, rng.random((types, steps, 1 << each)))
    problem = Problem(table, np.full(21, 0.01))
    tracemalloc.start()
    QMDP().plan(problem)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20e6  # bytes; a number for each set is 8e6 a step
