"""Unexpected behaviour of participants, labs and programs between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jwt
import pytest

from tests.people.client import Client
from tests.people.study.stand_in import street_study
from tests.people.visitors import GENEROUS, Visitor, consent, enter
from xplain.errors import InputError, Refused
from xplain.people.bots import Page
from xplain.people.flow import Conflict
from xplain.people.log import backup, read_plan
from xplain.people.plan import LabQuestion, make_typed
from xplain.people.server import Server
from xplain.people.site import Site, Visit, direction
from xplain.people.store import Store
from xplain.people.study.plan import StudyPlan
from xplain.people.web import create_app

PLATFORM = replace(GENEROUS, entry=("platform",), studies=("s",))


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    opened = Store(tmp_path / "s.sqlite", street_study())
    yield opened
    opened.close()


def from_platform(store: Store, server: Server, query: str, **changed: str) -> int:
    """Opens a platform's link, and presses the button that its page has, with other values."""
    client = Client(create_app(store, server))
    form = Page.of_html(client.get(f"/?{query}").text)
    return client.post("/enter", data={**form.hidden, **changed}).status_code


def test_an_id_with_a_blank_around_it_is_the_same_person(store: Store) -> None:
    for person in ("5f01", "5f01%20", "%095f01"):
        assert from_platform(store, PLATFORM, f"PROLIFIC_PID={person}&STUDY_ID=s") == 403
        query = f"PROLIFIC_PID={person}&STUDY_ID=s&SESSION_ID=x"
        assert from_platform(store, PLATFORM, query) == 303
    assert len(store.people) == 1


def test_ids_that_a_table_cannot_hold_are_refused(store: Store) -> None:
    query = "PROLIFIC_PID=a&STUDY_ID=s&SESSION_ID=x"
    for person in ("a\0b", "a\x1bb", "a\u202eb", "a\nb"):
        assert from_platform(store, PLATFORM, query, id_PROLIFIC_PID=person) == 403
    assert not store.people


@pytest.mark.parametrize("name", ["token", "invitation", "kind"])
def test_a_platform_may_call_its_ids_what_our_forms_call_theirs(store: Store, name: str) -> None:
    server = replace(PLATFORM, id_names=(name, "STUDY_ID"))
    assert from_platform(store, server, f"{name}=ann&STUDY_ID=s") == 303


def test_a_signed_link_needs_no_other_setting(store: Store, tmp_path: Path) -> None:
    file = tmp_path / "key"
    file.write_text("s" * 40)
    claims = {"PROLIFIC_PID": "ann", "STUDY_ID": "s", "SESSION_ID": "x", "exp": 1 << 33}
    token = jwt.encode(claims, "s" * 40, "HS256")
    server = replace(GENEROUS, entry=("signed",), signed_by=str(file))
    assert from_platform(store, server, f"{server.signed_name}={token}") == 303


def test_an_invitation_is_found_however_it_was_copied(store: Store) -> None:
    app = create_app(store, GENEROUS)
    for token in store.invite(2, "person"):
        for copied in (token.lower(), f"{token}\u200b", f" {token}»", f"{token[:9]} {token[9:]}"):
            assert Page.of_html(enter(Visitor(Client(app)), copied)).stage == "consent"
    assert len(store.people) == 2


@pytest.mark.parametrize("name", ["getAttribute", "querySelector", "token", "connection", "ms"])
def test_a_question_may_have_any_name(tmp_path: Path, name: str) -> None:
    """It does not collide with the form's own fields or the scripts' names."""
    asked = {"name": name, "label": "Q", "kind": "choice", "choices": ["a", "b"], "required": True}
    store = Store(tmp_path / "q.sqlite", street_study(before=[asked]))
    visitor = Visitor(Client(create_app(store, GENEROUS)))
    page = Page.of_html(enter(visitor, store.invite(1, "person")[0]))
    shown = Page.of_html(visitor.post("/study", [*page.hidden.items(), ("agree", "1")])[1])
    (own,) = shown.fields
    assert own not in {name, *shown.hidden}
    _, html = visitor.post("/study", [*shown.hidden.items(), (own, "b")])
    assert Page.of_html(html).stage == "briefing"
    assert store.everybody()[0].first("screening") == {name: "b"}
    store.close()


@pytest.mark.parametrize("typed_in", ["٣٠", "３０", "30", "۳۰.0"])
def test_numbers_come_in_the_digits_of_any_script(typed_in: str) -> None:
    words = street_study().words
    age = LabQuestion("age", "Age", "number", low=18, high=110)
    assert age.read(typed_in) == "30"
    assert not age.problem(age.read(typed_in), words)
    cold = LabQuestion("cold", "How cold?", "number", low=-50, high=50)
    assert cold.read("−5") == "-5"


def test_a_code_for_an_ending_that_there_is_not_is_refused() -> None:
    with pytest.raises(InputError, match=r"server\.codes"):
        make_typed(Server, "server", {"codes": {"screendout": "S1"}})
    assert make_typed(Server, "server", {"codes": {"full": "F1"}}).codes["full"] == "F1"


@pytest.mark.parametrize(
    ("language", "expected"),
    [
        *(("he_IL", "rtl"), ("AR", "rtl"), ("az-Arab-IR", "rtl"), ("iw", "rtl")),
        *(("ar-Latn", "ltr"), ("en_GB", "ltr"), ("zh-Hant-TW", "ltr"), ("arn", "ltr")),
    ],
)
def test_a_script_decides_the_direction_then_the_language(language: str, expected: str) -> None:
    assert direction(language) == expected


def test_monitors_ask_for_the_head_alone_and_paths_may_end_in_a_slash(store: Store) -> None:
    server = replace(GENEROUS, address="https://lab.example.org/robots")
    client = Client(create_app(store, server))
    for path in ("/alive", "/", ""):
        assert client.open(f"/robots{path}", method="HEAD").status_code == 200
    for path in ("/researcher/", "/alive/", "/"):
        assert client.get(f"/robots{path}").status_code == 200
    assert client.get("/robots/static/../../../etc/passwd").status_code == 404


@pytest.mark.parametrize(
    ("one", "two", "same"),
    [
        ("192.0.2.1:40001", "192.0.2.1:40002", True),
        ("[2001:db8::1]:443", "2001:db8::2", True),
        ("2001:db8::1", "2001:db8:0:1::1", False),
        ("192.0.2.1", "192.0.2.2", False),
        ("unknown", "_hidden", False),
    ],
)
def test_limits_are_by_person_whatever_the_proxy_writes(
    store: Store, one: str, two: str, same: bool
) -> None:
    site = Site(store, replace(GENEROUS, proxies=1))
    found = []
    for hop in (one, two):
        client = Client(_address_of(site))
        found.append(client.get("/", headers={"X-Forwarded-For": f"192.0.2.9, {hop}"}).text)
    assert (found[0] == found[1]) == same


def _address_of(site: Site) -> Any:
    """An application that says from where it was called."""
    from starlette.requests import Request
    from starlette.responses import PlainTextResponse

    async def app(scope: Any, receive: Any, send: Any) -> None:
        await PlainTextResponse(Visit(site, Request(scope)).address)(scope, receive, send)

    return app


def test_a_folder_may_have_any_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "50% of #1? it's ${x}"
    folder.mkdir()
    store = Store(folder / "s.sqlite", street_study())
    plan = store.flow.plan
    store.close()
    monkeypatch.chdir(folder)
    for path in (Path("s.sqlite"), folder / "s.sqlite"):
        found = read_plan(path, StudyPlan)
        assert found is not None
        assert found.hash == plan.hash


def test_after_an_older_backup_is_restored_nobody_is_lost(store: Store, tmp_path: Path) -> None:
    """A page is open that the restored server does not know: its answer is refused, and the page
    that the server knows is shown."""
    (token,) = store.invite(1, "person")
    visitor = Visitor(Client(create_app(store, GENEROUS)))
    page = Page.of_html(enter(visitor, token))
    backup(store.path, tmp_path / "b.sqlite")
    shown = Page.of_html(visitor.post("/study", [*page.hidden.items(), ("agree", "1")])[1])
    restored = Store(tmp_path / "b.sqlite", store.flow)
    visitor.client.app = create_app(restored, GENEROUS)
    status, html = visitor.post("/study", [*shown.hidden.items()])
    assert (status, Page.of_html(html).stage) == (409, "consent")
    again = Page.of_html(html)
    _, html = visitor.post("/study", [*again.hidden.items(), ("agree", "1")])
    assert Page.of_html(html).stage == "briefing"
    restored.close()


def test_people_who_paused_come_back_while_nobody_new_is_let_in(
    tmp_path: Path,
) -> None:
    clock = SimpleNamespace(now=0.0)
    both: Any = {"wall": lambda: clock.now, "monotonic": lambda: clock.now, "boot": "b"}
    store = Store(tmp_path / "s.sqlite", street_study(), SimpleNamespace(**both))
    first, second = (store.enter_invited(token) for token in store.invite(2, "person"))
    state = consent(store, first)
    clock.now = 1e6
    assert store.time_out_stale() == 1
    store.pause(True)
    assert store.submit(first, state.accepted, "read", {}).stage == "briefing"
    with pytest.raises(Refused, match="paused"):
        consent(store, second)
    with pytest.raises(Conflict):  # the same number, and another answer
        store.submit(first, 0, "consent", {"agree": 0})
    store.close()
