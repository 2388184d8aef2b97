"""The bound by pairs of types against brute force and QMDP, alone and in the search."""

from __future__ import annotations

import numpy as np
import pytest

from xplain.explanation.literal_pomdp import reduced_optimal_value
from xplain.explanation.problem import Problem
from xplain.solvers.count_lattice import Branches, make_answers
from xplain.solvers.hsvi import explore as hsvi
from xplain.solvers.hsvi import pair_bounds
from xplain.solvers.hsvi.pair_bounds import SWEEPS, Pairs, PairTables, mix, mixed, with_own_room
from xplain.solvers.hsvi.solver import Certified, CertifiedPolicy
from xplain.solvers.model import model_of, optimal_values
from xplain.testing.problems import random_problem


def bounded(pairs: Pairs, table: np.ndarray, belief: np.ndarray, sweeps: int) -> float | None:
    """A table [rows, G] at the mixture for a belief at (0, ∅); None where the type is known."""
    if not mix.py_func(pairs, 0, 0, belief, sweeps):
        return None
    return float(mixed.py_func(pairs, table, 0))


def test_lies_between_the_optimum_and_qmdp() -> None:
    """Before any shift of weight, and after; shifts only tighten."""
    rng = np.random.default_rng(30)
    compared = 0
    for _ in range(300):
        problem = random_problem(rng, max_types=4)
        pairs = PairTables(problem).make()
        qmdp = float(problem.prior @ optimal_values(model_of(problem))[0, 0])
        first = bounded(pairs, pairs.optimal[0], problem.prior, 0)
        second = bounded(pairs, pairs.optimal[0], problem.prior, SWEEPS)
        if first is None or second is None:
            assert np.count_nonzero(problem.prior) == 1
            continue
        optimum = reduced_optimal_value(problem)
        assert optimum - 1e-9 <= second <= first + 1e-9
        assert first <= qmdp + 1e-9
        compared += second < qmdp - 1e-6
    assert compared > 20  # it is tighter often enough for the test to mean something


def test_explain_is_bounded_too() -> None:
    """Without messages, *explain* is all that there is."""
    rng = np.random.default_rng(31)
    for _ in range(100):
        problem = random_problem(rng, max_types=4, max_messages=0)
        pairs = PairTables(problem).make()
        bound = bounded(pairs, pairs.explain[0], problem.prior, SWEEPS)
        if bound is not None:
            assert bound == pytest.approx(reduced_optimal_value(problem), abs=1e-6)


def test_the_mixture_is_the_belief() -> None:
    """The pairs' shares add up to each type's weight, however small some are."""
    rng = np.random.default_rng(32)
    p = rng.random((5, 3, 4))
    pairs = PairTables(Problem(p, np.full(2, 0.1))).make()
    for _ in range(100):
        belief = rng.dirichlet(np.full(5, 0.2))
        belief[rng.integers(5)] = 0
        belief /= belief.sum()
        assert mix.py_func(pairs, 0, 0, belief, SWEEPS)
        assert pairs.share.sum(axis=1) == pytest.approx(belief, abs=1e-12)
        assert (pairs.share >= 0).all()


def test_a_search_that_makes_them_midway_stays_right(monkeypatch: pytest.MonkeyPatch) -> None:
    """At once, which long searches alone would do: bounds hold, and close to 1e-6."""
    monkeypatch.setattr(hsvi, "CHUNK", 1)
    monkeypatch.setattr(hsvi, "WORTH", 1e9)
    rng = np.random.default_rng(33)
    made = 0
    for _ in range(300):
        problem = random_problem(rng, max_types=4)
        optimum = reduced_optimal_value(problem)
        for gap in (1e-6, 0.1):
            policy = Certified(gap=gap).plan(problem)
            assert isinstance(policy, CertifiedPolicy)
            assert policy.upper - policy.lower <= gap
            assert policy.lower <= optimum + 1e-9
            assert policy.upper >= optimum - 1e-9
            made += policy.policy.found.tables.pairs.row.shape[1] > 0
    assert made > 20


def test_room_that_is_too_small_grows_and_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(44)
    problems = [random_problem(rng, max_types=3, max_steps=6, max_messages=1) for _ in range(40)]
    enough = [PairTables(problem).make() for problem in problems]
    capacities = []

    def little(capacity: int, steps: int, types: int) -> Branches:
        capacities.append(2 if capacity == 64 else capacity)
        return make_answers(capacities[-1], steps, types)

    monkeypatch.setattr(pair_bounds, "make_answers", little)
    for problem, pairs in zip(problems, enough, strict=True):
        found = PairTables(problem).make()
        np.testing.assert_array_equal(found.optimal, pairs.optimal)
        np.testing.assert_array_equal(found.explain, pairs.explain)
    assert {8, 32} <= set(capacities)


def test_searches_share_tables_and_no_room() -> None:
    """What a mixture writes to is a search's own: two searches may run at once."""
    pairs = PairTables(random_problem(np.random.default_rng(34), max_types=4)).make()
    assert pairs.share.size
    belief = np.full(len(pairs.share), 1 / len(pairs.share))
    mix.py_func(pairs, 0, 0, belief, SWEEPS)
    before = [table.copy() for table in pairs]
    other = np.eye(len(belief))[0] * 0.9 + 0.1 * belief
    assert mix.py_func(with_own_room(pairs), 0, 0, other, SWEEPS)
    for name, table, kept in zip(Pairs._fields, pairs, before, strict=True):
        np.testing.assert_array_equal(table, kept, name)
