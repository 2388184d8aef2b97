"""A refused form comes back with the entered values; a proxy's reply does not count as the
server's."""

from __future__ import annotations

from pathlib import Path

import lxml.html
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.people.client import Client
from tests.people.kinds import flow_of
from tests.people.study.stand_in import street_study
from tests.people.visitors import GENEROUS, Visitor, enter
from xplain.errors import InputError
from xplain.people.bots import Page
from xplain.people.export import defuse
from xplain.people.plan import LabQuestion, lab_questions, make_typed
from xplain.people.server import Server
from xplain.people.store import Store
from xplain.people.web import create_app

ASKED = (
    {"name": "age", "label": "Age", "kind": "number", "low": 18, "high": 110},
    {"name": "story", "label": "Your story", "kind": "text"},
    {"name": "often", "label": "How often?", "kind": "choice", "choices": ["never", "often"]},
)


def test_a_refused_form_keeps_what_was_filled_in(tmp_path: Path) -> None:
    store = Store(tmp_path / "s.sqlite", street_study(before=ASKED, questions=[]))
    app = create_app(store, GENEROUS)
    visitor = Visitor(Client(app))
    page = Page.of_html(enter(visitor, store.invite(1, "person")[0]))
    agreed = Page.of_html(visitor.post("/study", [*page.hidden.items(), ("agree", "1")])[1])
    own = {"age": "12.0", "story": "A long <story>.", "often": "often"}
    typed = [(f"answer_{name}", value) for name, value in own.items()]
    status, html = visitor.post("/study", [*agreed.hidden.items(), *typed])
    tree = lxml.html.document_fromstring(html)
    assert status == 400
    assert tree.xpath("//input[@name='answer_age']/@value") == ["12.0"]
    assert tree.xpath("string(//textarea)") == "A long <story>."
    assert tree.xpath("//input[@checked]/@value") == ["often"]
    store.close()


def test_a_truth_value_is_no_choice() -> None:
    asked = {"name": "q", "label": "Q", "kind": "choice", "choices": [True, False]}
    with pytest.raises(InputError, match="questions"):
        make_typed(LabQuestion, "questions", asked)


def test_numbers_stay_numbers_in_tables() -> None:
    for text in ("-3", "+2.5", "-1e-9"):
        assert defuse(text) == text
    for text in ("=1+1", "-3+cmd", "@x", "-", "+A1", "-١"):
        assert defuse(text) == f"'{text}"


def test_listed_ids_are_lines_as_they_are_written(tmp_path: Path) -> None:
    file = tmp_path / "ids.txt"
    file.write_bytes("\ufeffAnna Lee \r\nBert\n\n".encode())
    assert Server(("platform",), ids=str(file)).listed() == {"Anna Lee", "Bert"}


def test_names_are_unique_over_all_pages() -> None:
    question = {"name": "age", "label": "Age"}
    with pytest.raises(InputError, match="one name for each question"):
        lab_questions([question], [question])


@pytest.mark.parametrize(
    ("given", "stored"),
    [("30", "30"), ("30.0", "30"), ("-5", "-5"), ("-05.", "-5"), ("", ""), (" 7 ", "7")],
)
def test_whole_numbers_are_read_as_browsers_let_them_pass(given: str, stored: str) -> None:
    cold = LabQuestion("cold", "How cold?", "number", low=-50, high=50)
    assert cold.read(given) == stored
    assert cold.problem(stored, flow_of("study").words) == ""


@given(st.text(max_size=40))
def test_what_a_browser_lets_one_type_is_accepted(text: str) -> None:
    """``maxlength`` counts UTF-16 units, and a line end as one; a form sends line ends as two."""
    asked = LabQuestion("story", "Story", max_length=max(len(text.encode("utf-16-le")) // 2, 1))
    sent = text.replace("\r\n", "\n").replace("\n", "\r\n")
    assert asked.problem(asked.read(sent), flow_of("study").words) == ""


def test_the_longest_answers_of_a_page_fit_into_a_request(tmp_path: Path) -> None:
    essay = {"name": "essay", "label": "Write", "max_length": 8000, "required": True}
    store = Store(tmp_path / "s.sqlite", street_study(before=[essay]))
    visitor = Visitor(Client(create_app(store, GENEROUS)))
    page = Page.of_html(enter(visitor, store.invite(1, "person")[0]))
    shown = Page.of_html(visitor.post("/study", [*page.hidden.items(), ("agree", "1")])[1])
    _, html = visitor.post("/study", [*shown.hidden.items(), ("answer_essay", "机" * 8000)])
    assert Page.of_html(html).stage == "briefing"
    store.close()
