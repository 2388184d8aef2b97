"""Tests of solvers (see :mod:`xplain.solvers.base`)."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.actions import EXPLAIN, Explain, GiveMessages, VisibleState
from xplain.explanation.belief import Independent
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.interaction.episode import explain
from xplain.interaction.explainees import SimulatedUser
from xplain.solvers.base import CachedPolicy, Knowledge, Solver, messages_of
from xplain.testing.problems import random_problem
from xplain.testing.suite import Conformance

Question = tuple[VisibleState, NDArray[np.float64]]


class SolverConformance(Conformance):
    """Tests whether a :class:`~xplain.solvers.base.Solver` and its policies suit episodes,
    sessions, replay and exact evaluation. Above all, a policy must be a function of its arguments.

    The quality of decisions is tested only on three problems whose best decision is obvious.

    Attributes:
        problems: number of random problems for the other tests.
        weighs_costs: False omits the tests of the quality of decisions, for solvers that do not
            plan, such as silence.
    """

    problems = 12
    weighs_costs = True

    def test_is_a_solver(self, component: Any) -> None:
        """A solver plans, and declares the knowledge about the user that it needs."""
        assert isinstance(component, Solver), "a solver has `knows` and `plan`"
        assert component.knows in get_args(Knowledge), f"knows: one of {get_args(Knowledge)}"

    def test_gives_messages_that_exist_and_are_new(self, component: Any) -> None:
        """The policy gives a bitmask of new messages at any step, history and belief."""
        for problem, questions in self._draw_situations(component):
            policy = component.plan(problem, self.seed)
            for visible, belief in questions:
                action, given = policy.decide(visible, belief), visible.given
                assert isinstance(action, Explain | GiveMessages), (
                    f"{action!r} is not Explain or GiveMessages"
                )
                _check_messages(messages_of(action), given, problem)

    def test_the_same_question_gets_the_same_answer(self, component: Any) -> None:
        """A decision does not depend on earlier decisions. Two plans with the same seed decide
        alike."""
        for problem, questions in self._draw_situations(component):
            policy, other = component.plan(problem, self.seed), component.plan(problem, self.seed)
            first = [policy.decide(*question) for question in questions]
            again = [policy.decide(*question) for question in reversed(questions)]
            others = [other.decide(*question) for question in questions]
            assert first == again[::-1], "decisions depend on earlier ones"
            assert first == others, "two plans of one problem and seed decide differently"

    def test_values_belong_to_messages_that_can_be_given(self, component: Any) -> None:
        """Each value is finite and belongs to a message set that can be given next. A policy may
        have no values."""
        for problem, questions in self._draw_situations(component):
            policy = component.plan(problem, self.seed)
            for visible, belief in questions:
                for action, value in policy.values(visible, belief).items():
                    _check_messages(messages_of(action), visible.given, problem)
                    assert np.isfinite(value), f"the value of {action} is {value}"

    def test_leaves_problem_and_belief_as_they_were(self, component: Any) -> None:
        """The problem and the belief belong to the caller and must not change."""
        for problem, questions in self._draw_situations(component):
            before = problem.p_explicable.copy()
            policy = component.plan(problem, self.seed)
            for visible, belief in questions:
                kept = belief.copy()
                policy.decide(visible, belief)
                policy.values(visible, belief)
                assert np.array_equal(kept, belief), "the belief was changed"
            assert np.array_equal(before, problem.p_explicable), "the table was changed"

    def test_says_nothing_where_everything_is_explicable(self, component: Any) -> None:
        """If everything is explicable, a message has a cost and no benefit."""
        if not self.weighs_costs:
            return
        for steps in (1, 5):
            certain = LabelTable.dense(np.ones((_count_types(component), steps, 4)))
            problem = Problem(certain, np.ones(2))
            policy = component.plan(problem, self.seed)
            for step in range(steps):
                action = policy.decide(VisibleState(step), problem.prior)
                assert action == EXPLAIN, "a message without a gain"

    def test_says_at_once_what_makes_the_whole_trace_explicable(self, component: Any) -> None:
        """One cheap message of two makes every transition explicable; without this message there
        are 10 labels 0."""
        if not self.weighs_costs:
            return
        good = 1.0 if component.knows == "labels" else 0.95
        table = np.full((_count_types(component), 4, 4), 1 - good)
        table[:, :, 2:] = good
        problem = Problem(LabelTable.dense(table), np.ones(2))
        policy = component.plan(problem, self.seed)
        action = policy.decide(VisibleState(), problem.prior)
        assert action == GiveMessages(2), "message 1 alone is worth its cost"

    def test_explains_a_whole_trace(self, component: Any) -> None:
        """An episode runs to its end, and a message that costs too much is never given."""
        rng = np.random.default_rng(self.seed)
        for problem, _ in self._draw_situations(component):
            labels = rng.random(problem.p_explicable[0].shape)
            dear = replace(problem, trade_off=1e6, message_cost=np.ones(problem.n_messages))
            if component.knows in ("type", "labels"):
                labels = problem.p_explicable[0]
            for one in (problem, dear):
                policy = component.plan(one, self.seed)
                episode = explain(
                    one,
                    CachedPolicy(policy),
                    SimulatedUser.of(np.round(labels).astype(np.uint8)),
                    Independent(),
                )
                assert np.isfinite(episode.cost), "the episode has no cost"
                if one is dear and self.weighs_costs:
                    assert episode.n_messages == 0, "it gave a message that costs a million"

    def _draw_situations(self, component: Any) -> Iterator[tuple[Problem, list[Question]]]:
        """Yields random problems with random visible states and beliefs."""
        rng = np.random.default_rng(self.seed)
        for _ in range(self.problems):
            problem = random_problem(rng, _count_types(component), max_steps=4, max_messages=3)
            if component.knows == "labels":
                problem = replace(problem, table=LabelTable.dense(np.round(problem.p_explicable)))
            questions = [
                (
                    VisibleState(
                        int(rng.integers(problem.n_steps)),
                        int(rng.integers(1 << problem.n_messages)),
                    ),
                    rng.dirichlet(np.ones(problem.n_types)),
                )
                for _ in range(4)
            ]
            yield problem, questions


def _check_messages(new: int, given: int, problem: Problem) -> None:
    """Raises AssertionError if the messages ``new`` cannot be given after ``given``."""
    assert isinstance(new, (int, np.integer)), f"{new!r} is not a bitmask"
    assert new >= 0, f"{new} is not a bitmask"
    assert new & given == 0, f"{new:b} repeats messages of {given:b}"
    assert new >> problem.n_messages == 0, f"{new:b} has a message that does not exist"


def _count_types(solver: Solver) -> int:
    """Returns the number of types to plan for: several if the solver knows them, otherwise 1."""
    return 3 if solver.knows == "types" else 1
