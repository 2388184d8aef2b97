"""A refused form comes back with what was typed, and what a proxy may not be taken for."""

from __future__ import annotations

from pathlib import Path

import lxml.html
import pytest

from tests.people.study.stand_in import street_study
from tests.people.visitors import GENEROUS, Visitor, enter
from xplain.errors import InputError
from xplain.people.analysis.export import defused
from xplain.people.plan import LabQuestion
from xplain.people.server.app import create_app
from xplain.people.server.http import Server
from xplain.people.server.store import Store
from xplain.people.simulation.browser import Page
from xplain.people.study.site import StudySite

ASKED = (
    {"name": "age", "label": "Age", "kind": "number", "low": 18, "high": 110},
    {"name": "story", "label": "Your story", "kind": "text"},
    {"name": "often", "label": "How often?", "kind": "choice", "choices": ["never", "often"]},
)


def test_a_refused_form_keeps_what_was_filled_in(tmp_path: Path) -> None:
    store = Store(tmp_path / "s.sqlite", StudySite(street_study(before=ASKED)))
    app = create_app(store, GENEROUS)
    visitor = Visitor(app.test_client())
    page = Page.of_html(enter(visitor, store.invite(1, "person")[0]))
    agreed = Page.of_html(visitor.post("/study", [*page.hidden.items(), ("agree", "1")])[1])
    typed = [("age", "30.0"), ("story", "A long <story>."), ("often", "often")]
    status, html = visitor.post("/study", [*agreed.hidden.items(), *typed])
    tree = lxml.html.document_fromstring(html)
    assert status == 400
    assert tree.xpath("//input[@name='age']/@value") == ["30.0"]
    assert tree.xpath("string(//textarea)") == "A long <story>."
    assert tree.xpath("//input[@checked]/@value") == ["often"]
    store.close()


@pytest.mark.parametrize("question", [{"choices": [True, False]}, {"name": "token"}])
def test_a_question_that_a_form_cannot_carry_is_refused(question: dict[str, object]) -> None:
    with pytest.raises(InputError, match="questions"):
        LabQuestion.of({"name": "q", "label": "Q", "kind": "choice", "choices": ["a"]} | question)


def test_numbers_stay_numbers_in_tables() -> None:
    for text in ("-3", "+2.5", "-1e-9"):
        assert defused(text) == text
    for text in ("=1+1", "-3+cmd", "@x", "-", "+A1", "-١"):
        assert defused(text) == f"'{text}"


def test_listed_ids_are_lines_as_they_are_written(tmp_path: Path) -> None:
    file = tmp_path / "ids.txt"
    file.write_bytes("\ufeffAnna Lee \r\nBert\n\n".encode())
    assert Server(("platform",), ids=str(file)).listed() == {"Anna Lee", "Bert"}
