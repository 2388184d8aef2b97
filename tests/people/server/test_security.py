"""Checks of every request: signatures, limits, headers, and errors that are pages."""

from tests.people.client import Client
from tests.people.visitors import Visitor, arrive, enter, field, newcomer
from xplain.people.server import GUESSES, SESSION, Keys, RateLimit, Server
from xplain.people.store import Store


def test_nobody_can_be_somebody_else(store: Store, browser: Visitor) -> None:
    two, tokens = browser.another(), store.invite(2, "person")
    first, second = (enter(v, t) for v, t in zip((browser, two), tokens, strict=True))
    # The other one's form with one's own cookie.
    fields = [(n, field(first, n)) for n in ("token", "sequence", "kind", "text")]
    status, _ = two.post("/study", [*fields, ("agree", "1")])
    assert status == 403
    assert field(first, "token") != field(second, "token")
    # A cookie made from the other one's id, without the server's key.
    ids = [*store.people]
    for value in (*ids, f"{ids[0]}.", f"{ids[0]}.{'0' * 64}", "." * 9, "\x00", "é" * 40):
        client = browser.another().client
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
    limit.allows("c")  # no room is left for the first
    assert [limit.allows("a") for _ in range(4)] == [True, True, True, False]


def test_headers_keep_browsers_strict(client: Client, store: Store) -> None:
    for path in ("/", "/study", "/nowhere", "/researcher", "/static/study.js"):
        headers = client.get(path).headers
        policy = headers["Content-Security-Policy"]
        assert "unsafe" not in policy
        assert "default-src 'none'" in policy
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["X-Frame-Options"] == "DENY"
        assert headers["Referrer-Policy"] == "no-referrer"
        stored = headers["Cache-Control"]
        assert stored == ("public, max-age=3600" if "static" in path else "no-store")
    cookie = client.get("/").headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=lax" in cookie
    secure = newcomer(store, Server(https=True)).client.get("/")
    assert "Secure" in secure.headers["Set-Cookie"]
    assert "max-age" in secure.headers["Strict-Transport-Security"]


def test_too_much_is_turned_away(store: Store) -> None:
    visitor, page = arrive(store)
    good, client, big = {**page.hidden}, visitor.client, "x" * 10_000_000
    assert client.post("/study", data=good | {"agree": big}).status_code == 413
    assert client.post("/events", data=big).status_code in (403, 413)
    assert client.post("/enter", data={"invitation": big}).status_code == 413
    many = {f"field{i}": "" for i in range(5000)}
    assert client.post("/study", data=good | many).status_code in (400, 403, 413)
    assert client.post("/events", data="[" * 60_000).status_code in (400, 403)
    assert [one.state.accepted for one in store.present()] == [0]


def test_requests_are_limited_by_participant_and_by_address(store: Store) -> None:
    slow = {"requests_per_second": 1e-6, "visitors_per_second": 1e-6}
    browser = newcomer(store, Server(burst=20, visitor_burst=10, **slow))
    client, other, keys = browser.client, browser.another().client, Keys(store.secret)
    assert [client.get("/").status_code for _ in range(12)] == [200] * 10 + [429] * 2
    assert client.get("/").headers["Retry-After"] == "5"
    assert client.get("/static/study.css").status_code == 200
    other.set_cookie(f"participant_{keys.mark}", keys.cookie(store.enter_as_pilot()))
    assert other.get("/study").status_code == 200  # not held back by the crowd
    assert {other.get("/study").status_code for _ in range(25)} == {200, 429}


def test_wrong_keys_of_researchers_hold_nobody_back(store: Store) -> None:
    browser = newcomer(store, Server(visitors_per_second=1e-6))
    guesser, researcher, stranger = (browser.another().client for _ in range(3))
    guesses = [guesser.post("/researcher/login", data={"key": f"{n}"}) for n in range(20)]
    assert [reply.status_code for reply in guesses[:GUESSES]] == [403] * GUESSES
    assert guesses[-1].status_code == 429
    assert stranger.get("/").status_code == 200
    key = Keys(store.secret).researcher
    reply = researcher.post("/researcher/login", data={"key": key}, follow_redirects=True)
    assert (reply.status_code, "Overview of the study" in reply.text) == (200, True)
    # A crowd at the address does not hold back who is logged in, either.
    while stranger.get("/").status_code == 200:
        pass
    assert researcher.get("/researcher").status_code == 200
