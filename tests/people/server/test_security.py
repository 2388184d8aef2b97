"""Cookies and tokens that only the server can make, and the limit of requests."""

from __future__ import annotations

from collections.abc import Callable

from fastapi import FastAPI

from tests.people.client import Client
from tests.people.visitors import Visitor, enter, field
from xplain.people.server import SESSION, Keys, RateLimit
from xplain.people.store import Store


def test_nobody_can_be_somebody_else(
    store: Store, app: FastAPI, browser: Callable[[], Visitor]
) -> None:
    one, two = browser(), browser()
    first, second = (
        enter(v, t) for v, t in zip((one, two), store.invite(2, "person"), strict=True)
    )
    # The other one's form with one's own cookie.
    fields = [(n, field(first, n)) for n in ("token", "sequence", "kind", "text")]
    status, _ = two.post("/study", [*fields, ("agree", "1")])
    assert status == 403
    assert field(first, "token") != field(second, "token")
    # A cookie made from the other one's id, without the server's key.
    ids = [*store.people]
    for value in (*ids, f"{ids[0]}.", f"{ids[0]}.{'0' * 64}", "." * 9, "\x00", "é" * 40):
        client = Client(app)
        client.set_cookie(f"participant_{Keys(store.secret).mark}", value)
        assert client.get("/study").status_code == 403
        assert client.post("/events", json={}).status_code == 403


def test_what_is_signed_is_good_for_one_purpose_one_owner_and_one_server() -> None:
    keys, others = Keys(b"k" * 32), Keys(b"o" * 32)
    cookie, token = keys.cookie("anna"), keys.form("anna")
    assert keys.owner(cookie) == "anna"
    assert others.owner(cookie) is None
    assert keys.owner(cookie.replace("anna", "bert")) is None
    assert keys.owner(f"anna.{token}") is None  # a form's token makes no cookie
    assert keys.owns_form("anna", token)
    assert not others.owns_form("anna", token)
    assert not keys.owns_form("bert", token)
    assert not keys.owns_form("anna", cookie.partition(".")[2])
    assert not keys.owns_form("anna", "\ud800")  # half a character, as JSON may bring it
    session = keys.cookie("one", SESSION)
    assert keys.owner(session, SESSION) == "one"
    assert others.owner(session, SESSION) is None
    assert keys.owner(session) is None
    assert keys.owner(keys.cookie("one"), SESSION) is None
    assert keys.is_researcher(keys.researcher)
    assert not keys.is_researcher(others.researcher)
    assert not keys.is_researcher("é")
    assert "kkkk" not in repr(keys)


def test_a_bucket_fills_up_again_and_forgets_the_oldest() -> None:
    now = [0.0]
    limit = RateLimit(2.0, 3.0, lambda: now[0], most=2)
    assert [limit.allows("a") for _ in range(4)] == [True, True, True, False]
    now[0] = 0.5
    assert [limit.allows("a") for _ in range(2)] == [True, False]
    limit.allows("b")
    limit.allows("c")
    assert len(limit._buckets) == 2
    assert limit.allows("a")
