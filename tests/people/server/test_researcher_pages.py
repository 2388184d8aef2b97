"""The researcher's page: nothing without the key."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from flask import Flask
from flask.testing import FlaskClient

from tests.people.visitors import GENEROUS, Visitor, consent, field
from xplain.errors import Refused
from xplain.people.bots import visit
from xplain.people.http import Keys
from xplain.people.store import Store, Unknown
from xplain.people.study.bot import StudyBot
from xplain.people.web import create_app


def test_the_researchers_page_needs_its_key(store: Store, client: FlaskClient) -> None:
    assert "at a glance" not in client.get("/researcher").text
    for path in ("/researcher/invitations", "/researcher/export"):
        assert client.post(path, data={"count": "1", "stream": "bot"}).status_code == 403
    assert client.post("/researcher/login", data={"key": "guess"}).status_code == 403
    keys = Keys(store.secret)
    done = client.post("/researcher/login", data={"key": keys.researcher})
    assert done.status_code == 303
    assert "SameSite=Strict" in done.headers["Set-Cookie"]
    first = done.headers["Set-Cookie"]
    html = client.get("/researcher").text
    assert "at a glance" in html
    token = field(html, "token")
    good = {"token": token, "count": "3", "stream": "pilot"}
    for bad in ({"count": "0"}, {"count": "501"}, {"count": "x"}, {"stream": "king"}):
        assert client.post("/researcher/invitations", data=good | bad).status_code == 400
    assert client.post("/researcher/invitations", data=good | {"token": ""}).status_code == 403
    made = client.post("/researcher/invitations", data=good)
    assert made.status_code == 303
    html = client.get(made.headers["Location"]).text
    tokens = re.findall(r"\?invitation=([\w-]+)", html)
    assert len(tokens) == 3
    # A reload shows them again and makes no others.
    assert re.findall(r"\?invitation=([\w-]+)", client.get(made.headers["Location"]).text) == tokens
    assert store.query("SELECT count(*) AS n FROM invitation") == [{"n": 3}]
    assert store.participant(store.enter_invited(tokens[0])).row["stream"] == "pilot"
    archive = client.post("/researcher/export", data={"token": token})
    assert archive.data[:2] == b"PK"
    # Each login has a cookie of its own, and the end of a session ends it.
    again = client.post("/researcher/login", data={"key": keys.researcher})
    assert again.headers["Set-Cookie"] != first
    token = field(client.get("/researcher").text, "token")
    held = client.get_cookie(f"researcher_{Keys(store.secret).mark}")
    assert held is not None
    assert client.post("/researcher/logout", data={"token": token}).status_code == 303
    client.set_cookie(f"researcher_{Keys(store.secret).mark}", held.value)
    assert "at a glance" not in client.get("/researcher").text


def logged_in(client: FlaskClient, store: Store) -> str:
    """The token of the researcher's forms."""
    client.post("/researcher/login", data={"key": Keys(store.secret).researcher})
    return field(client.get("/researcher").text, "token")


def test_the_researcher_is_blinded_unless_they_want_it_otherwise(
    store: Store, client: FlaskClient
) -> None:
    state = consent(store, store.enter_invited(store.invite(1, "person")[0]))
    logged_in(client, store)
    names = [role.name for role in store.flow.plan.roles]
    hidden = {"Type": names[state.user_type], "Condition": state.condition}
    assert store.flow.about(state, blinded=False) == store.flow.about(state, True) | hidden
    assert hidden.keys().isdisjoint(store.flow.about(state, blinded=True))
    cell = re.compile(rf"<td>({'|'.join([*names, 'personalized', 'conformant'])})</td>")
    assert cell.search(client.get("/researcher").text)
    blind = create_app(store, replace(GENEROUS, blinded=True)).test_client()
    logged_in(blind, store)
    html = blind.get("/researcher").text
    assert "at a glance" in html
    assert not cell.search(html)


def test_places_are_counted_by_type_and_condition_or_by_stream_alone(
    store: Store, browser: Callable[[], Visitor], person: Callable[[], StudyBot]
) -> None:
    done, under_way, also = store.invite(3, "person")
    visit(browser(), person(), done)
    for token in (under_way, also):
        consent(store, store.enter_invited(token))
    held = store.flow.holders(store.people())
    rules, cells = store.flow.plan.rules, store.flow.plan.cells
    names = [role.name for role in store.flow.plan.roles]
    for blinded in (False, True):
        client = create_app(store, replace(GENEROUS, blinded=blinded)).test_client()
        logged_in(client, store)
        _, _, table = client.get("/researcher").text.partition("Places by type and condition")
        told = [
            re.findall("<td[^>]*>([^<]*)</td>", row)
            for row in table.partition("</table>")[0].split("</tr>")[1:-1]
        ]
        of_cells: dict[tuple[str, ...], list[int]] = {}
        for user_type, condition in cells:
            of = ("person", *(() if blinded else (names[user_type], condition)))
            inside = [
                one.stage == "done"
                for one in held.values()
                if (one.user_type, one.condition) == (user_type, condition)
            ]
            row = [sum(inside), inside.count(False), rules.per_cell - len(inside)]
            of_cells[of] = np.add(of_cells.get(of, [0, 0, 0]), row).tolist()
        assert sorted(told) == sorted([*of, *map(str, row)] for of, row in of_cells.items())
        assert sum(row[1] for row in of_cells.values()) == 2


def test_people_are_counted_by_stage_in_every_stream_that_somebody_is_in(
    store: Store, client: FlaskClient
) -> None:
    logged_in(client, store)
    assert "Nobody yet" in client.get("/researcher").text
    for stream, agreed in (("person", 2), ("bot", 1)):
        waiting, *others = store.invite(agreed + 1, stream)
        store.enter_invited(waiting)
        for token in others:
            consent(store, store.enter_invited(token))
    _, _, table = client.get("/researcher").text.partition("Participants by stage")
    head, *rows = table.partition("</table>")[0].split("</tr>")
    streams = re.findall('<th scope="col" class="number">([^<]*)</th>', head)
    assert set(streams) == {"person", "bot"}
    counted = {"consent": {"person": 1, "bot": 1}, "briefing": {"person": 2, "bot": 1}}
    for row in rows[:-1]:
        (stage,) = re.findall('<th scope="row">([^<]*)</th>', row)
        numbers = map(int, re.findall(r"(\d+)</td>", row))
        own = counted.pop(stage, dict.fromkeys(streams, 0))
        assert dict(zip(streams, numbers, strict=True)) == own
    assert not counted


def test_links_come_from_the_configured_address_not_from_the_request(store: Store) -> None:
    app = create_app(store, replace(GENEROUS, address="https://study.example.org/"))
    client = app.test_client()
    token = logged_in(client, store)
    good = {"token": token, "count": "1", "stream": "person"}
    made = client.post("/researcher/invitations", data=good)
    held = client.get_cookie(f"researcher_{Keys(store.secret).mark}")
    assert held is not None
    headers = {
        "Host": "evil.example.com",
        "Cookie": f"researcher_{Keys(store.secret).mark}={held.value}",
    }
    visitor = app.test_client(use_cookies=False)  # which sends the header as it is
    html = visitor.get(made.headers["Location"], headers=headers).text
    assert "https://study.example.org/?invitation=" in html
    assert "evil" not in html


def test_any_type_and_condition_can_be_looked_at(store: Store, app: Flask) -> None:
    plan = store.flow.plan
    for cell, (user_type, condition) in enumerate(plan.cells):
        client = app.test_client()
        token = logged_in(client, store)
        done = client.post("/researcher/preview", data={"token": token, "cell": str(cell)})
        assert done.status_code == 303
        who = store.query("SELECT id FROM participant ORDER BY number DESC LIMIT 1")[0]["id"]
        state = consent(store, who)
        assert (state.user_type, state.condition) == (user_type, condition)
        assert store.participant(who).row["stream"] == "pilot"
        bad = client.post("/researcher/preview", data={"token": token, "cell": "99"})
        assert bad.status_code == 400
    assert store.flow.holders(store.people()) == {}


def test_a_pause_lets_nobody_new_in_and_whoever_has_begun_go_on(
    store: Store, client: FlaskClient
) -> None:
    begun, new = (store.enter_invited(token) for token in store.invite(2, "person"))
    consent(store, begun)
    token = logged_in(client, store)
    client.post("/researcher/pause", data={"token": token, "on": "1"})
    with pytest.raises(Refused, match="paused"):
        consent(store, new)
    assert store.submit(begun, 1, "read", {}).part == 1
    client.post("/researcher/pause", data={"token": token, "on": "0"})
    assert consent(store, new).stage == "briefing"


def test_the_researcher_erases_who_asks_for_it(store: Store, client: FlaskClient) -> None:
    who = store.enter_invited(store.invite(1, "person")[0])
    token = logged_in(client, store)
    data = {"token": token, "reference": "0000-0000-0000-0000"}
    assert client.post("/researcher/erase", data=data).status_code == 404
    data["reference"] = "-".join(re.findall("....", store.reference(who))).upper()
    assert client.post("/researcher/erase", data=data).status_code == 303
    with pytest.raises(Unknown):
        store.participant(who)
