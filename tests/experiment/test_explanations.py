"""Each solver's problem of a trace, and the cost of its explanations, on handmade tables."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from tests.handmade import a_prepared, with_cases
from xplain.errors import InputError
from xplain.experiment.explanations import (
    Costs,
    evaluate,
    problem_for,
    same_problems,
    with_true_labels,
)
from xplain.experiment.pipeline import PreparedData
from xplain.explanation.actions import Action, VisibleState, give
from xplain.explanation.belief import Independent
from xplain.explanation.problem import Problem
from xplain.interaction.explainees import Exact, Heedless
from xplain.solvers.base import Knowledge

COSTS = Costs(
    trade_off=1.5,
    message_cost=0.75,
    inexplicability_cost=2.0,
    discount=0.8,
    discount_per="step",
    prior="uniform",
)


# --- The problem of a trace -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("prior", "expected"), [("uniform", [0.5, 0.5]), ("observers", [0.7, 0.3])]
)
def test_every_cost_and_the_prior_asked_for_reach_the_problem(prior, expected):
    table = np.random.default_rng(0).random((2, 3, 4))
    problem = replace(COSTS, prior=prior).problem(
        table, ("a", "b"), ("F1", "F2"), np.array([0.7, 0.3])
    )
    plain = ("trade_off", "inexplicability_cost", "discount", "discount_per")
    assert [getattr(problem, name) for name in plain] == [1.5, 2.0, 0.8, "step"]
    assert problem.message_cost.tolist() == [0.75, 0.75]
    assert (problem.message_names, problem.type_names) == (("a", "b"), ("F1", "F2"))
    assert np.array_equal(problem.p_explicable, table)
    assert problem.prior.tolist() == pytest.approx(expected)


def test_a_message_has_the_cost_of_its_name():
    """Costs are in the problem's order, in whatever order they were written."""
    costs = replace(COSTS, message_cost={"b": 2, "a": 0.25})
    table = np.full((2, 3, 4), 0.5)
    problem = costs.problem(table, ("a", "b"), ("F1", "F2"), np.array([0.7, 0.3]))
    assert problem.message_cost.tolist() == [0.25, 2]
    prepared = a_prepared(steps=(3,))
    for record in evaluate(
        prepared, costs, {"solver": Spy("types", after=1)}, Independent(), Exact(), 0
    ):
        table = prepared.cases[0].labels.array(2)[record.user_type]
        zeros = int(
            (table[:1, 0] == 0).sum() + (table[:2, 3] == 0).sum() + (table[:, 3] == 0).sum()
        )
        assert (record.episode.communication, record.episode.cost) == (
            2.25,
            pytest.approx(1.5 * (0.25 + 2) + 2.0 * zeros),
        )


@pytest.mark.parametrize("user", [0, 1, 2])
def test_a_solver_plans_with_what_it_may_know(user):
    prepared = a_prepared()
    case = prepared.cases[1]
    tables = {
        "types": case.learned,
        "everyone": case.everyone,
        "type": case.perfect.of_types([user]),
        "labels": case.labels.of_types([user]),
    }
    names = {"types": ("F1", "F2"), "everyone": ("everyone",)}
    costs = replace(COSTS, prior="observers")
    for knows, table in tables.items():
        problem = problem_for(prepared, case, costs, Spy(knows), Independent(), user)
        assert np.array_equal(problem.p_explicable, table.array(2)), knows
        assert problem.type_names == names.get(knows, (prepared.types[user],))
        expected = [1 / 3, 2 / 3] if knows == "types" else [1]
        assert problem.prior.tolist() == pytest.approx(expected)


def test_problems_are_the_same_if_types_shares_and_labels_are() -> None:
    truth = with_true_labels(a_prepared())
    assert same_problems(truth, truth)
    first, *others = truth.cases
    for change in (
        {"learned_types": ("T1", "T2", "T4")},
        {"matched_true_type": np.array([0, 1, 2])},
        {"type_shares": np.array([0.4, 0.3, 0.3])},
        {"cases": (replace(first, learned=first.everyone), *others)},
        {"cases": (replace(first, learned=replace(first.learned, p=1 - first.learned.p)), *others)},
        {"cases": (replace(first, questions="some"), *others)},
    ):
        assert not same_problems(replace(truth, **change), truth), change


def test_no_oracle_where_true_types_are_unknown():
    prepared = a_prepared(perfect=False)
    with pytest.raises(InputError, match="true types are known"):
        problem_for(prepared, prepared.cases[0], COSTS, Spy("type"), Independent(), 0)


# --- Every solver, every trace, a user of every type ----------------------------------------------


@dataclass(frozen=True)
class Script:
    """Gives all messages before step ``after``, none otherwise."""

    after: int = 0

    def decide(self, visible: VisibleState, belief: np.ndarray) -> Action:
        return give(3 & ~visible.given if visible.step == self.after else 0)

    def values(self, visible: VisibleState, belief: np.ndarray) -> Mapping[Action, float]:
        return {}


@dataclass
class Spy:
    """A solver that records the problems that it receives."""

    knows: Knowledge
    after: int = 0
    planned: list[tuple[Problem, int]] = field(default_factory=list)

    def plan(self, problem: Problem, seed: int = 0) -> Script:
        self.planned.append((problem, seed))
        return Script(self.after)


def recorded(prepared: PreparedData, seed: int = 0, **solvers: Spy):
    return evaluate(prepared, COSTS, solvers, Independent(), Exact(), seed)


def test_the_user_answers_by_the_labels_of_their_own_type():
    prepared = a_prepared(steps=(3, 3))
    for record in recorded(prepared, solver=Spy("types", after=1), clairvoyant=Spy("labels", 2)):
        table = prepared.cases[record.trace].labels.array(2)[record.user_type]
        told_at = 1 if record.solver == "solver" else 2
        for k in range(3):
            given = 3 if k >= told_at else 0
            assert record.episode.labels[k, : k + 1].tolist() == table[: k + 1, given].tolist()


def test_only_who_knows_the_labels_knows_who_listens():
    spies = {knows: Spy(knows) for knows in ("types", "type", "everyone", "labels")}
    evaluate(a_prepared(steps=(2,)), COSTS, spies, Independent(), Heedless(0.5, 0.25), 0)
    for knows, spy in spies.items():
        assert {one.habits.take_all_in for one, _ in spy.planned} == {knows != "labels"}, knows


def test_every_trace_has_a_seed_of_its_own_and_solvers_share_it():
    prepared = a_prepared(steps=(2, 2, 2, 2))
    one, other, told = Spy("types"), Spy("everyone"), Spy("labels")
    recorded(prepared, 5, solver=one, oracle=other, clairvoyant=told)
    seeds = [seed for _, seed in one.planned]
    assert len(set(seeds)) == 4
    assert [seed for _, seed in other.planned] == seeds
    assert [seed for _, seed in told.planned] == [seed for seed in seeds for _ in range(3)]
    another = Spy("types")
    recorded(prepared, 6, solver=another)
    assert not set(seeds) & {seed for _, seed in another.planned}
    first = Spy("types")
    recorded(with_cases(prepared, *prepared.cases[:2]), 5, solver=first)
    assert [seed for _, seed in first.planned] == seeds[:2]


def test_what_stands_for_one_of_two_types_that_behave_alike_stands_for_both():
    alike = {"distinct": np.array([0, 1, 0]), "matched_true_type": np.array([1, 0])}
    prepared = replace(a_prepared(), **alike)
    expected = {0: [False, True], 1: [True, False], 2: [False, True]}
    for record in recorded(prepared, solver=Spy("types")):
        assert record.right.tolist() == expected[record.user_type]
        which = expected[record.user_type].index(True)
        assert np.array_equal(record.right_belief, record.episode.beliefs[:, which])


def test_a_learned_type_that_stands_for_nobody_known_is_right_for_none():
    prepared = replace(a_prepared(), matched_true_type=np.array([-1, -1]))
    assert not any(record.right.any() for record in recorded(prepared, solver=Spy("types")))
