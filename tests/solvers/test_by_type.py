"""Solvers answer alike whether a problem is kept by type or dense, where both fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import xplain.solvers.restriction as restriction
from tests.decisions import messages_given, worths
from tests.explanation.by_type_problems import pairs
from xplain.errors import TooLargeError
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.numba_kernels import lean_kernel
from xplain.solvers.base import Solver
from xplain.solvers.bounds import bounds, known_type_value
from xplain.solvers.evaluate import evaluate
from xplain.solvers.greedy import QMDP, Baseline, Conformant, KnownType
from xplain.solvers.hsvi.solver import Certified
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.model import explain_cost_at, model_of, optimal_values, take
from xplain.solvers.pomcp.rollout import leaf_value
from xplain.solvers.pomcp.search_model import model_of as search_model
from xplain.solvers.pomcp.solver import POMCP
from xplain.solvers.pomcp.tree import SearchRoot, Tree
from xplain.solvers.rows import rows_at
from xplain.solvers.simple import QHR

Both = tuple[Problem, Problem]


@pytest.fixture(scope="module", autouse=True)
def _by_type_however_small() -> Iterator[None]:
    """Problems with few messages worth giving are not made dense, as they usually are."""
    before, restriction.DENSE = restriction.DENSE, -1
    yield
    restriction.DENSE = before


@settings(deadline=None, max_examples=300)
@given(pairs())
def test_optimal_values_are_those_of_the_dense_table(both: Both) -> None:
    """At every (k, H) and for every type, also where messages are given to put off costs."""
    by_type, dense = map(model_of, both)
    mine, other = optimal_values(by_type), optimal_values(dense)
    sets = np.arange(1 << both[1].n_messages)
    for k in range(both[1].n_steps):
        assert take(by_type, mine[k], sets) == pytest.approx(take(dense, other[k], sets), abs=1e-9)
        costs = explain_cost_at(by_type, k, sets), explain_cost_at(dense, k, sets)
        assert costs[0] == pytest.approx(costs[1], abs=1e-12)


def assert_alike(solver: Solver, both: Both, sure: bool = False) -> None:
    """The same messages everywhere, and the same values of them."""
    policies = [solver.plan(problem, seed=3) for problem in both]
    rng = np.random.default_rng(0)
    types, n = both[1].n_types, both[1].n_messages
    for _ in range(8):
        belief = rng.dirichlet(np.ones(types))
        if sure:
            belief = np.eye(types)[rng.integers(types)]
        k, shown = int(rng.integers(both[1].n_steps)), int(rng.integers(1 << n))
        mine, other = (messages_given(policy, k, shown, belief) for policy in policies)
        assert mine == other
        values = [worths(policy, k, shown, belief) for policy in policies]
        for chosen in values[0].keys() & values[1].keys():
            assert values[0][chosen] == pytest.approx(values[1][chosen], abs=1e-9)


@settings(deadline=None, max_examples=150)
@given(pairs())
def test_qmdp_answers_alike(both: Both) -> None:
    assert_alike(QMDP(), both)


@settings(deadline=None, max_examples=50)
@given(pairs())
def test_known_types_are_answered_alike(both: Both) -> None:
    assert_alike(KnownType(), both, sure=True)
    assert known_type_value(both[0]) == pytest.approx(known_type_value(both[1]), abs=1e-9)


@settings(deadline=None, max_examples=40)
@given(pairs())
def test_solvers_that_weigh_all_messages_together_answer_alike(both: Both) -> None:
    for solver in (Baseline(), Conformant(), QHR(), Lookahead()):
        assert_alike(solver, both)


@settings(deadline=None, max_examples=25)
@given(pairs())
def test_pomcp_answers_alike(both: Both) -> None:
    """Simulation by simulation, as the random streams are the same: where no sum is rounded
    otherwise, which might make another of two equal actions the better one."""
    both = replace(both[0], discount_per="step"), replace(both[1], discount_per="step")
    assert_alike(POMCP(simulations=200), both)


@settings(deadline=None, max_examples=40)
@given(pairs())
def test_pomcp_answers_alike_where_the_type_is_certain(both: Both) -> None:
    assert_alike(POMCP(), both, sure=True)


@lean_kernel
def leaf(model, tree, step, given, belief):  # type: ignore[no-untyped-def]
    """What POMCP takes a leaf for."""
    return leaf_value(model, tree, step, given, belief)


@settings(deadline=None, max_examples=50)
@given(pairs())
def test_a_leaf_is_worth_what_qmdp_says(both: Both) -> None:
    model, n = search_model(both[0]), both[0].n_messages
    rng = np.random.default_rng(0)
    for shown in range(1 << n):
        belief, k = rng.dirichlet(np.ones(both[0].n_types)), int(rng.integers(both[0].n_steps))
        known = plain_qmdp_value(both[1], k, shown, belief)
        tree = Tree.rooted(1, n, both[0].n_steps, SearchRoot(k, shown, belief), 0)
        assert leaf(model, tree, k, shown, belief) == pytest.approx(known, abs=1e-9)


def plain_qmdp_value(problem: Problem, step: int, shown: int, belief: NDArray[np.float64]) -> float:
    """max_a Σ_t b(t) Q_t(k, H, a) from the dense tables of optimal values, over *explain* and the
    messages that some type should be given. (Any other would be worth giving, too, if it were true
    that the type becomes known after the next action.)"""
    model = model_of(problem)
    optimal = optimal_values(model)
    explain = model.discount * optimal[step + 1, shown] - explain_cost_at(model, step, shown)
    values = [float(belief @ explain)]
    for j, price in enumerate(model.price):
        if not shown >> j & 1:
            after = optimal[step, shown | 1 << j]
            helped = [j in own for own in problem.table.effective()]
            if (model.message_discount * after - price > explain + 1e-12)[helped].any():
                values.append(float(model.message_discount * belief @ after - price))
    return max(values)


@settings(deadline=None, max_examples=25)
@given(pairs())
def test_certified_encloses_the_same_optimum(both: Both) -> None:
    found = [bounds(problem) for problem in both]
    assert found[0].lower <= found[1].upper + 1e-9
    assert found[1].lower <= found[0].upper + 1e-9
    assert found[0].known_type == pytest.approx(found[1].known_type, abs=1e-9)
    worth = [evaluate(problem, Certified(nodes=500).plan(problem)).value for problem in both]
    assert worth[0] == pytest.approx(worth[1], abs=2e-3)


@settings(deadline=None, max_examples=40)
@given(pairs())
def test_a_policy_is_worth_the_same(both: Both) -> None:
    policy = QMDP().plan(both[1])
    mine, other = (evaluate(problem, policy) for problem in both)
    assert mine.value_is == other.value_is
    assert mine.value == pytest.approx(other.value, abs=1e-9)
    assert mine.cost == pytest.approx(other.cost, abs=1e-9)


def warehouse(n: int = 60, types: int = 8, facts: int = 6, steps: int = 20) -> Problem:
    """Types of six facts each: a transition puzzles who holds its fact wrong."""
    rng = np.random.default_rng(0)
    relevant = np.stack([rng.permutation(n)[:facts] for _ in range(types)])
    puzzles = rng.random((types, steps, facts)) < 0.15
    sets = np.arange(1 << facts)
    lacking = ~sets[None, None, :, None] >> np.arange(facts) & 1
    wrong = (puzzles[:, :, None, :] & (lacking == 1)).any(axis=-1)
    return Problem(LabelTable.by_type(relevant, np.where(wrong, 0.05, 0.95)), np.ones(n))


@pytest.mark.parametrize(
    "solver", [QHR(), Lookahead(), Certified(), Baseline(), Conformant()], ids=lambda s: type(s)
)
def test_too_many_messages_together_are_refused_with_what_can_do_it(solver: Solver) -> None:
    with pytest.raises(TooLargeError, match="solver=qmdp or pomcp"):
        solver.plan(warehouse())


def test_sixty_messages_are_planned_for() -> None:
    """Where the type is known, QMDP's values are its optimum's and no estimate of POMCP, a mean of
    returns, is above them; both say what this type needs alone."""
    problem = warehouse()
    qmdp, pomcp = QMDP().plan(problem), POMCP(simulations=2000).plan(problem)
    sure = np.eye(problem.n_types)[2]
    own = sum(1 << j for j in problem.table.relevant[2].tolist())
    known, estimated = worths(qmdp, 10, 0, sure), worths(pomcp, 10, 0, sure)
    assert len(known) == len(estimated) == 7  # nothing else helps this type
    assert all(value <= known[chosen] + 1e-9 for chosen, value in estimated.items())
    for policy in (qmdp, pomcp):
        chosen = messages_given(policy, 10, 0, sure)
        assert chosen
        assert chosen & ~own == 0
    found = bounds(problem)
    assert found.lower <= found.upper <= found.known_type + 1e-12


@settings(deadline=None, max_examples=30)
@given(pairs(), st.integers(0, 2**32 - 1))
def test_a_model_has_labels_and_answers_of_every_message_set(both: Both, seed: int) -> None:
    """Also where rows count messages that may pay as a mere delay."""
    rng, own = np.random.default_rng(seed), both[0]
    habits = Habits(np.array([0.1, 0.3]), np.ones(2), np.zeros(2), np.full(2, 0.5))
    idle = replace(own, trade_off=0.01, message_cost=np.ones(own.n_messages), discount=0.5)
    for problem in (own, replace(idle, discount_per="action")):
        erring = problem if problem.table.answers.size else problem.with_habits(habits)
        model = model_of(erring)
        for told in rng.integers(0, 1 << erring.n_messages, 8).tolist():
            at = rows_at(model.rows, told), np.arange(erring.n_types)
            for table, wanted in (
                (model.p, erring.table.label_probabilities(erring.n_steps, told)),
                (model.answered, erring.table.answer_probabilities(erring.n_steps, told)),
            ):
                assert np.array_equal(table[:, *at], wanted.T)
