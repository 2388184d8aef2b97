"""Solvers decide alike for a problem by type and for the dense problem."""

from dataclasses import replace

import numpy as np
import pytest

from tests.decisions import messages_given, worths
from tests.explanation.problems import random_pair
from tests.refusals import refused
from xplain import LabelTable, Problem, TooLargeError
from xplain.explanation.habits import habits_of
from xplain.explanation.message_sets import indices
from xplain.solvers.base import GIB, Solver, check_memory
from xplain.solvers.bounds import bounds
from xplain.solvers.greedy import QMDP, Baseline, Conformant, KnownType
from xplain.solvers.hsvi import Certified
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.pomcp import POMCP
from xplain.solvers.simple import QHR

SOLVERS: list[tuple[Solver, int, bool]] = [
    (QMDP(), 40, False),
    (Baseline(), 20, False),
    (Conformant(), 20, False),
    (QHR(), 20, False),
    (Lookahead(), 20, False),
    (KnownType(), 20, True),
    (POMCP(simulations=200), 10, False),
    (POMCP(), 10, True),
]
"""Each with the number of problems, and whether beliefs are certain."""


@pytest.mark.parametrize(
    ("solver", "problems", "sure"), SOLVERS, ids=lambda one: type(one).__name__
)
def test_solvers_answer_alike(
    solver: Solver, problems: int, sure: bool, rng_of_the_day: np.random.Generator
) -> None:
    """Policies give the same messages with the same values at random beliefs. POMCP's random
    streams are the same. Problems are compared if no sum is rounded differently, because rounding
    may decide between equal actions."""
    rng = np.random.default_rng(0)
    for _ in range(problems):
        both = random_pair(rng_of_the_day)
        if isinstance(solver, POMCP) and not sure:
            both = tuple(replace(each, discount_per="step") for each in both)
        policies = [solver.plan(problem, seed=3) for problem in both]
        types, n = both[1].n_types, both[1].n_messages
        for _ in range(8):
            belief = np.eye(types)[rng.integers(types)] if sure else rng.dirichlet(np.ones(types))
            k, shown = int(rng.integers(both[1].n_steps)), int(rng.integers(1 << n))
            mine, other = (messages_given(policy, k, shown, belief) for policy in policies)
            assert mine == other
            values = [worths(policy, k, shown, belief) for policy in policies]
            for chosen in values[0].keys() & values[1].keys():
                assert values[0][chosen] == pytest.approx(values[1][chosen], abs=1e-9)


def warehouse(n: int = 60, types: int = 8, facts: int = 6, steps: int = 20) -> Problem:
    """Makes types of six facts each: a transition is inexplicable to people who believe its fact
    incorrectly."""
    rng = np.random.default_rng(0)
    relevant = np.stack([rng.permutation(n)[:facts] for _ in range(types)])
    puzzles = rng.random((types, steps, facts)) < 0.15
    sets = np.arange(1 << facts)
    lacking = ~sets[None, None, :, None] >> np.arange(facts) & 1
    wrong = (puzzles[:, :, None, :] & (lacking == 1)).any(axis=-1)
    return Problem(LabelTable.by_type(relevant, np.where(wrong, 0.05, 0.95)), np.ones(n))


@pytest.mark.parametrize("solver", [Lookahead(), Certified()], ids=lambda s: type(s).__name__)
def test_too_many_messages_together_are_refused_with_what_can_do_it(solver: Solver) -> None:
    with refused("solver=qmdp or pomcp", kind=TooLargeError):
        solver.plan(warehouse())
    many = Problem(np.random.default_rng(0).random((1, 2, 1 << 11)), np.full(11, 0.1), discount=1.0)
    with refused("all sets of messages: 11 messages matter", kind=TooLargeError):
        solver.plan(many.with_habits(habits_of(0.0, 0.9, 0.0)))


def test_sixty_messages_are_weighed_by_the_sets_of_one_type_at_a_time() -> None:
    """No further message improves QHR's choice. Baseline and conformant give messages that some
    type needs."""
    problem = warehouse()
    policy, belief = QHR().plan(problem), problem.prior
    chosen = messages_given(policy, 0, 0, belief)
    best = worths(policy, 0, 0, belief)[chosen]
    for more in (chosen, *(chosen | 1 << j for j in range(60) if not chosen >> j & 1)):
        value = worths(policy, 0, more, belief)[0] - problem.prices[indices(more)].sum()
        assert value <= best + 1e-9
        assert more != chosen or value == pytest.approx(best)
    for solver in (Baseline(), Conformant()):
        assert messages_given(solver.plan(problem), 0, 0, belief)


def test_sixty_messages_are_planned_for() -> None:
    """If the type is known, QMDP's values are optimal, and no estimate of POMCP (a mean of returns)
    is above these values. Both give only messages that this type needs."""
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


def test_what_fits_exactly_is_allowed_and_a_byte_more_is_not() -> None:
    check_memory("qmdp", GIB, 1.0, "fewer messages")
    with pytest.raises(TooLargeError, match=r"qmdp needs 1\.00 GiB.*fewer messages"):
        check_memory("qmdp", GIB + 1, 1.0, "fewer messages")
