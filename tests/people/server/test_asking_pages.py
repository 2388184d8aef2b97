"""Pages of a study that asks: in lists of stages they are part of the evaluation."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.people.client import Client
from tests.people.kinds import ASKING, flow_of
from tests.people.study.stand_in import FAULTLESS
from tests.people.visitors import GENEROUS, Visitor, differences, pages, query
from xplain.people.store import Store
from xplain.people.study.bot import StudyBot
from xplain.people.web import create_app


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    opened = Store(tmp_path / "s.sqlite", flow_of(ASKING))
    yield opened
    opened.close()


def test_a_question_comes_with_the_messages_and_moves_no_progress(store: Store) -> None:
    app, seen = create_app(store, GENEROUS), 0
    for number, token in enumerate(store.invite(6, "bot")):
        person, told, part = (
            StudyBot(store.flow.plan, FAULTLESS, np.random.default_rng(number)),
            set[str](),
            set[str](),
        )
        for html, page in pages(Visitor(Client(app)), person, token):
            if page.stage not in ("asking", "evaluation"):
                continue
            (said, _) = re.findall(r"Part \d+ of \d+", html)  # read and heard
            part.add(said)
            if page.stage == "asking":
                assert {*page.messages} == told
                assert "New message" not in html
                assert page.headings == ["One extra step"]
                assert re.findall('name="label" value="(.)" required>', html) == ["1", "0", "2"]
                assert "checked" not in html
                seen += 1
            told = {*page.messages}
        assert len(part) == 1
    assert seen >= 6


def test_an_answer_counts_once(store: Store) -> None:
    """It is sent twice, from a second tab, or for an earlier question."""
    app, (token,) = create_app(store, GENEROUS), store.invite(1, "person")
    visitor = Visitor(Client(app))
    person = StudyBot(store.flow.plan, FAULTLESS, np.random.default_rng(0))
    for _, page in pages(visitor, person, token):
        if page.stage == "asking":
            break
    (before,) = [one.text for one in store.present()]
    missing = visitor.post("/study", [*page.hidden.items()])
    assert missing[0] == 400
    assert [one.text for one in store.present()] == [before]
    for label in ("0", "1", "0"):
        status = visitor.post("/study", [*page.hidden.items(), ("label", label)])[0]
        assert status == (200 if label == "0" else 409)
    assert query(store, "SELECT payload FROM event WHERE kind = 'clip'") == [
        {"payload": '{"label": 0}'}
    ]
    assert differences(store) == []
