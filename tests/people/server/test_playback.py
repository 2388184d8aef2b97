"""A session played back: the pages that were seen, with what was filled in, and nothing written."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import lxml.html
import pytest
from flask import Flask
from flask.testing import FlaskClient
from werkzeug.datastructures import MultiDict

from tests.people.kinds import ASKING, KINDS, bot_of, site_of
from tests.people.server.test_researcher_pages import logged_in
from tests.people.visitors import GENEROUS, Visitor, pages
from xplain.people.server.app import create_app
from xplain.people.server.http import Server
from xplain.people.server.playback import played
from xplain.people.server.store import Store
from xplain.people.simulation.browser import Page


@pytest.fixture(params=[*KINDS, ASKING])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Store]:
    """Of one of the flows."""
    opened = Store(tmp_path / f"{request.param}.sqlite", site_of(request.param))
    yield opened
    opened.close()


@pytest.fixture
def app(store: Store) -> Flask:
    return create_app(store, GENEROUS)


def went(store: Store, app: Flask) -> tuple[str, list[tuple[str, Page]]]:
    """Somebody who erred in every practice, and the pages that they saw."""
    (token,) = store.invite(1, "person")
    person = bot_of(store.site, 1)
    person.habits = person.habits.__class__(**{**vars(person.habits), "mistake": 0.5})
    seen = list(pages(Visitor(app.test_client()), person, token))
    return store.enter_invited(token), seen


def plain(html: str) -> list[str]:
    """What a page's main part says; codes and references aside."""
    tree = lxml.html.document_fromstring(html)
    for own in tree.xpath("//*[@id='reference' or @id='connection']"):
        own.getparent().remove(own)
    return [" ".join(text.split()) for text in tree.xpath("//main//text()") if text.strip()]


def test_every_page_is_as_it_was_seen_with_what_was_filled_in(
    store: Store, app: Flask, client: FlaskClient
) -> None:
    who, seen = went(store, app)
    logged_in(client, store)
    sent = [e for e in store.log(who) if e["source"] == "protocol"]
    assert len(seen) == len(sent) + 1
    for number, (html, page) in enumerate(seen, 1):
        again = client.get(f"/researcher/session/{who}/{number}").text
        assert plain(again) == plain(html), page.stage
        tree = lxml.html.document_fromstring(again)
        chosen = [
            (box.get("name"), box.get("value")) for box in tree.xpath("//main//input[@checked]")
        ]
        if number <= len(sent):
            stage = store.site.flow.stage(page.stage)
            assert stage is not None
            payload = sent[number - 1]["payload"]
            said = {*stage.fields(payload)}
            assert {*chosen} == {one for one in said if one[0] in page.fields}
            state = played(store.site.flow, store.log(who))[number - 1].state
            read = store.site.flow.read(state, stage.kind, MultiDict(stage.fields(payload)))
            assert read == {key: payload[key] for key in read}
        # Nothing can be sent from it, and no script sends anything.
        assert not tree.xpath("//main//button[not(@disabled)] | //main//input[not(@disabled)]")
        assert "data-sequence" not in tree.find("body").attrib
        assert 'name="token" value=""' in again or not page.hidden
    assert client.get(f"/researcher/session/{who}/{len(seen) + 1}").status_code == 404
    assert client.get(f"/researcher/session/{who}/0").status_code == 404


def test_it_writes_nothing(store: Store, app: Flask, client: FlaskClient) -> None:
    who, seen = went(store, app)
    logged_in(client, store)
    before = store._connection.total_changes
    for number in range(1, len(seen) + 1):
        assert client.get(f"/researcher/session/{who}/{number}").status_code == 200
    assert store._connection.total_changes == before
    assert store.site.replay(store._connection).differences == []


def test_only_researchers_see_it_and_never_the_erased(
    store: Store, app: Flask, client: FlaskClient
) -> None:
    who, seen = went(store, app)
    token, other = Visitor(app.test_client()), store.invite(1, "person")[0]
    next(pages(token, bot_of(store.site, 0), other))
    for stranger in (client, token.client):
        html = stranger.get(f"/researcher/session/{who}/2").text
        assert "For researchers" in html
        assert not {*plain(seen[1][0])} & {*plain(html)}
    logged_in(client, store)
    assert f"/researcher/session/{who}" in client.get("/researcher").text
    assert client.get("/researcher/session/nobody/1").status_code == 404
    store.erase(store.reference(who))
    assert client.get(f"/researcher/session/{who}/2").status_code == 404
    assert who not in client.get("/researcher").text


def test_who_shall_not_know_who_gets_what_sees_pilots_alone(store: Store, app: Flask) -> None:
    who, _ = went(store, app)
    pilot = store.enter_open()
    blinded = create_app(store, Server(burst=1e9, visitor_burst=1e9)).test_client()
    logged_in(blinded, store)
    hidden = store.path.stem != "collect"
    assert blinded.get(f"/researcher/session/{who}/1").status_code == (403 if hidden else 200)
    assert blinded.get(f"/researcher/session/{pilot}/1").status_code == 200
    html = blinded.get("/researcher").text
    assert (f"/researcher/session/{who}" in html) != hidden
    assert f"/researcher/session/{pilot}" in html


def test_a_page_has_the_clicks_that_were_made_on_it(
    store: Store, app: Flask, client: FlaskClient
) -> None:
    (token,) = store.invite(1, "person")
    who = store.enter_invited(token)
    for sequence, (_, page) in enumerate(
        pages(Visitor(app.test_client()), bot_of(store.site, 0), token)
    ):
        if not page.hidden:
            break
        tab = f"{sequence:08d}"
        store.from_tab(who, tab, [(0, "visible", 10.0, {"at": 1.0, "what": page.stage})])
        if sequence:  # the last clicks come late: after the next page was shown
            late = [(1, "label", 1500.0, {"at": 2.0, "what": f"click={sequence - 1}"})]
            store.from_tab(who, f"{sequence - 1:08d}", late)
    logged_in(client, store)
    for number in (1, 3):
        html = client.get(f"/researcher/session/{who}/{number}").text
        assert re.findall(r"click=\d+", html) == [f"click={number - 1}"]
        assert re.search(r"1\.5 s: label click", html)
