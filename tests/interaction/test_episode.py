"""Compares episodes with Definition 2 of the paper and with Bayes' rule. Simulated users: costs
count their thoughts, beliefs use their answers, and they have their own random stream."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xplain import Independent, LabelTable, Persistent, Problem
from xplain.explanation.actions import Action, VisibleState, give
from xplain.interaction.episode import explain
from xplain.interaction.explainees import (
    Between,
    Exact,
    Expert,
    Heedless,
    LearnsUntold,
    Misreads,
    Reaction,
    SimulatedUser,
    Slips,
    Sticky,
)
from xplain.solvers.base import CachedPolicy
from xplain.solvers.greedy import QMDP
from xplain.solvers.simple import Silent


class Scripted:
    """A policy that gives the messages of a list."""

    def __init__(self, messages: list[int]) -> None:
        self.script = messages

    def decide(self, visible: VisibleState, belief: np.ndarray) -> Action:
        return give(self.script[visible.step] & ~visible.given)

    def values(self, visible: VisibleState, belief: np.ndarray) -> dict[Action, float]:
        return {}


@st.composite
def interactions(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    types, steps, n = rng.integers(1, 4), rng.integers(1, 6), rng.integers(0, 4)
    problem = Problem(
        table=rng.uniform(0.02, 0.98, (types, steps, 1 << n)),
        message_cost=rng.uniform(0, 2, n),
        inexplicability_cost=float(rng.uniform(0, 2)),
        trade_off=float(rng.uniform(0, 3)),
        prior=rng.dirichlet(np.ones(types)),
    )
    table = rng.integers(0, 2, (steps, 1 << n)).astype(np.uint8)
    script = [int(mask) for mask in rng.integers(0, 1 << n, steps)]
    return problem, table, script


@given(interactions(), st.sampled_from([Independent(), Persistent()]))
@settings(max_examples=80, deadline=None)
def test_cost_is_definition_2_and_beliefs_are_bayes(interaction, way):
    """The belief follows from all labels, or from the labels that were not given before with the
    same messages."""
    problem, table, script = interaction
    episode = explain(problem, CachedPolicy(Scripted(script)), SimulatedUser.of(table), way)
    total, zeros, weight = 0.0, 0, problem.prior.copy()
    given_so_far, seen = set[int](), set[tuple[int, int]]()
    for i in range(problem.n_steps):
        new = {j for j in range(problem.n_messages) if script[i] >> j & 1} - given_so_far
        given_so_far |= new
        total += problem.trade_off * sum(problem.message_cost[j] for j in new)
        mask = sum(1 << j for j in given_so_far)
        for j in range(i + 1):
            zeros += 1 - int(table[j, mask])
            total += (1 - int(table[j, mask])) * problem.inexplicability_cost
            if (j, mask) not in seen:
                p = problem.p_explicable[:, j, mask]
                weight = weight * (p if table[j, mask] else 1 - p)
                seen |= {(j, mask)} if way == Persistent() else set()
        np.testing.assert_allclose(episode.beliefs[i + 1], weight / weight.sum(), rtol=1e-9)
        asked = table[: i + 1, mask].tolist()
        assert episode.labels[i].tolist() == asked + [-1] * (problem.n_steps - i - 1)
        assert episode.messages[i] == sum(1 << j for j in new)
    assert episode.cost == pytest.approx(total)
    assert episode.communication == pytest.approx(
        sum(problem.message_cost[j] for j in given_so_far)
    )
    assert (
        episode.inexplicability,
        episode.n_messages,
        episode.n_inexplicable,
        (episode.seconds > 0).all(),
    ) == (pytest.approx(zeros * problem.inexplicability_cost), len(given_so_far), zeros, True)


PEOPLE = 200
STEPS = 8


def labels(seed: int = 0, messages: int = 2) -> LabelTable:
    rng = np.random.default_rng(seed)
    return LabelTable.dense(rng.integers(0, 2, (1, STEPS, 1 << messages)))


def reactions(explainee, table=None, said=(0,) * STEPS, same=None, seed=0) -> list[Reaction]:
    same = np.arange(STEPS) if same is None else same
    person = explainee.meet(table or labels(), same, seed)
    given = np.bitwise_or.accumulate(np.array(said)).tolist()
    found = []
    for k, new in enumerate(said):
        person.hear(new)
        found.append(person.react(given[k], k + 1))
    return found


def within(count: int, of: int, probability: float) -> bool:
    """Returns True if a count is plausible for a binomial; a right count fails once in 15,000
    times."""
    return abs(count - of * probability) <= 4 * (of * probability * (1 - probability)) ** 0.5


def mistakes(repeats: bool, said: tuple[int, ...], seed: int) -> list[list[int]]:
    found = reactions(Slips(0.5, repeats), said=said, seed=seed)
    return [(thoughts != answers).astype(int).tolist() for thoughts, answers in found]


def test_a_mistake_is_made_again_until_something_new_is_told() -> None:
    told = [mistakes(True, (0, 0, 0, 0, 1, 0, 0, 0), seed) for seed in range(PEOPLE)]
    for rows in told:
        for earlier, later in zip(rows[:3] + rows[4:7], rows[1:4] + rows[5:], strict=True):
            assert later[: len(earlier)] == earlier
    kept = sum(rows[4][i] == rows[3][i] for rows in told for i in range(4))
    assert within(kept, 4 * PEOPLE, 0.5)  # a message is a new question


def test_afresh_each_answer_is_drawn_for_itself() -> None:
    rows = [mistakes(False, (0,) * STEPS, seed) for seed in range(PEOPLE)]
    kept = sum(r[7][i] == r[6][i] for r in rows for i in range(7))
    assert within(kept, 7 * PEOPLE, 0.5)


def test_a_person_errs_alike_about_copies_of_a_transition() -> None:
    same = np.array([0, 1, 0, 3, 1, 5, 0, 7])
    for repeats in (True, False):
        for seed in range(20):
            thoughts, answers = reactions(Slips(0.5, repeats), same=same, seed=seed)[-1]
            wrong = thoughts != answers
            assert np.array_equal(wrong, wrong[same])


def knowing(steps: int = STEPS) -> LabelTable:
    """Makes a table of transitions that make sense exactly if the second message is known."""
    return LabelTable.dense(np.tile([0.0, 0.0, 1.0, 1.0], (1, steps, 1)))


@pytest.mark.parametrize(("accept", "forget"), [(0.7, 0.0), (1.0, 0.2)])
def test_messages_are_taken_in_and_facts_lost_with_their_probabilities(
    accept: float, forget: float
) -> None:
    """Facts are lost after the labels of a step; without forgetting what is known stays."""
    said, known = (2,) + (0,) * (STEPS - 1), np.zeros(STEPS)
    for seed in range(PEOPLE):
        found = reactions(Heedless(accept, forget), knowing(), said, seed=seed)
        row = np.array([thoughts.all() for thoughts, _ in found])
        assert (np.diff(row.astype(int)) <= 0).all(), "nobody remembers again by themselves"
        assert forget or row.all() == row.any()
        known += row
    assert all(within(int(known[k]), PEOPLE, accept * (1 - forget) ** k) for k in range(STEPS))


def told(person, new: int):
    person.hear(new)
    return person


class Annoyed(Heedless):
    """Users who hear no message that they know already."""

    def hear(self, user: SimulatedUser, new: int) -> None:
        assert not user.knows & new
        super().hear(user, new)


def test_who_sees_what_is_known_says_a_message_again_when_it_is_forgotten():
    people = Annoyed(accept=1, forget=0.3)
    certain = np.tile([0.0, 1.0], (1, 6, 1))
    problem = Problem(table=certain, message_cost=np.array([0.1])).with_habits(people.habits)
    policy = CachedPolicy(QMDP().plan(problem))
    for person in (people.meet(LabelTable.dense(certain), np.arange(6), i) for i in range(20)):
        assert explain(problem, policy, person, Independent(), True).labels.diagonal().all()


def test_what_was_told_again_may_be_taken_in_then() -> None:
    """A repeated message may be accepted."""
    person = [Heedless(0.5).meet(knowing(), np.arange(STEPS), seed) for seed in range(PEOPLE)]
    first, second = (
        sum(told(p, 2).react(2, count).thoughts.all() for p in person) for count in (1, 2)
    )
    assert within(first, PEOPLE, 0.5)
    assert within(second, PEOPLE, 0.75)


def test_costs_are_by_thoughts_and_beliefs_by_answers() -> None:
    """Two people with equal thoughts and opposite answers cost the same, and the beliefs about them
    are opposite."""

    class Contrary:
        def hear(self, new: int) -> None:
            pass

        def react(self, given: int, count: int) -> Reaction:
            thoughts = SimulatedUser.of(np.zeros((STEPS, 1))).labels(count, given)
            return Reaction(thoughts, 1 - thoughts)

    problem = Problem(np.array([0.9, 0.1])[:, None, None].repeat(STEPS, 1), np.empty(0))
    plain, contrary = (
        explain(problem, CachedPolicy(Silent().plan(problem)), user, Independent())
        for user in (SimulatedUser.of(np.zeros((STEPS, 1))), Contrary())
    )
    assert plain.cost == contrary.cost == STEPS * (STEPS + 1) / 2
    assert plain.beliefs[-1] == pytest.approx(contrary.beliefs[-1][::-1])
    assert plain.beliefs[-1, 1] > 0.99


def error_rates(explainee, step: int) -> tuple[float, float]:
    """Returns the error rates at a step of people who think 0, and of people who think 1."""
    wrong, thought, truth = np.zeros(2), np.zeros(2), reactions(Exact())[step].thoughts
    for seed in range(PEOPLE):
        thoughts, answers = reactions(explainee, seed=seed)[step]
        assert np.array_equal(thoughts, truth)
        thought += np.bincount(thoughts, minlength=2)
        wrong += np.bincount(thoughts[thoughts != answers], minlength=2)
    return tuple((wrong / thought).tolist())


@pytest.mark.parametrize(
    ("explainee", "step", "zero", "one"),
    [
        (Slips(0.0, True, polite=0.5), 7, 0.5, 0.0),
        (Slips(0.3, True), 7, 0.3, 0.3),
        (Slips(0.5, False), 7, 0.5, 0.5),
        (Slips(0.0, False, tires=0.03), 1, 0.06, 0.06),
        (Slips(0.1, False, tires=0.2), 7, 0.5, 0.5),
    ],
)
def test_people_err_in_either_direction_at_the_rate_of_the_step(
    explainee, step: int, zero: float, one: float
) -> None:
    for found, rate in zip(error_rates(explainee, step), (zero, one), strict=True):
        assert found == pytest.approx(rate, abs=0.04)
        assert (found == 0) == (rate == 0)


def test_the_sticky_repeat_their_answer_to_the_transition_before() -> None:
    """Thoughts alternate, so an answer is wrong if it was repeated an odd number of times: with
    probability 0.4 · 0.6 + 0.4³ · 0.6 + … = 0.4 · 0.6 / (1 − 0.16) in the limit."""
    table = LabelTable.dense(np.tile([[0.0], [1.0]], (STEPS // 2, 1))[None])
    wrong = 0
    for seed in range(PEOPLE):
        thoughts, answers = reactions(Sticky(0.4), table, seed=seed)[-1]
        assert thoughts.tolist() == table.p[:, 0, 0].tolist()
        assert answers[0] == thoughts[0]
        wrong += int(answers[-1] != thoughts[-1])
    assert within(wrong, PEOPLE, 0.4 * 0.6 / 0.84)


def test_experts_find_everything_explicable() -> None:
    assert all(thoughts.all() and answers.all() for thoughts, answers in reactions(Expert()))


def test_those_between_have_one_fact_right_at_half_of_the_transitions() -> None:
    table, right = knowing(), 0
    for seed in range(PEOPLE):
        user = Between().meet(table, np.arange(STEPS), seed)
        right += int(user.react(0, STEPS).thoughts.sum())
        assert user.react(2, STEPS).thoughts.all()
    assert within(right, PEOPLE * STEPS, 0.5)


@pytest.mark.parametrize("number", [2, 3])
def test_messages_that_are_misread_tell_each_others_facts(number: int) -> None:
    table = labels(1, number)
    for seed in range(20):
        user = Misreads().meet(table, np.arange(STEPS), seed)
        means = {
            j: {
                k
                for k in range(number)
                if np.array_equal(user.react(1 << j, STEPS).thoughts, table.p[:, 1 << k, 0])
            }
            for j in range(number)
        }
        assert [len(found) for found in means.values()] == [1] * number
        assert sum(found != {j} for j, found in means.items()) == 2
        for told_ in (0, (1 << number) - 1):
            assert user.react(told_, STEPS).thoughts.tolist() == table.p[:, told_, 0].tolist()
    assert reactions(Misreads(), LabelTable.dense(np.ones((1, STEPS, 4))))[-1].thoughts.all()


def test_a_fact_is_found_out_two_steps_after_it_mattered() -> None:
    """From the third transition on, labels depend on the second message, and the last two on the
    first message."""
    second, first = [[0.0, 0.0, 1.0, 1.0]] * (STEPS - 4), [[0.0, 1.0, 0.0, 1.0]] * 2
    table = LabelTable.dense([[[1.0] * 4] * 2 + second + first])
    zeros = [int((thoughts == 0).sum()) for thoughts, _ in reactions(LearnsUntold(), table)]
    assert zeros == [0, 0, 1, 2, 0, 0, 1, 2]
    told = [int((t == 0).sum()) for t, _ in reactions(LearnsUntold(), table, (0, 0, 2, *(0,) * 5))]
    assert told == [0, 0, 0, 0, 0, 0, 1, 2]
