"""People who were not assumed are further hidden types, all of which are enumerated. Habits learned
from explanations are compared with enumeration."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.refusals import refused
from xplain import LabelTable, Problem
from xplain.explanation.actions import VisibleState
from xplain.explanation.anybody import Open
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.belief import Facts, Independent, fact_sets, update, update_by_answer
from xplain.explanation.habits import PAPER, Habits, habits_of
from xplain.explanation.listening import ExplanationRecord, learn_habits
from xplain.explanation.message_sets import indices
from xplain.solvers.bounds import bounds
from xplain.solvers.greedy import Conformant
from xplain.solvers.hsvi import Effort
from xplain.testing.literal_pomdp import literal_optimal_value

N, STEPS = 3, 3


def world(rng: np.random.Generator, n: int = N, steps: int = STEPS, questions: int = 2) -> Any:
    """Draws random labels by the facts believed incorrectly, and two user types with one such fact
    each. One answer in twenty is flipped; returns the probabilities of answers first."""
    labels = rng.uniform(0.05, 0.95, (steps + questions, 1 << n))
    wrong = (1, 1 << (n - 1))
    every = (1 << n) - 1
    sets = np.arange(1 << n)
    of_types = np.stack([labels[:, one & ~sets] for one in wrong])
    table, asked = (
        LabelTable.dense(part, 0.05 + 0.9 * part)
        for part in (of_types[:, :steps], of_types[:, steps:])
    )
    problem = Problem(
        table, np.full(n, 1.0), prior=np.array([0.3, 0.7]), questions=Questions(asked, Limits(0.1))
    )
    everything = labels[:, every & ~sets][None]
    first, second = (
        LabelTable.dense(part, 0.05 + 0.9 * part)
        for part in (everything[:, :steps], everything[:, steps:])
    )
    return 0.05 + 0.9 * labels, wrong, problem, Facts(first, wrong, second, 0.2)


def enumerated(
    labels: np.ndarray, wrong: tuple[int, ...], n: int, ways: Any, known: bool
) -> Iterator[Any]:
    """Lists (share, user type, facts after messages, slip, guess) of everybody, except people whose
    answers are random. Only people of the found types are listed if facts are not ``known``."""
    every = (1 << n) - 1
    candidates = {0, every, *(1 << j for j in range(n))}
    candidates |= {a | b for a, b in combinations(wrong, 2)}
    others = sorted(candidates - {*wrong}) if known else []
    sizes = {one.bit_count() for one in others}
    found = enumerate(zip(wrong, (0.3, 0.7), strict=True))
    shares = [(one, t, (0.8 if known else 1) * p) for t, (one, p) in found]
    for one in others:
        alike = sum(other.bit_count() == one.bit_count() for other in others)
        shares.append((one, 2, 0.2 / len(sizes) / alike))
    for facts, t, share in shares:

        def rest(told: int, facts: int = facts) -> int:
            return facts & ~told

        keepless = [ways[4] * (not facts) * (exact == (ways[0] > 0)) for exact in (True, False)]
        yield share * (ways[0] + keepless[0]), t, rest, 0.0, 0.0, True
        yield share * (ways[1] + keepless[1]), t, rest, 0.1, 0.1, True
        yield share * ways[2], t, rest, 0.0, 0.4, False
        for j in range(n):
            if facts >> j & 1:

                def stuck(told: int, facts: int = facts, j: int = j) -> int:
                    return facts & ~(told if told == every else told & ~(1 << j))

                slips = 0.1 * (not ways[0])  # then all who listen err
                yield share * ways[4] / facts.bit_count(), t, stuck, slips, slips, False


def test_the_belief_is_that_over_everybody(rng_of_the_day: np.random.Generator) -> None:
    """The shares of people by their way of answering are the assumed ones, or learned. In some
    problems all who listen err, or a share of them that is assumed as well."""
    rng = rng_of_the_day
    assumed = np.array([0.8 * 0.99, 1 / 15, 1 / 15, 1 / 15, 0.8 * 0.01])
    for known in range(10):
        labels, wrong, problem, facts = world(rng)
        ways = rng.dirichlet(np.ones(5)) if known % 2 else assumed
        habits = replace(PAPER, ways=ways) if known % 2 else None
        err = (1.0, 0.0, 0.6)[known % 3]
        error = {0.0: 1 - err, 0.1: err} if err else 0.0
        opened = Open(error).people(problem, habits, facts if known < 7 else None)
        listens = ways[0] + ways[1]
        listed = [(1 - err) * listens, err * listens, *ways[2:]] if err else ways
        people = list(enumerated(labels, wrong, N, listed, known < 7))
        weights, coin = np.array([share for share, *_ in people]), ways[3]
        belief, told = opened.start, 0
        for step in range(STEPS):
            told |= int(rng.integers(1 << N))
            said = rng.integers(0, 2, step + 1)
            belief = update(opened, belief, told, said.astype(np.uint8))
            for p, (_, _, rest, slip, guess, _) in enumerate(people):
                for i, label in enumerate(said):
                    one = labels[i, rest(told)]
                    one = one * (1 - slip) + (1 - one) * guess
                    weights[p] *= one if label else 1 - one
            coin *= 0.5 ** (step + 1)
        belief = update_by_answer(opened, belief, told, 1, 1)
        for p, (_, _, rest, slip, guess, _) in enumerate(people):
            one = labels[STEPS + 1, rest(told)]
            weights[p] *= one * (1 - slip) + (1 - one) * guess
        coin *= 0.5
        total = weights.sum() + coin
        whose = [one[1] for one in people]
        by_type = np.bincount(whose, weights, 3).tolist()
        by_type[2] += coin
        np.testing.assert_allclose(opened.type_belief(belief), np.array(by_type) / total, atol=1e-9)
        fits = sum(w for w, one in zip(weights, people, strict=True) if one[5] and one[1] < 2)
        assert belief[opened.as_found].sum() == pytest.approx(fits / total)


@pytest.mark.parametrize("seed", range(6))
def test_certified_bounds_hold_by_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    *_, problem, facts = world(rng, n=2, steps=2, questions=seed % 2)
    for known in (facts, None):
        opened = Open().people(replace(problem, discount=0.9), None, known)
        optimum = literal_optimal_value(opened)
        proven = bounds(opened, Effort(gap=1e-6, nodes=500))
        assert proven.lower <= optimum + 1e-9
        assert optimum <= proven.upper + 1e-9


def test_conformant_plans_for_the_types_that_were_found() -> None:
    for seed in range(5):
        *_, problem, facts = world(np.random.default_rng(seed))
        opened = Open().people(problem, None, facts)
        closed, open_ = (Conformant().plan(one) for one in (problem, opened))
        state = VisibleState()
        assert closed.decide(state, problem.start) == open_.decide(state, opened.start)
        assert closed.values(state, problem.start) == pytest.approx(
            open_.values(state, opened.start)
        )


def test_without_facts_the_rest_are_people_whose_answers_tell_nothing() -> None:
    *_, problem, _ = world(np.random.default_rng(0))
    opened = Open().people(problem, None, None)
    assert opened.type_names[:2] == problem.type_names
    assert opened.type_belief(opened.prior)[2] == pytest.approx(1 / 15)
    nobody = opened.whose == 2
    assert (opened.table.answered[..., nobody] == 0.5).all()
    others = opened.prior[~nobody] / opened.prior[~nobody].sum()
    mean = opened.table.p[..., ~nobody] @ others
    np.testing.assert_allclose(opened.table.p[..., nobody][..., 0], mean)


@pytest.mark.parametrize("n", [12, 13])
def test_more_messages_than_twelve_are_planned_for_as_before(n: int) -> None:
    p = np.random.default_rng(0).random((2, 2, 8))
    problem = Problem(LabelTable.by_type([[0, 3, n - 1], [1, 2, 10]], p), np.ones(n))
    assert (Open().people(problem, None, None) is problem) == (n > 12)


def test_a_type_keeps_its_prior_whoever_can_keep_a_belief() -> None:
    """Both sets of one fact are found types. Nobody of the first type has a belief to keep, and
    nobody keeps one if messages may be missed."""
    p = np.array([[[0.9, 0.9]], [[0.1, 0.9]]])
    problem, facts = Problem(p, np.ones(1)), Facts(LabelTable.dense(p[1:]), (0, 1))
    for way in (Open(), Open(0.1), Open(accept=0.6)):
        opened = way.people(problem, None, facts)
        assert opened.type_belief(opened.start) == pytest.approx(np.array([7, 7, 1]) / 15)
        assert (opened.accept == way.accept).all()


UNKNOWN = habits_of("learned", "learned", "learned")


def habits_by_hand(one: ExplanationRecord, habits: Habits) -> np.ndarray:
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
    told = habits_by_hand(ExplanationRecord(problem, said, answers), habits)
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
    """The shares are compared with all shares of two habits on a fine grid. The assumed shares
    count as five people."""
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
    likely = np.array([habits_by_hand(one, habits) for one in people]) / habits.prior
    share = np.linspace(0, 1, 10_001)[1:-1]
    shares = np.stack([share, 1 - share])
    log = np.log(likely @ shares).sum(axis=0) + 5 * habits.prior @ np.log(shares)
    assert learn_habits(people, habits).prior[0] == pytest.approx(share[log.argmax()], abs=2e-4)


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


NO_RATES = [True, "often", {}, {0.3: 0}, {0.3: -1}, {0.3: "x"}, {"x": 1}, [0.3]]
OUTSIDE = {"error": (-0.1, 0.5), "accept": (0, 1.2), "forget": (-0.1, 1)}


@pytest.mark.parametrize(
    ("key", "rate"),
    [(key, one) for key, own in OUTSIDE.items() for one in (*own, {own[1]: 1}, *NO_RATES)],
)
def test_what_is_no_rate_is_refused_with_what_is(key: str, rate: Any) -> None:
    with refused(rf"^belief\.{key}=.*\{{rate: share, …\}}"):
        Independent(**{key: rate})


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.full((4, 46), 1 / 46), "habits=46: 1 to 45 habits"),
        (np.empty((4, 0)), "habits=0"),
        ([[0.1], [1.0], [0.0, 0.1], [1.0]], "each with all rates"),
        ([[0.1], [1.0], [0.0], [1.0], np.ones(4) / 4], r"habits\.ways=.*5 shares"),
        ([[0.1], [1.0], [0.0], [1.0], [1.5, -0.5, 0, 0, 0]], r"habits\.ways=.*sum to 1"),
        ([[0.1] * 2, [1.0] * 2, [0.0] * 2, [1.5, -0.5]], r"habits\.prior=.*sum to 1"),
        ([[0.1] * 2, [1.0] * 2, [0.0] * 2, [0.5, 0.5001]], r"habits\.prior=.*sum to 1"),
        ([[0.5], [1.0], [0.0], [1.0]], r"habits\.error=0\.5"),
    ],
)
def test_habits_are_few_and_their_shares_sum_to_one(values: Any, said: str) -> None:
    with refused(said):
        Habits(*values)


def test_a_fact_that_as_many_believe_incorrectly_as_not_is_one_of_the_types() -> None:
    assert fact_sets(np.array([[0.5, 0.49, 1.0], [0.0, 0.51, 0.4]])) == (0b101, 0b010)
