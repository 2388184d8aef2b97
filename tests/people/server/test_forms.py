"""Forms with valid, nearly valid and invalid fields; a refusal keeps the typed text."""

from typing import Any

import lxml.html
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.people.conftest import Opened
from tests.people.kinds import flow_of
from tests.people.study.stand_in import street_study
from tests.people.visitors import arrive, query
from xplain.errors import InputError
from xplain.people.plan import LabQuestion, lab_questions, make_typed
from xplain.people.store import Store

WORDS = flow_of("study").words


def test_forged_answers_are_turned_away_and_leave_no_trace(store: Store) -> None:
    visitor, page = arrive(store)
    good = {**page.hidden, "agree": "1"}
    before = query(store, "SELECT * FROM event")
    for forged in (
        *({"token": ""}, {"token": "0" * 64}, {"sequence": "1"}, {"sequence": "-1"}),
        *({"sequence": "٣"}, {"sequence": "9" * 4000}, {"sequence": ""}, {"kind": "labels"}),
        *({"kind": "time_out"}, {"kind": "<script>"}, {"agree": "2"}, {"agree": "true"}),
        {"text": "0" * 64},
        # What only the server decides is not heard.
        {"agree": "", "user_type": "1", "condition": "conformant", "orders": "{}"},
    ):
        status, _ = visitor.post("/study", list((good | forged).items()))
        assert 400 <= status < 500, forged
    visitor.client.cookies.clear()
    assert visitor.client.post("/study", data=good).status_code == 403
    assert before == query(store, "SELECT * FROM event")


ITEM = {"n": 0, "kind": "visible", "ms": 1.5, "at": 1e12, "what": "consent"}


@pytest.mark.parametrize(
    "change",
    [
        *({"tab": "short"}, {"tab": 5}, {"items": {}}, {"items": [5]}, {"items": [{"n": 0}] * 51}),
        *({"token": None}, {"token": "0" * 64}),
        *({"items": [ITEM | wrong]} for wrong in ({"n": -1}, {"n": True}, {"kind": "labels"})),
        *({"items": [ITEM | wrong]} for wrong in ({"ms": float("nan")}, {"ms": 1e300})),
        *({"items": [ITEM | wrong]} for wrong in ({"at": "1"}, {"what": "x" * 41})),
    ],
)
def test_reports_of_pages_are_checked(store: Store, change: dict[str, Any]) -> None:
    visitor, page = arrive(store)
    good = {"token": page.hidden["token"], "tab": "0123456789abcdef", "items": [ITEM]}
    assert visitor.client.post("/events", json=good).status_code == 200
    assert 400 <= visitor.client.post("/events", json=good | change).status_code < 500
    assert query(store, "SELECT count(*) AS n FROM event WHERE kind = 'visible'") == [{"n": 1}]


def test_a_refused_form_keeps_what_was_filled_in(opened: Opened) -> None:
    asked = (
        {"name": "age", "label": "Age", "kind": "number", "low": 18, "high": 110},
        {"name": "story", "label": "Your story", "kind": "text"},
        {"name": "often", "label": "How often?", "kind": "choice", "choices": ["never", "often"]},
    )
    visitor, page = arrive(opened(street_study(before=asked, questions=[])))
    _, _, page = visitor.answer(page, ("agree", "1"))
    own = {"age": "12.0", "story": "A long <story>.", "often": "often"}
    fields = [(f"answer_{name}", value) for name, value in own.items()]
    status, html, _ = visitor.answer(page, *fields)
    tree = lxml.html.document_fromstring(html)
    assert status == 400
    assert tree.xpath("//input[@name='answer_age']/@value") == ["12.0"]
    assert tree.xpath("string(//textarea)") == "A long <story>."
    assert tree.xpath("//input[@checked]/@value") == ["often"]


def test_questions_that_cannot_be_asked_are_refused() -> None:
    asked = {"name": "q", "label": "Q", "kind": "choice", "choices": [True, False]}
    with pytest.raises(InputError, match="questions"):  # a truth value is no choice
        make_typed(LabQuestion, "questions", asked)
    with pytest.raises(InputError, match="one name for each question"):  # over all pages
        lab_questions([{"name": "age", "label": "Age"}], [{"name": "age", "label": "Age"}])


@pytest.mark.parametrize("name", ["getAttribute", "querySelector", "token", "connection", "ms"])
def test_a_question_may_have_any_name(opened: Opened, name: str) -> None:
    """A question may have the name of a form's field or of a script."""
    asked = {"name": name, "label": "Q", "kind": "choice", "choices": ["a", "b"], "required": True}
    store = opened(street_study(before=[asked]))
    visitor, page = arrive(store)
    _, _, shown = visitor.answer(page, ("agree", "1"))
    (own,) = shown.fields
    assert own not in {name, *shown.hidden}
    assert visitor.answer(shown, (own, "b"))[2].stage == "briefing"
    assert store.everybody()[0].first("screening") == {name: "b"}


@pytest.mark.parametrize(
    ("given", "stored"),
    [
        *(("30", "30"), ("30.0", "30"), ("-5", "-5"), ("-05.", "-5"), ("", ""), (" 7 ", "7")),
        *(("٣٠", "30"), ("３０", "30"), ("۳۰.0", "30"), ("−5", "-5")),  # digits of any script
    ],
)
def test_whole_numbers_are_read_as_browsers_let_them_pass(given: str, stored: str) -> None:
    cold = LabQuestion("cold", "How cold?", "number", low=-50, high=50)
    assert cold.read(given) == stored
    assert cold.problem(stored, WORDS) == ""


@given(st.text(max_size=40))
def test_what_a_browser_lets_one_type_is_accepted(text: str) -> None:
    """``maxlength`` counts UTF-16 units, and a line end as one; a form sends line ends as two."""
    asked = LabQuestion("story", "Story", max_length=max(len(text.encode("utf-16-le")) // 2, 1))
    sent = text.replace("\r\n", "\n").replace("\n", "\r\n")
    assert asked.problem(asked.read(sent), WORDS) == ""


def test_the_longest_answers_of_a_page_fit_into_a_request(opened: Opened) -> None:
    essay = {"name": "essay", "label": "Write", "max_length": 8000, "required": True}
    visitor, page = arrive(opened(street_study(before=[essay])))
    _, _, shown = visitor.answer(page, ("agree", "1"))
    assert visitor.answer(shown, ("answer_essay", "机" * 8000))[2].stage == "briefing"
