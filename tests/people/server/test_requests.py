"""Checks of every request: signatures, limits, headers, errors that are pages; forms with valid,
nearly valid and invalid fields."""

import re
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.people.street import flow_of, street_study
from tests.people.visitors import (
    GENEROUS,
    Client,
    Opened,
    Visitor,
    arrive,
    enter,
    newcomer,
    query,
)
from xplain.errors import InputError, Refused
from xplain.people.bots import Page
from xplain.people.desk import GUESSES
from xplain.people.plan import LabQuestion, lab_questions, make_typed
from xplain.people.site import Server
from xplain.people.store import Store


def test_nobody_can_be_somebody_else(store: Store, browser: Visitor) -> None:
    two, tokens = browser.another(), store.invite(2, "person")
    pages = (enter(v, t) for v, t in zip((browser, two), tokens, strict=True))
    first, second = (Page.of_html(page).hidden for page in pages)
    # The other one's form with one's own cookie.
    status, _ = two.post("/study", [*first.items(), ("agree", "1")])
    assert status == 403
    assert first["token"] != second["token"]
    # A cookie made from the other one's id, without the server's key.
    ids = [one.id for one in store.present()]
    for value in (*ids, f"{ids[0]}.", f"{ids[0]}.{'0' * 64}", "." * 9, "\x00", "é" * 40):
        client = browser.another().client
        client.set_cookie(f"study_{store.mark}", value)
        for path in ("/study", "/consent.txt", "/picture/0"):
            assert client.get(path).status_code == 403
        assert client.post("/events", json={}).status_code == 403


def test_what_is_signed_is_good_for_one_owner_and_one_server(store: Store, opened: Opened) -> None:
    (visitor, page), other = arrive(store), opened(street_study(), name="other")
    cookie, _ = visitor.client.cookies[f"study_{store.mark}"]
    content, _, signature = cookie.partition(".")
    cookies = (f"{content[:-8]}AAAAAAAA.{signature}", content, signature)
    for own, forged in ((store, cookies), (other, (cookie,))):
        client = newcomer(own).client
        for value in forged:
            client.set_cookie(f"study_{own.mark}", value)
            assert client.get("/study").status_code == 403
    (who,) = (one.id for one in store.present())
    assert page.hidden["token"] not in (other.hash_texts("form", who), cookie, store.researcher_key)
    assert store.researcher_key != other.researcher_key


STRICT = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
}


def test_headers_keep_browsers_strict(client: Client, store: Store) -> None:
    for path in ("/", "/study", "/nowhere", "/researcher", "/static/study.js"):
        headers = client.get(path).headers
        policy = headers["Content-Security-Policy"]
        assert "unsafe" not in policy
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        assert [headers[name] for name in STRICT] == [*STRICT.values()]
        stored = headers["Cache-Control"]
        assert stored == ("public, max-age=3600" if "static" in path else "no-store")
    cookie = newcomer(store).client.get("/").headers["Set-Cookie"]
    assert "httponly" in cookie
    assert "samesite=lax" in cookie
    survey = "https://survey.example.org"
    framed = newcomer(store, replace(GENEROUS, frames=(survey,))).client.get("/").headers
    assert f"frame-ancestors {survey}" in framed["Content-Security-Policy"]
    assert "X-Frame-Options" not in framed
    assert "samesite=none" in framed["Set-Cookie"]
    secure = newcomer(store, Server(https=True)).client.get("/")
    assert "secure" in secure.headers["Set-Cookie"]
    assert "max-age" in secure.headers["Strict-Transport-Security"]


def test_too_much_is_turned_away(store: Store) -> None:
    visitor, page = arrive(store)
    good, client, big = {**page.hidden}, visitor.client, "x" * 10_000_000
    reply = client.post("/study", data=good | {"agree": big})
    assert (reply.status_code, WORDS["too_much"] in reply.text) == (413, True)
    assert client.post("/events", data=big).status_code in (403, 413)
    assert client.post("/enter", data={"invitation": big}).status_code == 413
    many = {f"field{i}": "" for i in range(5000)}
    assert client.post("/study", data=good | many).status_code in (400, 403, 413)
    assert client.post("/events", data="[" * 60_000).status_code in (400, 403)
    assert [one.state.accepted for one in store.present()] == [0]


def test_wrong_keys_of_researchers_hold_nobody_back(store: Store, browser: Visitor) -> None:
    guesser, researcher = browser.client, browser.another().client
    guesses = [guesser.post("/researcher/login", data={"key": f"{n}é"}) for n in range(20)]
    assert [reply.status_code for reply in guesses[:GUESSES]] == [403] * GUESSES
    assert guesses[-1].status_code == 429
    key = {"key": store.researcher_key}
    reply = researcher.post("/researcher/login", data=key, follow_redirects=True)
    assert (reply.status_code, "Overview of the study" in reply.text) == (200, True)


WORDS = flow_of("study").words


def test_forged_answers_are_turned_away_and_leave_no_trace(store: Store) -> None:
    visitor, page = arrive(store)
    good = {**page.hidden, "agree": "1"}
    before = query(store, "SELECT * FROM event")
    for forged in (
        *({"token": ""}, {"token": "0" * 64}, {"sequence": "1"}, {"sequence": "-1"}),
        *({"sequence": "٣"}, {"sequence": "9" * 4000}, {"sequence": ""}, {"kind": "labels"}),
        *({"kind": "time_out"}, {"kind": "<script>"}, {"agree": "2"}, {"agree": "true"}),
        {"text": "0" * 64},
        # What only the server decides is not heard.
        {"agree": "", "user_type": "1", "condition": "conformant", "orders": "{}"},
    ):
        status, _ = visitor.post("/study", list((good | forged).items()))
        assert 400 <= status < 500, forged
    visitor.client.cookies.clear()
    assert visitor.client.post("/study", data=good).status_code == 403
    assert before == query(store, "SELECT * FROM event")


ITEM = {"n": 0, "kind": "visible", "ms": 1.5, "at": 1e12, "what": "consent"}


@pytest.mark.parametrize(
    "change",
    [
        *({"tab": "short"}, {"tab": 5}, {"items": {}}, {"items": [5]}, {"items": [{"n": 0}] * 51}),
        *({"token": None}, {"token": "0" * 64}),
        *({"items": [ITEM | wrong]} for wrong in ({"n": -1}, {"n": True}, {"kind": "labels"})),
        *({"items": [ITEM | wrong]} for wrong in ({"ms": float("nan")}, {"ms": 1e300})),
        *({"items": [ITEM | wrong]} for wrong in ({"at": "1"}, {"what": "x" * 41})),
    ],
)
def test_reports_of_pages_are_checked(store: Store, change: dict[str, Any]) -> None:
    visitor, page = arrive(store)
    good = {"token": page.hidden["token"], "tab": "0123456789abcdef", "items": [ITEM]}
    assert visitor.client.post("/events", json=good).status_code == 200
    assert 400 <= visitor.client.post("/events", json=good | change).status_code < 500
    assert query(store, "SELECT count(*) AS n FROM event WHERE kind = 'visible'") == [{"n": 1}]


def test_a_refused_form_keeps_what_was_filled_in(opened: Opened) -> None:
    asked = (
        {"name": "age", "label": "Age", "kind": "number", "low": 18, "high": 110},
        {"name": "story", "label": "Your story", "kind": "text"},
        {"name": "often", "label": "How often?", "kind": "choice", "choices": ["never", "often"]},
    )
    visitor, page = arrive(opened(street_study(before=asked, questions=[])))
    _, _, page = visitor.answer(page, ("agree", "1"))
    own = {"age": "12.0", "story": "A long <story>.", "often": "often"}
    fields = [(f"answer_{name}", value) for name, value in own.items()]
    status, html, _ = visitor.answer(page, *fields)
    assert status == 400
    assert 'name="answer_age" value="12.0"' in html
    assert re.findall(">(.*)</textarea>", html) == ["A long &lt;story&gt;."]
    assert re.findall('value="([^"]*)"[^>]* checked', html) == ["often"]


def test_questions_that_cannot_be_asked_are_refused() -> None:
    asked = {"name": "q", "label": "Q", "kind": "choice", "choices": [True, False]}
    with pytest.raises(InputError, match="questions"):  # a truth value is no choice
        make_typed(LabQuestion, "questions", asked)
    with pytest.raises(InputError, match="one name for each question"):  # over all pages
        lab_questions([{"name": "age", "label": "Age"}], [{"name": "age", "label": "Age"}])


def test_a_question_may_have_any_name(opened: Opened) -> None:
    """A question may have the name of a form's field or of a script."""
    names = ("getAttribute", "querySelector", "token", "connection", "ms")
    asked = {"label": "Q", "kind": "choice", "choices": ["a", "b"], "required": True}
    store = opened(street_study(before=[asked | {"name": name} for name in names]))
    visitor, page = arrive(store)
    _, _, shown = visitor.answer(page, ("agree", "1"))
    assert len(shown.fields) == len(names)
    assert shown.fields.keys().isdisjoint({*names, *shown.hidden})
    assert visitor.answer(shown, *((own, "b") for own in shown.fields))[2].stage == "briefing"
    assert store.everybody()[0].first("screening") == dict.fromkeys(names, "b")


@pytest.mark.parametrize(
    ("given", "stored"),
    [
        *(
            ("30", "30"),
            ("30.0", "30"),
            ("-5", "-5"),
            ("-05.", "-5"),
            ("", ""),
            (" 7 ", "7"),
            ("50", "50"),
        ),
        *(("٣٠", "30"), ("３０", "30"), ("۳۰.0", "30"), ("−5", "-5")),  # digits of any script
    ],
)
def test_whole_numbers_are_read_as_browsers_let_them_pass(given: str, stored: str) -> None:
    cold = LabQuestion("cold", "How cold?", "number", low=-50, high=50)
    assert cold.read(given, WORDS) == stored
    for wrong in ("51", "²", "٥١", "-51", "18.5", "9" * 10, "9" * 5000):
        with pytest.raises(Refused, match="50"):
            replace(cold, max_length=10_000).read(wrong, WORDS)


@given(st.text(max_size=40) | st.sampled_from(["30.0", "-05.", "+7"]))
def test_what_a_browser_lets_one_type_is_accepted(text: str) -> None:
    """``maxlength`` counts UTF-16 units, and a line end as one; a form sends line ends as two."""
    asked = LabQuestion("story", "Story", max_length=max(len(text.encode("utf-16-le")) // 2, 1))
    lines = text.replace("\r\n", "\n")
    kept = "".join(sign for sign in lines if sign in "\t\n" or ord(sign) >= 32)
    assert asked.read(lines.replace("\n", "\r\n"), WORDS) == kept.strip()


def test_the_longest_answers_of_a_page_fit_into_a_request(opened: Opened) -> None:
    essay = {"name": "essay", "label": "Write", "max_length": 8000, "required": True}
    visitor, page = arrive(opened(street_study(before=[essay])))
    _, _, shown = visitor.answer(page, ("agree", "1"))
    assert visitor.answer(shown, ("answer_essay", "机" * 8000))[2].stage == "briefing"
