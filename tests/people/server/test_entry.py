"""Entry: invitations, platforms, signed links, a server below a path, and its health page."""

import time
from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jwt
import pandas as pd
import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from starlette.requests import Request

from tests.conftest import Run
from tests.people.street import street_study
from tests.people.visitors import GENEROUS, Client, Opened, arrive, consent, enter, newcomer
from xplain.errors import InputError
from xplain.people import web as application
from xplain.people.bots import Page
from xplain.people.export import write_identifiers
from xplain.people.log import backup
from xplain.people.plan import make_typed
from xplain.people.site import Server, Site, Visit, direction
from xplain.people.store import Store
from xplain.people.study.tables import export
from xplain.people.web import create_app

SECRET = "s" * 40
IDS = {"PROLIFIC_PID": "ann", "STUDY_ID": "s", "SESSION_ID": "x"}
ADDRESS = "https://lab.example.org/robots"
PLATFORM = replace(GENEROUS, entry=("platform",), studies=("s",))
OF_LINK = "PROLIFIC_PID=a&STUDY_ID=s&SESSION_ID=x"


def comes(store: Store, server: Server, query: str = OF_LINK, **changed: str) -> int:
    """Opens a link, and presses the button that its page has, with other values."""
    client = newcomer(store, server).client
    form = Page.of_html(client.get(f"{server.path}/?{query}").text)
    return client.post(f"{server.path}/enter", data={**form.hidden, **changed}).status_code


def signed(folder: Path, key: bytes, **more: Any) -> Server:
    (folder / "key").write_bytes(key)
    return replace(GENEROUS, entry=("signed",), signed_by=str(folder / "key"), **more)


def test_entry_is_as_configured(store: Store) -> None:
    platform = newcomer(store, PLATFORM).client
    html = platform.get("/").text
    assert 'name="invitation"' not in html
    assert "<button>Begin" not in html  # a link without ids lets nobody in
    token, (invitation,) = Page.of_html(html).hidden["token"], store.invite(1, "person")
    ids = {f"id_{name}": value for name, value in IDS.items()}
    refused = ({"invitation": invitation}, {}, {"invitation": ""}, ids | {"token": ""})
    wrong = ({"id_PROLIFIC_PID": "p" * 101}, {"id_PROLIFIC_PID": ""}, {"id_SESSION_ID": ""})
    for data in (*refused, *(ids | one for one in wrong)):
        assert platform.post("/enter", data={"token": token} | data).status_code == 403, data
    assert platform.post("/enter", data=ids | {"token": token}).status_code == 303
    for stream, status in (("bot", 303), ("pilot", 303), ("person", 403)):
        query = f"invitation={store.invite(1, stream)[0]}"
        for server in (PLATFORM, replace(GENEROUS, entry=("open",))):
            assert comes(store, server, query, invitation=query[11:]) == status, stream
    for settings, key in (
        ({"entry": ["anybody"]}, "entry"),
        ({"entry": ["platform", "open"], "studies": ["ours"]}, "entry"),  # a paid person's pilot
        ({"entry": ["signed"]}, "signed_by"),
        ({"entri": ["invitation"]}, "entri"),
        ({"codes": {"screendout": "S1"}}, "codes"),
    ):
        with pytest.raises(InputError, match=rf"server\.{key}"):
            make_typed(Server, "server", settings)


def test_an_id_is_a_person_however_it_is_written(store: Store) -> None:
    for person in ("5f01", "5f01%20", "%095f01"):
        assert comes(store, PLATFORM, f"PROLIFIC_PID={person}&STUDY_ID=s") == 403
        assert comes(store, PLATFORM, f"PROLIFIC_PID={person}&STUDY_ID=s&SESSION_ID=x") == 303
    for person in ("a\0b", "a\x1bb", "a\u202eb", "a\nb"):  # no table can hold these
        assert comes(store, PLATFORM, id_PROLIFIC_PID=person) == 403
    for name in ("token", "invitation", "kind"):  # as the forms' own fields are called
        server = replace(PLATFORM, id_names=(name, "STUDY_ID"))
        assert comes(store, server, f"{name}=5f01&STUDY_ID=s") == 303
    assert len(store.present()) == 1


def test_a_list_of_ids_lets_nobody_else_in(store: Store, tmp_path: Path) -> None:
    """This holds for any platform that sends an id in its address; the file is read when somebody
    comes."""
    file = tmp_path / "ids.txt"
    file.write_bytes("\ufeffann \r\nbert lee\n\n".encode())
    server = Server(entry=("platform",), id_names=("code",), ids=str(file))
    came = ("ann", "made%20up", "", "ann", "carl", "bert%20lee")
    expected = [303, 403, 403, 303, 403, 303]
    assert [comes(store, server, f"code={who}") for who in came] == expected
    file.write_text("ann\ncarl\n")
    assert comes(store, server, "code=carl") == 303
    assert len(store.present()) == 3
    for key, wrong in (("ids", "nowhere"), ("studies", ("s",)), ("id_names", ())):
        with pytest.raises(ValueError, match=rf"server\.{key}"):
            replace(server, **{key: wrong})


def test_ids_that_nobody_signed_let_nobody_in(store: Store, tmp_path: Path) -> None:
    server = signed(tmp_path, SECRET.encode(), signed_name="signed", address=ADDRESS)
    good = {**IDS, "exp": int(time.time()) + 600, "aud": "https://lab.example.org"}
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
    tokens = [*wrong, *[jwt.encode(good, SECRET, "HS256")] * 2]
    assert [comes(store, server, f"signed={one}") for one in tokens] == [403] * 8 + [303] * 2
    assert len(store.present()) == 1
    # No other setting is needed.
    plain = signed(tmp_path, SECRET.encode())
    token = jwt.encode({**IDS, "exp": 1 << 33}, SECRET, "HS256")
    assert comes(store, plain, f"{plain.signed_name}={token}") == 303


def test_a_platform_signs_with_a_key_of_which_the_lab_has_the_public_half(
    store: Store, tmp_path: Path
) -> None:
    pair = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    public = pair.public_key().public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    server = signed(tmp_path, public, signed_name="signed")
    claims = {"prolific": IDS, "exp": int(time.time()) + 600}
    assert comes(store, server, f"signed={jwt.encode(claims, pair, 'RS256')}") == 303
    assert comes(store, server, f"signed={jwt.encode(claims, 'x' * 40, 'HS256')}") == 403


def test_a_browser_without_cookies_is_told_so(store: Store) -> None:
    client = Client(create_app(store, GENEROUS), cookies=False)
    reply = client.post(
        "/enter", data={"token": Page.of_html(client.get("/").text).hidden["token"]}
    )
    assert reply.status_code == 403
    assert "cookies" in reply.text


def test_an_invitation_is_found_however_it_was_copied(store: Store) -> None:
    made = store.invite(200, "person")
    assert all(one.isalpha() for one in made)
    token = made[0]
    blanks = (f"{token}\u200b", f" {token}»", f"{token[:9]} {token[9:]}")
    for copied in (f"{token}.", token.lower(), *blanks):
        assert Page.of_html(enter(newcomer(store), copied)).stage == "consent"
    assert len(store.present()) == 1


@pytest.mark.parametrize("given", ["/robots", ""])
def test_everything_is_below_the_path_of_the_address(store: Store, given: str) -> None:
    """The proxy may remove the path or keep it."""
    client = newcomer(store, replace(GENEROUS, address=ADDRESS, https=False)).client
    entrance = client.get(f"{given}/?invitation=x", headers={"X-Forwarded-Prefix": "/robots"})
    assert 'action="/robots/enter"' in entrance.text
    assert 'href="/robots/static/study.css"' in entrance.text
    assert client.get(f"{given}/static/study.css").status_code == 200
    assert "path=/robots/" in entrance.headers["Set-Cookie"]
    sent = {
        "token": Page.of_html(entrance.text).hidden["token"],
        "invitation": store.invite(1, "person")[0],
    }
    reply = client.post("/robots/enter", data=sent, base_url="http://localhost")
    assert reply.headers["Location"] == "/robots/study"
    # Monitors ask for the head alone, and a path may end in a slash.
    for path in ("/alive", "/", ""):
        assert client.open(f"{given}{path}", method="HEAD").status_code == 200
    for path in ("/researcher/", "/alive/", "/"):
        assert client.get(f"{given}{path}").status_code == 200
    assert client.get(f"{given}/static/../../../etc/passwd").status_code == 404


def test_a_full_disk_is_no_good_health(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    client = newcomer(store).client
    assert client.get("/alive").text == "alive\n"
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(application.shutil, "disk_usage", lambda path: usage(10, 10, 0))
    assert "disk full: 0 bytes left" in client.get("/alive").text
    assert client.get("/alive").status_code == 503


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


def test_after_a_backup_is_restored_nobody_is_lost(
    store: Store, opened: Opened, tmp_path: Path
) -> None:
    """The restored server does not know an open page: it refuses the page's answer, and shows the
    page that it knows."""
    visitor, page = arrive(store)
    backup(store.path, tmp_path / "b.sqlite")  # while the server runs
    with pytest.raises(InputError, match="a new file"):
        backup(store.path, tmp_path / "b.sqlite")
    assert {file.stat().st_mode & 0o777 for file in tmp_path.glob("b.sqlite*")} == {0o600}
    _, _, shown = visitor.answer(page, ("agree", "1"))
    restored = opened(store.flow, name="b")
    visitor.client.app = create_app(restored, GENEROUS)
    status, _, again = visitor.answer(shown)
    assert (status, again.stage) == (409, "consent")
    assert visitor.answer(again, ("agree", "1"))[2].stage == "briefing"


def test_nobody_from_elsewhere_agrees_to_a_consent_that_is_not_edited(
    opened: Opened, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = street_study()
    texts = replace(study.plan.texts, consent=("Responsible: [EDIT: your institution].",))
    store = opened(replace(study, plan=replace(study.plan, texts=texts)))
    for server, host, status in (
        (GENEROUS, "https://lab.example.org", 403),
        (GENEROUS, "http://localhost", 303),
        (replace(GENEROUS, demo=True), "https://lab.example.org", 303),
    ):
        client = newcomer(store, server).client
        token = Page.of_html(client.get("/", base_url=host).text).hidden["token"]
        sent = {"token": token, "invitation": store.invite(1, "pilot")[0]}
        assert client.post("/enter", data=sent, base_url=host).status_code == status
    store.close()
    monkeypatch.setattr("uvicorn.run", lambda *_, **__: print("served"))
    for address, consented, served in (
        ("''", "own", True),
        ("http://localhost:8080", "own", True),
        ("https://lab.example.org", "own", False),
        ("https://lab.example.org", "demo", True),
    ):
        words = (f"database={store.path}", f"server.address={address}", f"consent={consented}")
        code, said, error = run("study", *words)
        assert (code == 0, "served" in said, "[EDIT: …]" not in error) == (served,) * 3, error
        assert "anybody can invent an id" not in error
    assert (
        "anybody can invent an id"
        in run(f"study {' '.join(words)} server.entry=[platform] server.studies=[s]")[2]
    )


def test_two_studies_on_one_host_share_a_browser(store: Store, opened: Opened) -> None:
    """Ports share cookies, but the cookies of one study do not affect the participant of the other
    study."""
    (one, page), other = arrive(store), opened(street_study(), name="other")
    two = newcomer(other)
    two.client.cookies = one.client.cookies
    enter(two, other.invite(1, "person")[0])
    status, _, after = one.answer(page, ("agree", "1"))
    assert (status, after.stage) == (200, "briefing")
    assert Page.of_html(two.get("/study")[1]).stage == "consent"


def test_a_platform_gets_its_id_back_and_a_code_for_each_end(store: Store) -> None:
    back = "https://example.org/credit?who={id}&code={code}"
    with pytest.raises(ValueError, match=r"server\.completion_url"):
        Server(completion_url=back)
    server = replace(GENEROUS, keep_ids=True, completion_url=back, completion_code="C0DE")
    found = store.participant(store.enter_from_platform(IDS | {"PROLIFIC_PID": "a&b"}, keep=True))
    assert (
        Site(store, server).back(found, "C0DE") == "https://example.org/credit?who=a%26b&code=C0DE"
    )
    for token in store.invite(len(store.flow.plan.cells) * 2, "person"):
        consent(store, store.enter_invited(token))
    for codes, code in (({}, ""), ({"full": "FULL1"}, "FULL1")):
        visitor, page = arrive(store, replace(GENEROUS, codes=codes))
        status, html, _ = visitor.answer(page, ("agree", "1"))
        assert status == 503
        assert "There is no free place" in html
        assert ("FULL1" in html) == bool(code)


@pytest.mark.parametrize(
    ("language", "expected"),
    [
        *(("he_IL", "rtl"), ("AR", "rtl"), ("az-Arab-IR", "rtl"), ("iw", "rtl")),
        *(("ar-Latn", "ltr"), ("en_GB", "ltr"), ("zh-Hant-TW", "ltr"), ("arn", "ltr")),
    ],
)
def test_a_script_decides_the_direction_then_the_language(language: str, expected: str) -> None:
    assert direction(language) == expected


@pytest.mark.parametrize(
    ("one", "two", "same"),
    [
        ("192.0.2.1", "192.0.2.1", True),
        ("2001:db8:a:b::1", "2001:db8:a:b::2", True),
        ("2001:db8:a:b::1", "2001:db8:a:c::1", False),
        ("192.0.2.1", "192.0.2.2", False),
        ("unknown", "_hidden", False),
    ],
)
def test_guesses_are_counted_by_person_whatever_the_proxy_writes(
    one: str, two: str, same: bool
) -> None:
    def address(host: str) -> str:
        scope = {"type": "http", "headers": [], "client": (host, 1)}
        return Visit(SimpleNamespace(), Request(scope)).address  # type: ignore[arg-type]

    assert (address(one) == address(two)) == same
