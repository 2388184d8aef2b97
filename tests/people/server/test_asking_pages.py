"""Pages of a study that asks: part of the evaluation wherever stages are told."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from tests.people.kinds import ASKING, flow_of
from tests.people.server.test_researcher_pages import logged_in
from tests.people.study.stand_in import ASK, FAULTLESS, street_study
from tests.people.visitors import GENEROUS, Visitor, differences, pages
from xplain.people.bots import answer
from xplain.people.store import Store
from xplain.people.study.bot import StudyBot
from xplain.people.study.flow import StudyState
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
        for html, page in pages(Visitor(app.test_client()), person, token):
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


def test_researchers_see_who_is_asked_where_they_are(store: Store) -> None:
    app, (token,) = create_app(store, GENEROUS), store.invite(1, "person")
    person = StudyBot(store.flow.plan, FAULTLESS, np.random.default_rng(0))
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
    person = StudyBot(store.flow.plan, FAULTLESS, np.random.default_rng(0))
    for _, page in pages(visitor, person, token):
        if page.stage == "asking":
            break
    (before,) = store.query("SELECT state FROM seen")
    missing = visitor.post("/study", [*page.hidden.items()])
    assert missing[0] == 400
    assert store.query("SELECT state FROM seen") == [before]
    for label in ("0", "1", "0"):
        status = visitor.post("/study", [*page.hidden.items(), ("label", label)])[0]
        assert status == (200 if label == "0" else 409)
    assert store.query("SELECT payload FROM event WHERE kind = 'clip'") == [
        {"payload": '{"label": 0}'}
    ]
    assert differences(store) == []


def test_a_start_says_what_questions_are_worth() -> None:
    """By what people who never err cost in the bare flow."""
    flow = street_study(ask=ASK)
    plan, costs = flow.plan, dict[str, list[float]]()
    questions = 0
    for condition, user_type in product(plan.conditions, range(3)):
        person = StudyBot(plan, FAULTLESS, np.random.default_rng(0))
        person.user_type = user_type
        start = StudyState(stage="eligibility", user_type=user_type, condition=condition)
        state, wrong = flow.after(start), 0
        while state.stage in ("asking", "evaluation"):
            kind, payload = answer(flow, person, state)
            wrong += payload.get("labels", []).count(0)
            state = flow.advance(state, kind, payload)
        questions += len(state.asked)
        paid = len(state.heard) + wrong + 0.1 * len(state.asked)
        costs.setdefault(condition, []).append(paid)
    said = flow.announcement()
    for condition, paid in costs.items():
        assert f"{np.mean(paid):.2f} {condition}" in said
    assert f"({questions / 3:.1f} questions)" in said
    assert flow_of("study").announcement() == ""
