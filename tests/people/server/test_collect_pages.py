"""The pages on which labels are collected, over the same server as the study's."""

from __future__ import annotations

import base64
import gc
import io
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.people.client import Client
from tests.people.collect.stand_in import FAULTLESS, street_collection, street_plan, telling
from tests.people.study.stand_in import PLACES
from tests.people.visitors import GENEROUS, Visitor, differences, enter, field
from xplain.people.bots import Page
from xplain.people.collect.asking import AskedClip, CollectState, belief
from xplain.people.collect.bot import bot
from xplain.people.collect.flow import Collection
from xplain.people.collect.tables import KnownSoFar, glance
from xplain.people.plan import Picture
from xplain.people.server import Keys
from xplain.people.store import Store
from xplain.people.web import create_app
from xplain.questions.questionnaire import Questionnaire
from xplain.runs.discovery import sentences_of


@pytest.fixture(scope="module")
def collection() -> Collection:
    return street_collection()


@pytest.fixture
def store(tmp_path: Path, collection: Collection) -> Iterator[Store]:
    opened = Store(tmp_path / "c.sqlite", collection)
    yield opened
    opened.close()


def walk(
    visitor: Visitor, store: Store, number: int = 0, **habits: Any
) -> Iterator[tuple[str, Page]]:
    """Every page of one observer's way, before it is answered."""
    person = bot(store.flow.plan, replace(FAULTLESS, **habits), 0, number)
    html = enter(visitor, store.invite(1, "person")[0])
    while True:
        page = Page.of_html(html)
        yield html, page
        if not page.hidden:
            return
        fields = [*page.hidden.items(), *person.fill(page)[0]]
        status, html = visitor.post("/study", fields)
        assert status == 200


def agrees(store: Store, collection: Collection) -> None:
    assert differences(store) == []


def test_of_the_erased_nothing_stays_in_memory(
    store: Store, browser: Callable[[], Visitor]
) -> None:
    store.flow.forget()  # of people of other tests, who may have answered the same
    gc.collect()
    earlier = [one for one in gc.get_objects() if isinstance(one, (Questionnaire, KnownSoFar))]
    known = {id(one) for one in earlier}
    for number in range(2):
        list(walk(browser(), store, number))
    glance(store.flow, store.present())
    gone, kept = store.present()
    beliefs = {f: p for f, p in gone.state.belief.items() if f != "none"}

    def remembered() -> set[str]:
        gc.collect()
        alive = gc.get_objects()
        states = {one.text for one in alive if isinstance(one, CollectState)}
        new = [one for one in alive if id(one) not in known]
        held = [belief(one) for one in new if isinstance(one, Questionnaire) and one.asked]
        return {
            *({"state"} if gone.text in states else ()),
            *({"questionnaire"} if any(beliefs.items() <= one.items() for one in held) else ()),
            *({"types"} if any(isinstance(one, KnownSoFar) for one in new) else ()),
        }

    assert remembered() == {"state", "questionnaire", "types"}
    store.erase_by(store.reference(gone.id))
    assert remembered() == set()
    assert store.participant(kept.id).text == kept.text


def test_a_clip_shows_just_what_is_told_there(tmp_path: Path) -> None:
    collection = telling()
    plan, told = collection.plan, set()
    store = Store(tmp_path / "t.sqlite", collection)
    for html, page in walk(Visitor(Client(create_app(store, GENEROUS))), store, 1):
        if page.stage != "clips":
            continue
        (one,) = store.present()
        clip = one.state.clip
        known = {fact.message: 1 << j for j, fact in enumerate(plan.facts)}
        assert sum(known[sentence] for sentence in page.messages) == clip.told
        assert list(page.steps) == list(clip.transitions)
        assert len(page.fields) == clip.size
        assert "question" not in html.replace("Questions?", "").replace("questions", "")
        told.add(clip.told)
    assert len(told) > 8
    agrees(store, collection)
    store.close()


def test_the_researcher_sees_labels_types_and_what_more_people_bring(
    store: Store, browser: Callable[[], Visitor], collection: Collection
) -> None:
    researcher = browser()
    key = Keys(store.secret).researcher
    html = researcher.post("/researcher/login", [("key", key)])[1]
    assert "Two people have to finish first" in html
    for number in range(6):
        list(walk(browser(), store, number))
    html = researcher.get("/researcher")[1]
    assert "<strong>72</strong> labels" in html
    assert "<strong>3</strong> types found" in html
    for wrong in ("bridge, market", "market, school", "school, tunnel"):
        assert f"<td>{wrong}</td>" in html
    assert "another ten are expected to bring" in html
    reply = researcher.client.post("/researcher/export", data={"token": field(html, "token")})
    with zipfile.ZipFile(io.BytesIO(reply.data)) as archive:
        assert {"study/labels.csv", "study/observers.csv"} <= set(archive.namelist())
        assert {"study/clips.parquet", "study/events.csv"} <= set(archive.namelist())
        said = sentences_of(archive.extract("study/sentences.yaml", store.path.parent), PLACES)
    assert said == {fact.name: fact.message for fact in store.flow.plan.facts}
    _, html = researcher.post(
        "/researcher/invitations",
        [("token", field(html, "token")), ("count", "3"), ("stream", "pilot")],
    )
    assert html.count("?invitation=") == 3


def test_assigned_briefings_are_balanced_and_shown_again(tmp_path: Path) -> None:
    collection = street_collection(briefing="assigned")
    store = Store(tmp_path / "a.sqlite", collection)
    app = create_app(store, GENEROUS)
    for number in range(6):
        for _, page in walk(Visitor(Client(app)), store, number):
            if page.stage == "clips":
                assert tuple(page.facts) in [role.briefing for role in collection.plan.roles]
            assert page.stage != "task" or len(page.facts) <= 3
    roles = [one.state.role for one in store.present()]
    assert sorted(roles) == [0, 0, 1, 1, 2, 2]
    # Each answered as the briefing says, whoever they were before.
    states = [one.state for one in store.present()]
    for state in states:
        held = collection.plan.roles[state.role].held
        assert sum(1 << j for j, one in enumerate(state.stated) if one == 1) == held
    agrees(store, collection)
    store.close()


def test_images_of_own_transitions_are_served(tmp_path: Path) -> None:
    content = b"\x89PNG picture"
    plan = street_plan()
    picture = Picture("image/png", base64.b64encode(content).decode())
    plan = replace(plan, shown=(replace(plan.shown[0], picture=picture), *plan.shown[1:]))
    store = Store(tmp_path / "p.sqlite", Collection(plan))
    client = Client(create_app(store, GENEROUS))
    enter(Visitor(client), store.invite(1, "person")[0])
    reply = client.get("/picture/0")
    assert (reply.status_code, reply.data) == (200, content)
    assert reply.headers["Content-Type"] == "image/png"
    assert reply.headers["X-Content-Type-Options"] == "nosniff"
    for name in ("1", "99", "-1", "x", "..%2f0", "0x0"):
        assert client.get(f"/picture/{name}").status_code == 404
    # The obvious step has a picture, too: it would be the only page without one.
    obvious = CollectState(stage="clips", number=0, clip=AskedClip("attention", (), 0))
    assert store.flow.view(obvious)["illustrated"] == [0]
    store.close()


def test_many_at_once_share_what_was_known_when_they_came(
    store: Store, browser: Callable[[], Visitor], collection: Collection
) -> None:
    ways = [walk(browser(), store, number) for number in range(4)]
    for _ in range(40):  # a page each in turn
        for way in ways:
            next(way, None)
    list(walk(browser(), store, 5))
    after = [event.payload.get("after") for event in store.events("kind = 'consent'")]
    assert after == [[]] * 4 + [[1, 2, 3, 4]]
    agrees(store, collection)
