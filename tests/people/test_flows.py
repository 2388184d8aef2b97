"""Common stages of a study and a collection as pure machines: consent, practice, questions,
ends."""

from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from starlette.datastructures import ImmutableMultiDict

from tests.people.bare_flow import answer
from tests.people.street import KINDS, bot_of, flow_of
from xplain.errors import Refused
from xplain.people.flow import CANNOT_TELL, State

ADMITTED: dict[str, dict[str, Any]] = {
    "study": {"position": 0, "user_type": 0, "condition": "personalized"}
    | {"orders": {"eligibility": (2, 0, 1, 3), "quiz": (3, 2, 1, 0)}},
    "collect": {"number": 5, "role": None, "others": {}},
}
FIELDS = (
    "agree",
    "text",
    "label",
    "true",
    *(f"{name}{i}" for name in ("label_", "q", "fact_") for i in range(5)),
    "answer_age",
    "answer_comment",
)
VALUES = st.sampled_from(("0", "1", "2", "3")) | st.text("aZ09 é٤<&", max_size=5)
FORMS = st.dictionaries(st.sampled_from(FIELDS), VALUES)
kinds = pytest.mark.parametrize("kind", KINDS)


def consent(kind: str, **changes: Any) -> dict[str, Any]:
    text = flow_of(kind).plan.texts.consent_hash
    return {"agree": 1, "text": text} | ADMITTED[kind] | changes


@cache
def states(kind: str) -> list[Any]:
    """Yields every state of a participant who never errs."""
    flow, person = flow_of(kind), bot_of(flow_of(kind), 5)
    found = [flow.STATE(), flow.advance(flow.STATE(), "consent", consent(kind))]
    while not found[-1].over:
        found.append(flow.advance(found[-1], *answer(flow, person, found[-1])))
    return found


def at(kind: str, kind_of_event: str) -> Any:
    """Returns the first state that waits for such an event."""
    flow = flow_of(kind)
    return next(state for state in states(kind) if flow.waits_for(state) == kind_of_event)


@kinds
def test_every_page_hears_its_own_event_alone_and_nothing_after_the_end(kind: str) -> None:
    flow = flow_of(kind)
    heard = {one.kind for one in flow.STAGES} | {"return", "nonsense"}
    for state in states(kind):
        for other in heard - {flow.waits_for(state)} | ({"withdraw"} if state.over else set()):
            with pytest.raises(Refused):
                flow.advance(state, other, consent(kind))


@kinds
def test_what_is_missing_or_cannot_be_is_refused(kind: str) -> None:
    flow = flow_of(kind)
    for state in states(kind)[:-1]:
        if flow.waits_for(state) in ("read", "answers", "quiz"):
            continue  # reading, answering nothing and ticking nothing are allowed
        names = ("agree", "label", "label_0", "q0", "fact_0")
        for wrong in ({}, *(dict.fromkeys(names, value) for value in ("9", "-1", "", "٤"))):
            with pytest.raises(Refused):
                flow.read(state, flow.waits_for(state), ImmutableMultiDict(wrong))


@kinds
def test_practice_goes_on_until_it_is_understood(kind: str) -> None:
    flow, state = flow_of(kind), at(kind, "example")
    wrong = flow.advance(state, "example", {"label": 1})
    assert (wrong.stage, wrong.part, wrong.wrong) == (state.stage, 0, True)
    assert flow.advance(wrong, "example", {"label": CANNOT_TELL}) == wrong.to()
    half = flow.advance(wrong, "example", {"label": 0})
    assert (half.stage, half.part, half.wrong) == (state.stage, 1, False)
    again = flow.advance(half, "example", {"label": 0})
    assert (again.stage, again.part, again.wrong) == (state.stage, 1, True)
    done = flow.advance(again, "example", {"label": 1})
    assert (done.stage != state.stage, done.wrong) == (True, False)


@kinds
@pytest.mark.parametrize(
    ("answers", "accepted"),
    [
        ({}, True),
        ({"age": "18", "comment": "x" * 200}, True),
        ({"age": "110"}, True),
        ({"age": "17"}, False),
        ({"age": "111"}, False),
        ({"age": "40.5"}, False),
        ({"age": "-40"}, False),
        ({"age": "٤٠"}, True),
        ({"comment": "x" * 201}, False),
    ],
)
def test_questions_take_what_lies_within_their_bounds(
    kind: str, answers: dict[str, str], accepted: bool
) -> None:
    flow, state = flow_of(kind), at(kind, "answers")
    form = ImmutableMultiDict({f"answer_{name}": value for name, value in answers.items()})
    with nullcontext() if accepted else pytest.raises(Refused):
        read = flow.read(state, "answers", form)
        assert flow.advance(state, "answers", read).stage == "done"


@kinds
def test_who_declines_leaves_or_is_silent_ends(kind: str) -> None:
    flow = flow_of(kind)
    declined = flow.advance(flow.STATE(), "consent", consent(kind, agree=0))
    assert declined == flow.STATE(stage="declined", accepted=1)  # and nothing is known of them
    with pytest.raises(Refused, match="changed"):
        flow.advance(flow.STATE(), "consent", consent(kind, text="another"))
    for state in states(kind)[:-1]:
        left = flow.advance(state, "withdraw", {})
        assert (left.stage, left.over) == ("withdrawn", True)


@kinds
def test_who_comes_back_is_where_they_were(kind: str) -> None:
    flow = flow_of(kind)
    for before in states(kind)[:-1]:
        away = flow.advance(before, "time_out", {})
        assert (away.stage, away.over, flow.waits_for(away)) == ("timed_out", True, "return")
        assert "untrue" not in flow.view(away)  # they may go on
        place = {"position": before.position} if kind == "study" else {}
        back = flow.advance(away, "return", place)
        assert replace(back, accepted=before.accepted) == before
        for state in (before, away):
            assert type(state).from_text(state.text) == state


@kinds
@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_whatever_comes_is_refused_or_leads_to_a_stage(kind: str, data: Any) -> None:
    flow, state = flow_of(kind), data.draw(st.sampled_from(states(kind)))
    own = [one.kind for one in flow.STAGES if one.kind != "consent"]
    event = data.draw(st.sampled_from([*own, "return", "withdraw", "", "x"]))
    form = ImmutableMultiDict(data.draw(FORMS))
    try:
        after: State = flow.advance(state, event, flow.read(state, event, form))
    except Refused:
        return
    assert after.accepted == state.accepted + 1
    assert after.stage in (*flow.stages, *after.ENDS)
    assert type(after).from_text(after.text) == after
    flow.view(after)


@kinds
def test_who_does_not_look_ahead_is_shown_what_comes_later(kind: str) -> None:
    flow, state = flow_of(kind), at(kind, "ahead")
    step, *later = flow.plan.ahead.steps
    assert flow.view(state) | {"action": step, "later": ()} == flow.view(state)
    wrong = flow.advance(state, "ahead", {"label": 0})
    assert (wrong.stage, wrong.wrong, list(flow.view(wrong)["later"])) == ("ahead", True, later)
    assert flow.advance(state, "ahead", {"label": CANNOT_TELL}) == wrong
    for before in (state, wrong):
        after = flow.advance(before, "ahead", {"label": 1})
        assert (after.stage != "ahead", after.wrong) == (True, False)
