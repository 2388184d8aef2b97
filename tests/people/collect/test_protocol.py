"""The protocol without a server: its stages, its questions and their order, hidden values, messages
that stay valid on later pages, and the learned habits of listening."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.conftest import Run
from tests.people.bare_flow import answer, observe, somebody
from tests.people.street import (
    FAULTLESS_OBSERVER,
    bot_of,
    collection_plan,
    filled,
    street_collection,
)
from xplain.domains.users.hypotheses import Hypotheses
from xplain.errors import InputError
from xplain.explanation.habits import Habits, habits_of
from xplain.explanation.listening import PRIOR_PEOPLE, learn_habits
from xplain.explanation.message_sets import indices
from xplain.people.collect import bot
from xplain.people.collect.asking import (
    ATTENTION,
    HEEDED,
    QUESTION,
    REPEAT,
    AskedClip,
    CollectState,
    belief,
    mean_posterior,
    schedule,
)
from xplain.people.collect.tables import PersonAnswers, collect_pages, dataset_of, listeners_in
from xplain.people.flow import CANNOT_TELL
from xplain.people.store import Store
from xplain.questions.designs import Adaptive, Battery

COLLECTION = street_collection()
LISTED = street_collection(Battery(redundancy=2), points=12)
numbers = st.integers(0, 10_000)


@settings(deadline=None)
@given(numbers)
def test_a_schedule_has_every_question_one_obvious_step_and_looks_back(number: int) -> None:
    tasks = schedule(COLLECTION.plan, number)
    purposes = [task.purpose for task in tasks]
    assert purposes.count(QUESTION) == 12
    assert purposes.count(ATTENTION) == 1
    again = [task.again for task in tasks if task.purpose == REPEAT]
    assert len(set(again)) == 2  # two different questions
    for place, task in enumerate(tasks):
        if task.purpose == REPEAT:
            # Long enough after the first time, which was a question that had been asked.
            asked = purposes[:place].count(QUESTION)
            assert asked - task.again >= 3
        if task.purpose == ATTENTION:
            assert 4 <= place <= 8  # in the middle third of the questions


def test_clips_of_several_steps_end_at_the_points_asked_for() -> None:
    """There are ten points in clips of four: the last clip has two points."""
    state = somebody(street_collection(Adaptive(clip=4), points=10), held=2, number=1)
    assert [one.size for one in state.questions()] == [4, 4, 2]


@pytest.mark.parametrize("design", [None, Battery(redundancy=2)])
def test_whoever_never_errs_is_found_consistent_and_attentive(design: Battery | None) -> None:
    collection = COLLECTION if design is None else street_collection(design, points=16)
    known = collection.plan.hypotheses
    for row, held in enumerate(known.facts.tolist()):
        state = somebody(collection, held, number=row)
        assert state.attentive is True
        assert state.consistency == 1.0
        likeliest = max((f for f in state.belief if f != "none"), key=lambda f: state.belief[f])
        assert int(likeliest) == known.essential[row]
        # Who believes more incorrectly, but one fact on the other side, may answer all questions
        # alike.
        assert state.belief[likeliest] > 0.85


@settings(max_examples=30, deadline=None)
@given(numbers, st.integers(0, 15), st.booleans())
def test_between_two_looks_at_a_step_there_are_others(number: int, held: int, listed: bool) -> None:
    collection = LISTED if listed else COLLECTION
    clips = somebody(collection, held, number, bot.Habits(0.2)).answered
    phrases = collection.plan.hypotheses.phrases
    steps = [[phrases[t] for t in clip.transitions] for clip in clips]
    asked = [clip.purpose == QUESTION for clip in clips]
    for place in range(1, len(steps)):
        if steps[place] != steps[place - 1] or not any(asked[place - 1 : place + 1]):
            continue
        # A list is to be asked whole: at its end one step alone may be left.
        left = [
            step for step, question in zip(steps[place:], asked[place:], strict=True) if question
        ]
        assert listed
        assert not asked[place] or all(step == steps[place] for step in left)


@settings(max_examples=12, deadline=None)
@given(numbers, st.integers(0, 15))
def test_of_questions_that_tell_about_as_much_new_ones_come_first(number: int, held: int) -> None:
    phrases = COLLECTION.plan.hypotheses.phrases
    state = somebody(COLLECTION, held, number)
    for place, clip in enumerate(state.answered):
        if clip.purpose != QUESTION:
            continue
        known = COLLECTION.questionnaire(replace(state, answered=state.answered[:place]))
        before = [t for one in state.answered[:place] for t in one.transitions]
        near = {
            phrases[t] for one in state.answered[place - 1 : place + 2] for t in one.transitions
        }
        seen = {phrases[t] for t in before}
        best = known.information(known.next())
        own = known.information((list(clip.transitions), clip.told))
        missed = [
            (t, told)
            for t, phrase in enumerate(phrases)
            for told in range(16)
            if phrase not in seen | near and known.information((t, told)) > 0.901 * best
        ]
        (phrase,) = {phrases[t] for t in clip.transitions}
        assert phrase not in seen or not missed
        assert (
            phrase in seen
            or own >= 0.899 * best
            or phrases[np.atleast_1d(known.next()[0])[0]] in near
        )


@settings(max_examples=25, deadline=None)
@given(numbers, st.integers(0, 15))
def test_the_posterior_is_one_and_depends_on_the_answers_alone(number: int, held: int) -> None:
    habits = bot.Habits(error=0.2, mistake=0.0)
    state = somebody(COLLECTION, held, number, habits)
    assert abs(sum(state.belief.values()) - 1) < 1e-4  # but for what is not written down
    assert belief(COLLECTION.questionnaire(state)) == state.belief
    written = [share for facts, share in state.belief.items() if facts != "none"]
    assert min(written) >= 1e-6
    classes = COLLECTION.questionnaire(state).classes
    assert len(written) == (classes >= 1e-6).sum() < len(classes) or min(classes) >= 1e-6


def test_half_of_a_prior_is_what_others_hold_wrong() -> None:
    """By hand: half the prior of 16 equally likely sets, half on {0, 1} and {2} as 3 to 1."""
    first = CollectState(number=0, others={"3": 0.75, "4": 0.25})
    prior = COLLECTION.questionnaire(first).posterior / (1 - 0.01)
    known = COLLECTION.plan.hypotheses
    expected = np.full(16, 0.5 / 16)
    expected[known.row(np.array(3))] += 0.5 * 0.75
    expected[known.row(np.array(4))] += 0.5 * 0.25
    np.testing.assert_allclose(prior, expected, atol=1e-12)


def test_who_cannot_tell_gives_no_evidence_and_is_not_asked_the_same_again() -> None:
    """Every answer is "I cannot tell", so the belief does not change."""
    begun = COLLECTION.after(CollectState(), number=5, role=None, others={})
    person, state = bot_of(COLLECTION, 5), begun
    while state.stage != "beliefs":
        kind, payload = answer(COLLECTION, person, state)
        if state.clip:
            payload = {"labels": [CANNOT_TELL] * state.clip.size}
        state = COLLECTION.advance(state, kind, payload)
    asked = [(one.transitions, one.told) for one in state.questions()]
    possible = COLLECTION.questionnaire(begun).alternatives(200)
    assert len(set(asked)) == min(len(asked), len(possible))
    assert state.belief == belief(COLLECTION.questionnaire(begun))
    assert (state.attentive, state.consistency) == (True, None)
    assert len(dataset_of(COLLECTION.plan, {"ann": state}).label) == 0


MESSAGES = 3
LISTENING = street_collection(listening=MESSAGES)
FEW_QUESTIONS = street_collection(points=8, listening=MESSAGES)
UNKNOWN = habits_of("learned", "learned", "learned")


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 15), st.integers(0, 1000))
def test_what_is_told_explains_a_step_and_is_asked_about_twice_more(held: int, number: int) -> None:
    known = LISTENING.plan.hypotheses
    answered = somebody(LISTENING, held, number).answered
    told, later, again = ([c for c in answered if c.purpose == what] for what in HEEDED)
    assert [*told, *later, *again] == list(answered[-3 * MESSAGES :])
    assert [c.told for c in again] == [c.told for c in told]
    assert [c.told for c in later] == [0] * MESSAGES
    assert [c.transitions for c in (*told, *told)] == [c.transitions for c in (*later, *again)]
    forgetful = replace(FAULTLESS_OBSERVER, losing=1.0)
    for clip in somebody(LISTENING, held, number, forgetful).answered[-2 * MESSAGES : -MESSAGES]:
        assert clip.labels == (known.labels[known.row(np.array(held)), clip.transitions[0]],)
    right = 0
    for clip in told:
        assert clip.told.bit_count() == 1
        assert not clip.told & right
        labels = [
            known.labels[known.row(np.array(held & ~facts))] for facts in (right, right | clip.told)
        ]
        before, after = (int(one[clip.transitions[0]]) for one in labels)
        # On the street a step goes with each fact, whatever else is held.
        assert (before, after) == (0, 1) or not held & ~right
        right |= clip.told
    assert all(c.labels == (1,) for c in (*told, *later, *again))  # who never misses nor forgets


def enumerated(asked: PersonAnswers, habits: Habits) -> NDArray[np.float64]:
    """Computes [F] the posterior, over every way in which this person may miss and forget the
    messages of each page."""
    known, found = asked.known, np.zeros(len(habits))
    for (held, share), f in product(zip(asked.held, asked.prior, strict=True), range(len(habits))):
        ways = {0: share * habits.prior[f]}
        for clip in asked.clips:
            lasts = clip.purpose in HEEDED
            now = dict[tuple[int, int], float]()  # what is right on later pages, and on this one
            for right, p in ways.items():
                taken = {(right if lasts else 0): p}
                for j in indices(clip.told):
                    taken = _moved(taken, 1 << j, 0, habits.accept[f])
                for here, p_here in taken.items():
                    key = (here if lasts else right, here)
                    now[key] = now.get(key, 0) + p_here
            ways = {}
            for (right, here), p in now.items():
                row = known.row(np.array(int(held) & ~here))
                for transition, label in zip(clip.transitions, clip.labels, strict=True):
                    errs = known.labels[row, transition] != label
                    p *= habits.error[f] if errs else 1 - habits.error[f]
                ways[right] = ways.get(right, 0) + p
            for j in range(len(known.messages)):
                ways = _moved(ways, 0, 1 << j, habits.forget[f])
        found[f] += sum(ways.values())
    return found / found.sum()


def _moved(ways: dict[int, float], right: int, wrong: int, chance: float) -> dict[int, float]:
    after = dict[int, float]()
    for known, p in ways.items():
        for facts, share in ((known & ~wrong | right, chance), (known, 1 - chance)):
            after[facts] = after.get(facts, 0) + p * share
    return after


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_what_one_person_tells_equals_enumeration(seed: int) -> None:
    """This holds for any pages; pages without lasting messages may be in between."""
    rng = np.random.default_rng(seed)
    table = np.vstack([np.ones(4), rng.integers(2, size=(7, 4))])
    table[:, 0] = [not held & 1 for held in range(8)]  # some question tells candidates apart
    known = Hypotheses.of(table)
    purposes = rng.choice([QUESTION, *HEEDED], 5)
    clips = [
        AskedClip(
            str(what),
            tuple(rng.integers(4, size=2).tolist()),
            int(rng.integers(8)),
            tuple(rng.integers(2, size=2).tolist()),
        )
        for what in sorted(purposes, key=lambda what: what in HEEDED)
    ]
    habits = Habits(
        rng.choice([0.1, 0.3], 3), rng.choice([1, 0.6], 3), [0, 0.3, 0.1], [0.5, 0.3, 0.2]
    )
    asked = PersonAnswers(known, np.array([1, 3, 6]), rng.dirichlet(np.ones(3)), clips)
    assert asked.posterior(habits) == pytest.approx(enumerated(asked, habits), abs=1e-9)


def test_who_comes_next_begins_with_the_mean_of_those_before() -> None:
    """Shares are among people who believe what the hypotheses can say."""
    beliefs = [{"0": 0.5, "3": 0.3, "none": 0.2}, {"3": 1.0}, {"none": 1.0}]
    assert mean_posterior(beliefs) == pytest.approx({"0": 0.625 / 3, "3": 1.375 / 3}, abs=1e-6)


@pytest.mark.parametrize(
    ("accept", "forget", "seed"), [(0.8, 0.0, 1), (0.8, 0.1, 2), (1.0, 0.05, 3)]
)
def test_rates_of_simulated_people_are_found_again(accept: float, forget: float, seed: int) -> None:
    """Rates are right within four standard errors, plus the pull of the documented shares on half
    as many people. On the street a person believes two of four facts incorrectly. On the page with
    the first message about such a fact, the label is 1 with p = α (1 − e) + (1 − α) e, so the
    standard error of α is sd(p) / (1 − 2e). An accepted fact is still known three pages later with
    (1 − φ)³, whose slope is at most 3."""
    people, error, plan = 120, 0.05, FEW_QUESTIONS.plan
    habits = {"error": error, "forgetting": 1 - accept, "losing": forget}
    states: list[CollectState] = []
    for number in range(people):
        others = mean_posterior([state.belief for state in states[-10:]])
        person = bot_of(FEW_QUESTIONS, seed, number, **habits)
        states.append(observe(FEW_QUESTIONS, person, number, others))
    found = learn_habits([collect_pages(plan, state) for state in states])
    pull = PRIOR_PEOPLE / (people / 2 + PRIOR_PEOPLE)
    rates, stays = {"accept": accept, "forget": forget}, (1 - forget) ** MESSAGES
    noise = {"accept": (accept, 1.0, 1.0), "forget": (stays, 3 * (1 - forget) ** 2, accept)}
    for key, (chance, slope, share) in noise.items():
        one = chance * (1 - error) + (1 - chance) * error
        deviation = np.sqrt(one * (1 - one) / (people * share)) / (slope * (1 - 2 * error))
        true, before = rates[key], float(getattr(UNKNOWN, key) @ UNKNOWN.prior)
        tolerance = 4 * deviation + pull * abs(true - before)
        assert abs(float(getattr(found, key) @ found.prior) - true) <= tolerance, key
    mean = float(found.error @ found.prior)
    clips = sum(len(clip.labels) for clip in states[0].answered) * people
    assert abs(mean - error) <= 4 * np.sqrt(error / clips * 2) + pull * error


def test_the_command_learns_from_a_stream_alone(tmp_path: Path, run: Run) -> None:
    path = tmp_path / "c.sqlite"
    filled("collect", path)
    said = run("collect habits", path)[1]
    assert said.startswith("3 participants: ")
    assert [line.split("=")[0] for line in said.splitlines()[1:]] == [
        *("belief.error", "belief.accept", "belief.forget")
    ]
    with pytest.raises(InputError, match="a database with answers"):
        listeners_in(path, "bot")
    Store(tmp_path / "without.sqlite", street_collection()).close()
    with pytest.raises(InputError, match=r"rules\.listening.*nothing was asked again"):
        listeners_in(tmp_path / "without.sqlite")


def test_more_messages_than_facts_are_refused() -> None:
    with pytest.raises(InputError, match=r"rules\.listening.*at most one message for each fact: 4"):
        collection_plan(listening=5)
    with pytest.raises(InputError, match=r"rules\.listening"):
        collection_plan(listening=-1)
