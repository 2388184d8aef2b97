"""The researcher's page: nothing without the key."""

import io
import re
import zipfile
from dataclasses import replace

import pytest

from tests.people.street import PLACES, bot_of, street_collection
from tests.people.visitors import (
    GENEROUS,
    Client,
    Opened,
    Visitor,
    agreed,
    consent,
    newcomer,
    take_part,
)
from xplain.errors import Refused
from xplain.people.bots import Page
from xplain.people.log import Clock, Unknown
from xplain.people.store import Store
from xplain.people.study.flow import Study
from xplain.runs.labels import sentences_of


def test_the_researchers_page_needs_its_key(store: Store, client: Client) -> None:
    assert "Overview of the study" not in client.get("/researcher").text
    for path in ("/researcher/invitations", "/researcher/export"):
        assert client.post(path, data={"count": "1", "stream": "bot"}).status_code == 403
    assert client.post("/researcher/login", data={"key": "guess"}).status_code == 403
    done = client.post("/researcher/login", data={"key": store.researcher_key})
    assert done.status_code == 303
    assert "samesite=lax" in done.headers["Set-Cookie"]
    first = done.headers["Set-Cookie"]
    html = client.get("/researcher").text
    assert "Overview of the study" in html
    token = Page.of_html(html).hidden["token"]
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
    (tokens_made,) = (event.payload["tokens"] for event in store.events("kind = 'pilot'"))
    assert len(tokens_made) == 3
    assert store.participant(store.enter_invited(tokens[0])).stream == "pilot"
    archive = client.post("/researcher/export", data={"token": token})
    assert archive.data[:2] == b"PK"
    apart = client.post("/researcher/export", data={"token": token, "what": "identifiers"}).data
    for name in (b"identifiers/identifiers.csv", b"identifiers/snapshot.sqlite"):
        assert name in apart
    # Each login has a cookie of its own, and the end of a session ends it.
    again = client.post("/researcher/login", data={"key": store.researcher_key})
    assert again.headers["Set-Cookie"] != first
    token = Page.of_html(client.get("/researcher").text).hidden["token"]
    held, _ = client.cookies[f"study_{store.mark}"]
    assert client.post("/researcher/logout", data={"token": token}).status_code == 303
    client.set_cookie(f"study_{store.mark}", held)
    assert "Overview of the study" not in client.get("/researcher").text


def overview(client: Client, store: Store) -> str:
    """Returns the page of a researcher who has logged in."""
    client.post("/researcher/login", data={"key": store.researcher_key})
    return client.get("/researcher").text


def logged_in(client: Client, store: Store) -> str:
    """Returns the token of the researcher's forms."""
    return Page.of_html(overview(client, store)).hidden["token"]


def test_the_researcher_is_blinded_unless_they_want_it_otherwise(
    store: Store, client: Client
) -> None:
    state = consent(store, store.enter_invited(store.invite(1, "person")[0]))
    names = [role.name for role in store.flow.plan.roles]
    hidden = {"Type": names[state.user_type], "Condition": state.condition}
    assert store.flow.about(state) == hidden
    cell = re.compile(rf"<td>({'|'.join([*names, 'personalized', 'conformant'])})</td>")
    assert cell.search(overview(client, store))
    html = overview(newcomer(store, replace(GENEROUS, blinded=True)).client, store)
    assert "Overview of the study" in html
    assert not cell.search(html)


def test_links_come_from_the_configured_address_not_from_the_request(store: Store) -> None:
    client = newcomer(store, replace(GENEROUS, address="https://study.example.org/")).client
    token = logged_in(client, store)
    good = {"token": token, "count": "1", "stream": "person"}
    made = client.post("/researcher/invitations", data=good).headers["Location"]
    html = client.get(made, base_url="http://evil.example.com").text
    assert "https://study.example.org/?invitation=" in html
    assert "evil" not in html


def test_any_type_and_condition_can_be_looked_at(store: Store, browser: Visitor) -> None:
    for cell, (user_type, condition) in enumerate(store.flow.plan.cells):
        client = browser.another().client
        token = logged_in(client, store)
        done = client.post("/researcher/preview", data={"token": token, "cell": str(cell)})
        assert done.status_code == 303
        who = store.present()[-1].id
        state = consent(store, who)
        assert (state.user_type, state.condition) == (user_type, condition)
        assert store.participant(who).stream == "pilot"
        bad = client.post("/researcher/preview", data={"token": token, "cell": "99"})
        assert bad.status_code == 400
    assert store.flow.holders(store.present()) == {}


def test_a_pause_lets_nobody_new_in_and_whoever_has_begun_go_on(
    store: Store, client: Client
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


def test_the_researcher_erases_who_asks_for_it(store: Store, client: Client) -> None:
    who = store.enter_invited(store.invite(1, "person")[0])
    token = logged_in(client, store)
    data = {"token": token, "reference": "0000-0000-0000-0000"}
    assert client.post("/researcher/erase", data=data).status_code == 404
    data["reference"] = "-".join(re.findall("....", store.reference(who))).upper()
    assert client.post("/researcher/erase", data=data).status_code == 303
    with pytest.raises(Unknown):
        store.participant(who)


def test_looking_writes_nothing(opened: Opened, study: Study) -> None:
    """Even the time-out of a silent participant is not stored."""
    now = [1000.0]
    store = opened(study, Clock(lambda: now[0], lambda: now[0], "b"))
    client = newcomer(store).client
    agreed(store)
    logged_in(client, store)
    now[0] += 86400
    before = [*store.events()]
    for path in ("/researcher", "/", "/alive", "/study"):
        client.get(path)
    assert [*store.events()] == before


def test_the_researcher_sees_labels_types_and_what_more_people_bring(opened: Opened) -> None:
    store = opened(street_collection())
    client = newcomer(store).client
    assert "after two people have finished" in overview(client, store)
    take_part(store, [bot_of(store.flow, 0, number) for number in range(6)])
    html = overview(client, store)
    assert "<strong>72</strong> labels" in html
    assert "<strong>3</strong> types found" in html
    for wrong in ("bridge, market", "market, school", "school, tunnel"):
        assert f"<td>{wrong}</td>" in html
    assert "Among ten more people" in html
    reply = client.post("/researcher/export", data={"token": Page.of_html(html).hidden["token"]})
    with zipfile.ZipFile(io.BytesIO(reply.data)) as archive:
        names = ("labels.csv", "observers.csv", "clips.parquet", "events.csv")
        assert {f"study/{name}" for name in names} <= {*archive.namelist()}
        said = sentences_of(archive.extract("study/sentences.yaml", store.path.parent), PLACES)
    assert said == {fact.name: fact.message for fact in store.flow.plan.facts}
