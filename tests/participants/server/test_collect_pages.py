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

from tests.collect.stand_in import FAULTLESS, street_collection, street_plan, telling
from tests.participants.server import test_fuzz
from tests.participants.visitors import GENEROUS, Visitor, enter, field
from xplain.collect.analysis.labels import Found
from xplain.collect.analysis.replay import replay
from xplain.collect.protocol.asking import belief
from xplain.collect.protocol.plan import Collection, Picture
from xplain.collect.protocol.state import State
from xplain.collect.server.protocol import CollectProtocol
from xplain.collect.simulation.observer import Habits, observer
from xplain.participants.server.app import create_app
from xplain.participants.server.security import Keys
from xplain.participants.server.store import Store
from xplain.participants.simulation.http_client import Page, visit
from xplain.questions.questionnaire import Questionnaire


@pytest.fixture(scope="module")
def collection() -> Collection:
    return street_collection()


@pytest.fixture
def store(tmp_path: Path, collection: Collection) -> Iterator[Store]:
    opened = Store(tmp_path / "c.sqlite", CollectProtocol(collection))
    yield opened
    opened.close()


@pytest.fixture
def browser(store: Store) -> Callable[[], Visitor]:
    app = create_app(store, GENEROUS)
    return lambda: Visitor(app.test_client())


def walk(
    visitor: Visitor, store: Store, number: int = 0, **habits: Any
) -> Iterator[tuple[str, Page]]:
    """Every page of one observer's way, before it is answered."""
    person = observer(store.protocol.plan, replace(FAULTLESS, **habits), 0, number)
    html = enter(visitor, store.invite(1, "person")[0])
    while True:
        page = Page(html)
        yield html, page
        if not page.hidden:
            return
        fields = [*page.hidden.items(), *person.fill(page)[0]]
        status, html = visitor.post("/study", fields)
        assert status == 200


def agrees(store: Store, collection: Collection) -> None:
    assert replay(store._connection, collection).differences == []


def test_the_way_from_entrance_to_code(
    store: Store, browser: Callable[[], Visitor], collection: Collection
) -> None:
    seen = list(walk(browser(), store))
    stages = [page.stage for _, page in seen]
    clips = ["clips"] * 15
    assert stages == [
        "consent",
        "task",
        "practice",
        "practice",
        *clips,
        "beliefs",
        "questions",
        "done",
    ]
    (row,) = store.query("SELECT code FROM participant")
    assert row["code"] in seen[-1][0]
    for paragraph in collection.plan.texts.debriefing:
        assert paragraph.split("'")[0] in seen[-1][0]  # debriefed
    agrees(store, collection)


def test_of_the_erased_nothing_stays_in_memory(
    store: Store, browser: Callable[[], Visitor]
) -> None:
    # People of other tests may have answered the same: what was there before is not of these.
    gc.collect()
    earlier = [one for one in gc.get_objects() if isinstance(one, (Questionnaire, Found))]
    known = {id(one) for one in earlier}
    for number in range(2):
        list(walk(browser(), store, number))
    store.protocol.glance(store.query)
    gone, kept = store.query("SELECT id, state FROM participant ORDER BY number")
    state = store.protocol.state(gone["state"])
    beliefs = {f: p for f, p in state.belief.items() if f != "none"}
    del state

    def remembered() -> set[str]:
        gc.collect()
        alive = gc.get_objects()
        states = {one.text for one in alive if isinstance(one, State)}
        new = [one for one in alive if id(one) not in known]
        held = [belief(one) for one in new if isinstance(one, Questionnaire) and one.asked]
        return {
            *({"state"} if gone["state"] in states else ()),
            *({"questionnaire"} if any(beliefs.items() <= one.items() for one in held) else ()),
            *({"types"} if any(isinstance(one, Found) for one in new) else ()),
        }

    assert remembered() == {"state", "questionnaire", "types"}
    store.erase(gone["id"])
    assert remembered() == set()
    assert store.protocol.state(kept["state"]).text == kept["state"]


def test_a_clip_shows_just_what_is_told_there(tmp_path: Path) -> None:
    collection = telling()
    plan, told = collection.plan, set()
    store = Store(tmp_path / "t.sqlite", CollectProtocol(collection))
    for html, page in walk(Visitor(create_app(store, GENEROUS).test_client()), store, 1):
        if page.stage != "clips":
            continue
        (row,) = store.query("SELECT state FROM participant")
        clip = store.protocol.state(row["state"]).clip
        known = {fact.message: 1 << j for j, fact in enumerate(plan.facts)}
        assert sum(known[sentence] for sentence in page.messages) == clip.told
        assert [int(step) for step in page.steps if step] == list(clip.transitions)
        assert len(page.groups()) == clip.size
        assert "question" not in html.replace("Questions?", "").replace("questions", "")
        told.add(clip.told)
    assert len(told) > 8
    agrees(store, collection)
    store.close()


def test_practice_is_repeated_until_it_is_understood(
    store: Store, browser: Callable[[], Visitor]
) -> None:
    visitor = browser()
    pages = walk(visitor, store)
    page = next(page for _, page in pages if page.stage == "practice")
    status, html = visitor.post("/study", [*page.hidden.items(), ("label", "1")])
    assert status == 200
    assert "Not quite" in html
    assert Page(html).messages == page.messages


def test_reload_and_double_click_change_nothing(
    store: Store, browser: Callable[[], Visitor], collection: Collection
) -> None:
    visitor, old = browser(), []
    for _, page in walk(visitor, store):
        assert Page(visitor.get("/study")[1]).steps == page.steps
        for fields in old[-3:]:
            status, again = visitor.post("/study", fields)
            assert status == 200
            assert Page(again).hidden == page.hidden
        if page.hidden:
            names = [(name, choices[0].value) for name, choices in page.groups().items()]
            old.append([*page.hidden.items(), *names])
    agrees(store, collection)


def test_what_is_missing_is_said(store: Store, browser: Callable[[], Visitor]) -> None:
    visitor = browser()
    for html, page in walk(visitor, store):
        if page.stage in ("practice", "clips", "beliefs"):
            status, html = visitor.post("/study", list(page.hidden.items()))
            assert status == 400
            assert 'role="alert"' in html
            assert Page(html).hidden == page.hidden


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
    _, html = researcher.post(
        "/researcher/invitations",
        [("token", field(html, "token")), ("count", "3"), ("stream", "pilot")],
    )
    assert html.count("?invitation=") == 3


def test_assigned_briefings_are_balanced_and_shown_again(tmp_path: Path) -> None:
    collection = street_collection(briefing="assigned")
    store = Store(tmp_path / "a.sqlite", CollectProtocol(collection))
    app = create_app(store, GENEROUS)
    for number in range(6):
        for _, page in walk(Visitor(app.test_client()), store, number):
            if page.stage in ("task", "clips"):
                assert tuple(page.facts) in [role.briefing for role in collection.plan.roles]
    roles = store.query("SELECT json_extract(state, '$.role') AS role FROM participant")
    assert sorted(row["role"] for row in roles) == [0, 0, 1, 1, 2, 2]
    # Each answered as the briefing says, whoever they were before.
    rows = store.query("SELECT state FROM participant")
    for row in rows:
        state = store.protocol.state(row["state"])
        held = collection.plan.roles[state.role].held
        assert sum(1 << j for j, one in enumerate(state.stated) if one == 1) == held
    agrees(store, collection)
    store.close()


def test_images_of_own_transitions_are_served(tmp_path: Path) -> None:
    content = b"\x89PNG picture"
    plan = street_plan()
    picture = Picture("image/png", base64.b64encode(content).decode())
    plan = replace(plan, pictures=(picture, *[None] * (plan.hypotheses.n_transitions - 1)))
    store = Store(tmp_path / "p.sqlite", CollectProtocol(Collection(plan)))
    client = create_app(store, GENEROUS).test_client()
    reply = client.get("/picture/0")
    assert (reply.status_code, reply.data) == (200, content)
    assert reply.headers["Content-Type"] == "image/png"
    assert reply.headers["X-Content-Type-Options"] == "nosniff"
    for name in ("1", "99", "-1", "x", "..%2f0", "0x0"):
        assert client.get(f"/picture/{name}").status_code == 404
    store.close()


def test_many_at_once_share_what_was_known_when_they_came(
    store: Store, browser: Callable[[], Visitor], collection: Collection
) -> None:
    ways = [walk(browser(), store, number) for number in range(4)]
    for _ in range(40):  # a page each in turn
        for way in ways:
            next(way, None)
    list(walk(browser(), store, 5))
    rows = store.query(
        "SELECT json_extract(payload, '$.after') AS after FROM event WHERE kind = 'consent'"
    )
    assert [row["after"] for row in rows] == ["[]"] * 4 + ["[1,2,3,4]"]
    agrees(store, collection)


def harmless(store: Store, who: list[str], before: dict[str, Any], collection: Collection) -> None:
    assert test_fuzz.records(store, who) == before
    assert store.query("PRAGMA integrity_check") == [{"integrity_check": "ok"}]
    agrees(store, collection)


@pytest.mark.parametrize("count", [500, pytest.param(10_000, marks=pytest.mark.slow)])
def test_hostile_requests_harm_nothing(
    store: Store, collection: Collection, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    """As the study's: every request is answered below 500, and nobody else's data changes."""
    facts = tuple(f"fact_{j}" for j in range(4))
    monkeypatch.setattr(test_fuzz, "NAMES", (*test_fuzz.NAMES, *facts, "stated", "others", "role"))
    kinds = ("consent", "read", "example", "labels", "labels", "beliefs", "answers", "withdraw")
    monkeypatch.setattr(test_fuzz, "STAGES", kinds)
    monkeypatch.setattr(test_fuzz, "ROUTES", (*test_fuzz.ROUTES, "/picture/0", "/picture/%2e%2e"))
    app = create_app(store, GENEROUS)
    keys, owned, others = Keys(store.secret), [], []
    for number in range(12):
        (token,) = store.invite(1, "bot")
        visitor = Visitor(app.test_client())
        person = observer(collection.plan, Habits(leaving=0.1), 0, number)
        visit(visitor, person, token)
        who = store.enter_invited(token)
        if number % 2:
            others.append(who)
        else:
            owned.append((keys.cookie(who), keys.form(who)))
    before = test_fuzz.records(store, others)
    client = app.test_client(use_cookies=False)

    def send(method: str, path: str, headers: dict[str, str], body: bytes) -> int:
        with client.open(path, method=method, headers=headers, data=body) as reply:
            assert "Traceback" not in reply.text
            assert "<script>alert" not in reply.text
            return reply.status_code

    statuses = test_fuzz.attack(send, count, 2, owned)
    assert {200, 400, 403, 404, 405} <= statuses.keys()
    harmless(store, others, before, collection)
