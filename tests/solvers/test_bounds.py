"""Compares bounds and lookahead with brute force, and tests the figures that every run reports."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.decisions import worths
from tests.solvers.plain_values import plain_optimal_value
from xplain.errors import TooLargeError
from xplain.solvers.base import GIB
from xplain.solvers.bounds import bounds, known_type_value
from xplain.solvers.evaluate import evaluate
from xplain.solvers.greedy import QMDP
from xplain.solvers.hsvi import Effort
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.process import known_bytes
from xplain.testing.literal_pomdp import reduced_optimal_value
from xplain.testing.problems import random_problem


def test_bounds_and_prices_enclose_the_truth() -> None:
    rng = np.random.default_rng(30)
    for _ in range(100):
        problem = random_problem(rng)
        optimum = reduced_optimal_value(problem)
        found = bounds(problem)
        assert found.lower - 1e-9 <= optimum <= found.upper + 1e-9
        types, every = range(problem.n_types), problem.messages_with_effect
        each = [plain_optimal_value(problem, t, messages=every) for t in types]
        assert found.known_type == pytest.approx(float(problem.prior @ each), abs=1e-9)
        each = [plain_optimal_value(problem, t) for t in types]
        assert known_type_value(problem) == pytest.approx(float(problem.prior @ each), abs=1e-9)
        assert found.known_type >= optimum - 1e-9
        least, most = found.value_of_perfect_information
        assert least - 1e-9 <= found.known_type - optimum <= most + 1e-9
        value = evaluate(problem, QMDP().plan(problem)).value
        least, most = found.suboptimality(value)
        assert least - 1e-9 <= optimum - value <= most + 1e-9


def test_lookaheads_values_bound_the_optimum_and_tighten_that_by_known_types() -> None:
    """If messages do not discount, the best value, over all sets or over few, is at least the
    optimum and at most the value of known types."""
    rng = np.random.default_rng(31)
    tighter = 0
    for _ in range(200):
        problem = replace(random_problem(rng), discount_per="step")
        optimum = reduced_optimal_value(problem)
        policy = Lookahead().plan(problem)
        best = max(worths(policy, 0, 0, problem.prior).values())
        known = known_type_value(problem)
        assert optimum - 1e-9 <= best <= known + 1e-9
        tighter += best < known - 1e-6
        for narrow in (Lookahead(candidates=1), Lookahead(answers=1)):
            values = worths(narrow.plan(problem), 0, 0, problem.prior)
            assert max(values.values()) <= known + 1e-9
    assert tighter >= 20


def test_lookahead_is_optimal_where_the_type_is_certain() -> None:
    rng = np.random.default_rng(33)
    for _ in range(100):
        problem = random_problem(rng)
        t = int(rng.integers(problem.n_types))
        one = replace(problem, prior=np.eye(problem.n_types)[t])
        worth = evaluate(one, Lookahead().plan(one))
        assert worth.value == pytest.approx(plain_optimal_value(problem, t), abs=1e-9)


def test_bounds_are_simpler_where_memory_is_short() -> None:
    problem = random_problem(np.random.default_rng(5), max_types=3, max_steps=3, max_messages=2)
    enough = bounds(problem)
    little = bounds(problem, Effort(memory_gib=_between(problem)))
    assert little.lower <= enough.lower + 1e-9
    assert little.upper >= enough.upper - 1e-9
    assert little.known_type == pytest.approx(enough.known_type, abs=1e-9)
    with pytest.raises(TooLargeError):
        bounds(problem, Effort(memory_gib=1e-9))


def test_as_many_messages_as_masks_hold_are_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(34)
    wide = (random_problem(rng, max_steps=3, max_messages=2) for _ in range(200))
    problem = next(p for p in wide if _open(p))
    for most, searched in ((2, True), (1, False)):
        monkeypatch.setattr("xplain.solvers.process.MAX_RELEVANT", most)
        found = bounds(problem)
        assert (found.upper - found.lower <= 1e-3) == searched
        assert found.lower - 1e-9 <= reduced_optimal_value(problem) <= found.upper + 1e-9


def _open(problem) -> bool:
    """Both messages may be of use, and more than known types and plans is needed to see how
    much."""
    known = known_type_value(problem)
    optimum = reduced_optimal_value(problem)
    return len(problem.messages_with_effect) == 2 and known - optimum > 0.1


def _between(problem) -> float:
    """Returns a memory limit that is enough for the tables of known types, but not for those of the
    search."""
    return 1.1 * known_bytes(problem) / GIB
