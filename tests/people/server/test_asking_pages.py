"""Pages of a study that asks: part of the evaluation wherever stages are told."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.people.kinds import ASKING, site_of
from tests.people.server.test_researcher_pages import logged_in
from tests.people.study.stand_in import FAULTLESS
from tests.people.visitors import GENEROUS, Visitor, pages
from xplain.people.server.app import create_app
from xplain.people.server.store import Store
from xplain.people.study.bot import Person


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    opened = Store(tmp_path / "s.sqlite", site_of(ASKING))
    yield opened
    opened.close()


def test_a_question_comes_with_the_messages_and_moves_no_progress(store: Store) -> None:
    app, seen = create_app(store, GENEROUS), 0
    for number, token in enumerate(store.invite(6, "bot")):
        person, told, part = (
            Person(store.site.plan, FAULTLESS, np.random.default_rng(number)),
            set[str](),
            set[str](),
        )
        for html, page in pages(Visitor(app.test_client()), person, token):
            if page.stage not in ("asking", "evaluation"):
                continue
            part |= {*re.findall(r"Part \d+ of \d+", html)}
            if page.stage == "asking":
                assert {*page.messages} == told
                assert "New message" not in html
                assert page.headings == ["One step in between"]
                assert re.findall('name="label" value="(.)" required>', html) == ["1", "0"]
                assert "checked" not in html
                seen += 1
            told = {*page.messages}
        assert len(part) == 1
    assert seen >= 6


def test_researchers_see_who_is_asked_where_they_are(store: Store) -> None:
    app, (token,) = create_app(store, GENEROUS), store.invite(1, "person")
    person = Person(store.site.plan, FAULTLESS, np.random.default_rng(0))
    for _, page in pages(Visitor(app.test_client()), person, token):
        if page.stage == "asking":
            break
    client = app.test_client()
    logged_in(client, store)
    html = client.get("/researcher").text
    assert "asking, before step 1" in html
    (row,) = re.findall(r'<th scope="row">evaluation</th>(.*?)</tr>', html)
    assert ">1<" in re.sub("<meter.*?</meter> ", "", row)


def test_an_answer_counts_once(store: Store) -> None:
    """Sent twice, from a second tab, or of a question that is over."""
    app, (token,) = create_app(store, GENEROUS), store.invite(1, "person")
    visitor = Visitor(app.test_client())
    person = Person(store.site.plan, FAULTLESS, np.random.default_rng(0))
    for _, page in pages(visitor, person, token):
        if page.stage == "asking":
            break
    (before,) = store.query("SELECT state FROM participant")
    missing = visitor.post("/study", [*page.hidden.items()])
    assert missing[0] == 400
    assert store.query("SELECT state FROM participant") == [before]
    for label in ("0", "1", "0"):
        assert visitor.post("/study", [*page.hidden.items(), ("label", label)])[0] in (200, 400)
    assert store.query("SELECT payload FROM event WHERE kind = 'clip'") == [
        {"payload": '{"label": 0}'}
    ]
    assert store.site.replay(store._connection).differences == []
