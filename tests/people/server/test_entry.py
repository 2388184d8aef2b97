"""Ways to enter: signed links, browsers without cookies, a server below a path; and the server's
health."""

from __future__ import annotations

import time
from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from typing import Any

import jwt
import pandas as pd
import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import rsa

from tests.people.client import Client
from tests.people.study.stand_in import street_study
from tests.people.visitors import GENEROUS, Visitor, enter, field
from xplain.errors import InputError
from xplain.people import web as application
from xplain.people.bots import Page
from xplain.people.export import write_identifiers
from xplain.people.log import backup
from xplain.people.plan import make_typed
from xplain.people.server import Server
from xplain.people.store import Store
from xplain.people.study.tables import export
from xplain.people.web import create_app

SECRET = "s" * 40
IDS = {"PROLIFIC_PID": "ann", "STUDY_ID": "s", "SESSION_ID": "x"}
ADDRESS = "https://lab.example.org/robots"


@pytest.fixture
def store(tmp_path: Path) -> Any:
    opened = Store(tmp_path / "s.sqlite", street_study())
    yield opened
    opened.close()


def comes(store: Store, server: Server, token: str) -> int:
    """The status of somebody who opens a link with a signed token, and presses the button."""
    client = Client(create_app(store, server))
    form = client.get(f"{server.path}/?signed={token}").text
    sent = {"token": field(form, "token"), "id_signed": token}
    return client.post(f"{server.path}/enter", data=sent).status_code


def test_ids_that_nobody_signed_let_nobody_in(store: Store, tmp_path: Path) -> None:
    file = tmp_path / "key"
    file.write_text(SECRET)
    server = replace(
        GENEROUS, entry=("signed",), signed_by=str(file), signed_name="signed", address=ADDRESS
    )
    later = int(time.time()) + 600
    good = {**IDS, "exp": later, "aud": "https://lab.example.org"}
    wrong = [
        jwt.encode(good, "t" * 40, "HS256"),
        jwt.encode(good, None, "none"),
        jwt.encode(good | {"exp": 1}, SECRET, "HS256"),
        jwt.encode(good | {"aud": "https://elsewhere.org"}, SECRET, "HS256"),
        jwt.encode(IDS, SECRET, "HS256"),
        jwt.encode(good | {"PROLIFIC_PID": ""}, SECRET, "HS256"),
        "no token",
        "",
    ]
    assert [comes(store, server, token) for token in wrong] == [403] * len(wrong)
    assert comes(store, server, jwt.encode(good, SECRET, "HS256")) == 303
    assert comes(store, server, jwt.encode(good, SECRET, "HS256")) == 303
    assert len(store.people) == 1


def test_a_platform_signs_with_a_key_of_which_the_lab_has_the_public_half(
    store: Store, tmp_path: Path
) -> None:
    pair = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    public = pair.public_key().public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    (tmp_path / "key.pem").write_bytes(public)
    key = jwt.algorithms.RSAAlgorithm.to_jwk(pair.public_key(), as_dict=True)
    jwks = jwt.PyJWKSet([key | {"alg": "RS256", "use": "sig", "kid": "1"}])
    assert jwks.keys
    server = replace(
        GENEROUS, entry=("signed",), signed_by=str(tmp_path / "key.pem"), signed_name="signed"
    )
    claims = {"prolific": IDS, "exp": int(time.time()) + 600}
    assert comes(store, server, jwt.encode(claims, pair, "RS256")) == 303
    # The public half is known to everybody: it must not pass for a secret.
    with pytest.raises(jwt.InvalidKeyError):
        jwt.encode(claims, public, "HS256")
    forged = jwt.encode(claims, "x" * 40, "HS256")
    assert comes(store, server, forged) == 403


def test_a_paid_person_never_becomes_a_pilot_by_a_wrong_link() -> None:
    with pytest.raises(InputError, match=r"server\.entry"):
        make_typed(Server, "server", {"entry": ["platform", "open"], "studies": ["ours"]})
    with pytest.raises(InputError, match=r"server\.signed_by"):
        make_typed(Server, "server", {"entry": ["signed"]})
    with pytest.raises(InputError, match=r"server\.entri"):
        make_typed(Server, "server", {"entri": ["invitation"]})


def test_a_browser_without_cookies_is_told_so(store: Store) -> None:
    client = Client(create_app(store, GENEROUS), cookies=False)
    form = client.get("/").text
    reply = client.post("/enter", data={"token": field(form, "token")})
    assert reply.status_code == 403
    assert "cookies" in reply.text


def test_an_invitation_with_the_full_stop_of_a_sentence_is_found(store: Store) -> None:
    made = store.invite(200, "person")
    assert all(one.isalpha() for one in made)
    visitor = Visitor(Client(create_app(store, GENEROUS)))
    assert Page.of_html(enter(visitor, f"{made[0]}.")).stage == "consent"


@pytest.mark.parametrize("given", ["/robots", ""])
def test_everything_is_below_the_path_of_the_address(store: Store, given: str) -> None:
    """The proxy in front may remove the path or keep it."""
    client = Client(create_app(store, replace(GENEROUS, address=ADDRESS, https=False)))
    entrance = client.get(f"{given}/?invitation=x", headers={"X-Forwarded-Prefix": "/robots"})
    assert 'action="/robots/enter"' in entrance.text
    assert 'href="/robots/static/study.css"' in entrance.text
    assert client.get(f"{given}/static/study.css").status_code == 200
    assert "Path=/robots/" in entrance.headers["Set-Cookie"]
    (token,) = store.invite(1, "person")
    sent = {"token": field(entrance.text, "token"), "invitation": token}
    reply = client.post("/robots/enter", data=sent, base_url="http://localhost")
    assert reply.headers["Location"] == "/robots/study"


def test_a_full_disk_is_no_good_health(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    client = Client(create_app(store, GENEROUS))
    assert client.get("/alive").status_code == 200
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(application.shutil, "disk_usage", lambda path: usage(10, 10, 0))
    assert client.get("/alive").status_code == 503


def test_pages_may_be_shown_in_the_frames_that_are_named(store: Store) -> None:
    survey = "https://survey.example.org"
    shown = Client(create_app(store, replace(GENEROUS, frames=(survey,)))).get("/")
    assert f"frame-ancestors {survey}" in shown.headers["Content-Security-Policy"]
    assert "X-Frame-Options" not in shown.headers
    assert "SameSite=none" in shown.headers["Set-Cookie"]
    other = Client(create_app(store, GENEROUS)).get("/")
    assert "frame-ancestors 'none'" in other.headers["Content-Security-Policy"]


def test_nothing_in_the_data_says_who_is_who_but_a_file_apart(store: Store, tmp_path: Path) -> None:
    who = store.enter_from_platform(IDS, keep=True)
    (one,) = store.present()
    store.snapshot(tmp_path / "copy.sqlite")
    export(tmp_path / "copy.sqlite", tmp_path / "data")
    for file in (tmp_path / "data").glob("*.csv"):
        assert one.identity["code"] not in file.read_text()
        assert "ann" not in file.read_text().replace("cannot", "")
    write_identifiers(store.present(), tmp_path / "identifiers.csv")
    found = pd.read_csv(tmp_path / "identifiers.csv").iloc[0].to_dict()
    assert found == {"participant": who, "completion_code": one.identity["code"], **IDS}


def test_a_backup_is_made_while_the_server_runs(store: Store, tmp_path: Path) -> None:
    (token,) = store.invite(1, "person")
    who = store.enter_invited(token)
    backup(store.path, tmp_path / "backup.sqlite")
    with pytest.raises(InputError, match="a new file"):
        backup(store.path, tmp_path / "backup.sqlite")
    restored = Store(tmp_path / "backup.sqlite", store.flow)
    assert restored.enter_invited(token) == who  # by the key, which came along
    restored.close()


def test_nobody_from_elsewhere_agrees_to_a_consent_that_is_not_edited(tmp_path: Path) -> None:
    study = street_study()
    texts = replace(study.plan.texts, consent=("Responsible: [EDIT: your institution].",))
    unedited = replace(study, plan=replace(study.plan, texts=texts))
    store = Store(tmp_path / "s.sqlite", unedited)
    for server, host, status in (
        (GENEROUS, "https://lab.example.org", 403),
        (GENEROUS, "http://localhost", 303),
        (replace(GENEROUS, demo=True), "https://lab.example.org", 303),
    ):
        client = Client(create_app(store, server))
        token = field(client.get("/", base_url=host).text, "token")
        sent = {"token": token, "invitation": store.invite(1, "pilot")[0]}
        assert client.post("/enter", data=sent, base_url=host).status_code == status
    store.close()


def test_pictures_and_consent_are_for_participants(store: Store) -> None:
    client = Client(create_app(store, GENEROUS))
    for path in ("/consent.txt", "/picture/0"):
        assert client.get(path).status_code == 403


def test_an_answer_to_a_page_that_was_not_shown_is_refused(store: Store) -> None:
    client = Client(create_app(store, GENEROUS))
    visitor = Visitor(client)
    page = Page.of_html(enter(visitor, store.invite(1, "person")[0]))
    agreed = [*page.hidden.items(), ("agree", "1")]
    assert client.post("/study", data=dict(agreed)).status_code == 303  # and is not followed
    unseen = {**page.hidden, "kind": "read", "sequence": "1"}
    assert client.post("/study", data=unseen).status_code == 409
    assert Page.of_html(visitor.get("/study")[1]).stage == "briefing"
    assert client.post("/study", data=unseen).status_code == 303


def test_two_studies_on_one_host_share_a_browser(store: Store, tmp_path: Path) -> None:
    """Ports share cookies: the cookies of one study do not affect the participant of the other."""
    other = Store(tmp_path / "other.sqlite", street_study())
    one, two = (Visitor(Client(create_app(own, GENEROUS))) for own in (store, other))
    two.client.cookies = one.client.cookies
    page = Page.of_html(enter(one, store.invite(1, "person")[0]))
    enter(two, other.invite(1, "person")[0])
    status, html = one.post("/study", [*page.hidden.items(), ("agree", "1")])
    assert (status, Page.of_html(html).stage) == (200, "briefing")
    assert Page.of_html(two.get("/study")[1]).stage == "consent"
    other.close()
