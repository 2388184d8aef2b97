"""The protocol without a server: its stages, its questions and their order, and hidden values."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.people.bare_flow import answer, observe
from tests.people.collect.stand_in import FAULTLESS, street_collection
from xplain.errors import InputError
from xplain.people.collect.asking import (
    ATTENTION,
    QUESTION,
    REPEAT,
    CollectState,
    belief,
    schedule,
)
from xplain.people.collect.bot import Habits, Observer
from xplain.people.collect.flow import Collection
from xplain.people.collect.tables import dataset_of
from xplain.people.flow import CANNOT_TELL
from xplain.questions.designs import Adaptive, Battery

COLLECTION = street_collection()
LISTED = street_collection(Battery(redundancy=2), points=12)
numbers = st.integers(0, 10_000)


def somebody(
    collection: Collection, held: int, number: int = 0, habits: Habits = FAULTLESS
) -> CollectState:
    """Leads an observer through the protocol, without a server, to the end."""
    person = Observer(collection.plan, held, habits, np.random.default_rng(number))
    return observe(collection, person, number)


def consent(collection: Collection, **changes: Any) -> dict[str, Any]:
    text = collection.plan.texts.consent_hash
    return {"agree": 1, "text": text, "number": 5, "role": None, "others": {}} | changes


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
            assert 3 < place < len(tasks) - 3


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
    person = Observer(collection.plan, held, Habits(0.2), np.random.default_rng(number))
    clips = observe(collection, person, number).answered
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
    person = Observer(COLLECTION.plan, held, FAULTLESS, np.random.default_rng(number))
    phrases = COLLECTION.plan.hypotheses.phrases
    state = observe(COLLECTION, person, number)
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
    habits = Habits(error=0.2, mistake=0.0)
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


def test_assigned_briefings_tell_what_a_role_knows_and_it_is_found_again() -> None:
    collection = street_collection(briefing="assigned")
    plan = collection.plan
    for index, role in enumerate(plan.roles):
        # Nothing is known of them but what they read.
        person = Observer(plan, 0, FAULTLESS, np.random.default_rng(index))
        state = observe(collection, person, index, role=index)
        row = int(plan.hypotheses.row(np.array(role.held)))
        assert state.belief[str(plan.hypotheses.essential[row])] > 0.9
        assert [state.stated[j] for j in range(len(plan.facts))] == [
            role.held >> j & 1 for j in range(len(plan.facts))
        ]


@pytest.mark.parametrize(
    ("rules", "key"),
    [
        ({"repeats": 4}, "rules.repeats"),
        ({"people": 1}, "rules.people"),
        ({"timeout_minutes": 0}, "rules.timeout_minutes"),
        ({"points": 0, "repeats": 0}, "points"),
    ],
)
def test_rules_that_cannot_be_are_named(rules: dict[str, Any], key: str) -> None:
    with pytest.raises(InputError, match=key):
        street_collection(**rules)


def test_who_cannot_tell_gives_no_evidence_and_is_not_asked_the_same_again() -> None:
    """Every answer is "I cannot tell", so the belief does not change."""
    begun = COLLECTION.advance(CollectState(), "consent", consent(COLLECTION))
    person, state = Observer(COLLECTION.plan, 3, FAULTLESS, np.random.default_rng(5)), begun
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
