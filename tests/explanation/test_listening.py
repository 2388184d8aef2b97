"""Compares habits learned from explanations with enumeration, and with the habits of simulated
people."""

from collections import defaultdict
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xplain.errors import InputError
from xplain.explanation.belief import Independent
from xplain.explanation.habits import Habits, habits_of
from xplain.explanation.listening import PRIOR_PEOPLE, ExplanationRecord, learn_habits
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem

FACTS, STEPS = 4, 10
PAIRS = ((0, 1), (1, 2), (2, 3))
UNKNOWN = habits_of("learned", "learned", "learned")


def enumerated(one: ExplanationRecord, habits: Habits) -> np.ndarray:
    """Computes [F] the posterior, over every way in which this person may miss and forget
    messages."""
    problem, found = one.problem, np.zeros(len(habits))
    for t, f in product(range(problem.n_user_types), range(len(habits))):
        accept, lose, error = habits.accept[f], habits.forget[f], habits.error[f]
        ways = {0: problem.prior[t] * habits.prior[f]}
        for said, labels in zip(one.said, one.answers, strict=True):
            for j in indices(said):
                ways = _moved(ways, j, True, accept)
            p = {known: problem.p_explicable[t, : len(labels), known] for known in ways}
            for known, right in p.items():
                one_said = right * (1 - error) + (1 - right) * error
                ways[known] *= np.where(labels == 1, one_said, 1 - one_said).prod()
            for j in range(problem.n_messages):
                ways = _moved(ways, j, False, lose)
        found[f] += sum(ways.values())
    return found / found.sum()


def _moved(ways: dict[int, float], j: int, right: bool, chance: float) -> dict[int, float]:
    """Changes the belief about fact j with some probability."""
    after: dict[int, float] = defaultdict(float)
    for known, p in ways.items():
        after[known | 1 << j if right else known & ~(1 << j)] += p * chance
        after[known] += p * (1 - chance)
    return dict(after)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_what_one_explanation_tells_equals_enumeration(seed: int) -> None:
    """This holds for any habits of the problem."""
    rng = np.random.default_rng(seed)
    problem = Problem(rng.random((2, 3, 4)), np.ones(2), prior=rng.dirichlet(np.ones(2)))
    said = rng.integers(4, size=3).tolist()
    answers = [rng.integers(2, size=k + 1).astype(np.uint8) for k in range(3)]
    habits = Habits(
        rng.choice([0.0, 0.2], 3), rng.choice([1.0, 0.6], 3), [0.0, 0.3, 0.1], np.full(3, 1 / 3)
    )
    told = enumerated(ExplanationRecord(problem, said, answers), habits)
    for planned in (
        problem,
        problem.with_habits(UNKNOWN),
        problem.with_habits(habits_of(0.3, 1, 0)),
    ):
        found = ExplanationRecord(planned, said, answers).posterior(habits)
        assert found == pytest.approx(told, abs=1e-9)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_the_shares_are_the_mode_of_their_posterior(seed: int) -> None:
    """The shares are compared with all shares of two habits on a fine grid."""
    rng = np.random.default_rng(seed)
    problem = Problem(rng.random((2, 2, 4)), np.ones(2))
    habits = Habits([0.0, 0.2], [1.0, 0.5], [0.0, 0.2], [0.7, 0.3])
    people = [
        ExplanationRecord(
            problem,
            rng.integers(4, size=2).tolist(),
            [rng.integers(2, size=k + 1).astype(np.uint8) for k in range(2)],
        )
        for _ in range(6)
    ]
    likely = np.array([enumerated(one, habits) for one in people]) / habits.prior
    share = np.linspace(0, 1, 10_001)[1:-1]
    shares = np.stack([share, 1 - share])
    log = np.log(likely @ shares).sum(axis=0) + PRIOR_PEOPLE * habits.prior @ np.log(shares)
    assert learn_habits(people, habits).prior[0] == pytest.approx(share[log.argmax()], abs=2e-4)


def test_what_was_learned_is_what_a_belief_takes() -> None:
    rng = np.random.default_rng(5)
    problem = Problem(rng.random((2, 2, 4)), np.ones(2))
    answers = [rng.integers(2, size=k + 1).astype(np.uint8) for k in range(2)]
    found = learn_habits([ExplanationRecord(problem, [1, 2], answers)])
    taken = Independent("learned", "learned", "learned").habits(found)
    for key in ("error", "accept", "forget"):
        shares = [getattr(h, key) @ h.prior for h in (found, taken)]
        assert shares[0] == pytest.approx(shares[1])
    only = Independent(0.0, "learned", 0.0).habits(found)
    assert (len(only), only.take_all_in) == (3, False)


def test_answers_to_questions_tell_nothing_of_messages_that_do_not_land() -> None:
    """If α and φ are learned, the documented values are used, whatever is known about errors."""
    errors = Habits([0.1, 0.3], np.ones(2), np.zeros(2), [0.9, 0.1])
    taken = Independent("learned", "learned", "learned").habits(errors)
    assert sorted(set(taken.error.tolist())) == [0.1, 0.3]
    for key in ("accept", "forget"):
        rates, shares = getattr(UNKNOWN, key), UNKNOWN.prior
        assert getattr(taken, key) @ taken.prior == pytest.approx(rates @ shares)


def test_rates_come_with_their_shares_among_people() -> None:
    """They may come from a user or from a plan in JSON; shares need not sum to 1."""
    for accept in ({1: 0.75, 0.8: 0.25}, {"1": 3, "0.8": 1}):
        found = habits_of(0.1, accept, 0.0)  # type: ignore[arg-type]
        assert (found.accept.tolist(), found.prior.tolist()) == ([1, 0.8], [0.75, 0.25])
    both = habits_of({0: 1, 0.2: 1}, {1: 3, 0.8: 1}, 0)
    assert both.shares("error") == {0: 0.5, 0.2: 0.5}
    assert both.shares("accept") == {0.8: 0.25, 1: 0.75}


@pytest.mark.parametrize(
    "accept", [0, 1.2, True, "often", {}, {1: 0}, {0: 1}, {0.5: -1}, {0.5: "x"}, {"x": 1}, [0.5]]
)
def test_what_is_no_rate_is_refused_with_what_is(accept: Any) -> None:
    with pytest.raises(InputError, match=r"^belief\.accept=.*\{rate: share, …\}"):
        Independent(accept=accept)
