"""The classes that all pages of a study or a collection use: :class:`Server`, the settings;
:class:`Site`, the flow with its store; and :class:`Visit`, a request with its responses."""

import re
import secrets
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal, get_args
from urllib.parse import parse_qsl, quote, urlsplit

import jinja2
import jwt
import pydantic
from fastapi import Depends, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from markupsafe import Markup
from starlette.datastructures import ImmutableMultiDict
from starlette.exceptions import HTTPException

from xplain.errors import InputError
from xplain.people import map_svg
from xplain.people.flow import Flow, Participant
from xplain.people.log import LETTERS
from xplain.people.store import Store

MAX_BODY = 64 * 1024
"""Maximum bytes of a request; the largest valid request has a few thousand."""
MAX_FIELDS = 200
"""Maximum number of fields in a form."""
POLICY = (
    "default-src 'none'; style-src 'self'; script-src 'self'; connect-src 'self'; img-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors "
)
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=(), interest-cohort=()",
}
DIGITS = str.maketrans("0123456789abcdef", LETTERS[:16])
"""Makes letters of a code from the digits of a hash."""
RIGHT_TO_LEFT = (
    *("ar", "arc", "ckb", "dv", "fa", "he", "iw", "ks", "nqo", "ps", "sd", "syr", "ug", "ur", "yi"),
    *("adlm", "arab", "hebr", "nkoo", "rohg", "syrc", "thaa"),  # scripts, which decide if given
)

Ending = Literal["declined", "screened_out", "ineligible", "withdrawn", "timed_out", "full"]
"""Ends that can have their own completion code, besides the normal end."""
LEAST_KEY, LEAST_SECRET = 12, 32
"""Minimum characters of the researcher's key, and minimum bytes of a secret that signs links."""
LOOPBACK = ("127.0.0.1", "localhost", "::1", "0.0.0.0", "::")
"""Hosts whose links work only on the server's own computer."""


@pydantic.dataclasses.dataclass(frozen=True, config={"strict": True, "extra": "forbid"})
class Server:
    """Settings of the server of the pages; not part of the study's plan.

    Attributes:
        entry: ways to enter for people: "invitation"; "platform", with ids in the link (anybody can
            invent ids); "signed", with ids that the platform or the lab has signed; "open", as a
            pilot. Invitations for pilots and bots are always valid.
        id_names: names of the link's parameters with the person's id and, if present, the ids of
            study and session.
        studies: ids of the platform's studies whose people may take part; none allows all studies.
        ids: a file of persons' ids, one on each line, read at every arrival; only these people may
            take part. "" allows all people of the studies.
        signed_by: with "signed": a file with the platform's public key (PEM, or its JSON Web Key
            Set), or with a secret of the lab of 32 bytes or more.
        signed_name: the link's parameter with the signed token (a JSON Web Token).
        keep_ids: True stores a platform's ids themselves, False only their keyed hashes.
        completion_url: address for finished participants, "" for none. ``{code}`` in it is replaced
            by the completion code, ``{id}`` by the person's id.
        completion_code: one code for all participants who finish (platforms need that); "" makes a
            code for each participant.
        codes: ``{end: code}``, as ``completion_code``, for the other ends.
        address: the public address with its path, such as ``https://lab.example.org/robots``; ""
            takes it from each request.
        frames: addresses of pages, such as a survey, that may show the study in a frame.
        key: the researcher's key, of 12 characters or more; "" lets the server make a key.
        demo: True admits people as pilots although the consent text is not edited.
        blinded: True hides types and conditions on the researcher's page.
        https: True if the public address uses https.
    """

    entry: tuple[Literal["invitation", "platform", "signed", "open"], ...] = ("invitation",)
    id_names: tuple[str, ...] = ("PROLIFIC_PID", "STUDY_ID", "SESSION_ID")
    studies: tuple[str, ...] = ()
    ids: str = ""
    signed_by: str = ""
    signed_name: str = "token"
    keep_ids: bool = False
    completion_url: str = ""
    completion_code: str = ""
    codes: Mapping[Ending, str] = field(default_factory=lambda: dict.fromkeys(get_args(Ending), ""))
    address: str = ""
    frames: tuple[str, ...] = ()
    key: str = ""
    demo: bool = False
    blinded: bool = True
    https: bool = False

    def __post_init__(self) -> None:
        """Raises InputError if keys contradict each other, or if a file cannot be read."""
        names, entry, studies = list(self.id_names), list(self.entry), list(self.studies)
        back, signed = self.completion_url, "signed" in entry
        # key: value, True if the value is not allowed, what is allowed
        rules: list[tuple[str, object, bool, str]] = [
            ("id_names", names, not 1 <= len(names) <= 3, "1 to 3 names: of a person's id, a "
             "study's id and a session's id"),
            ("studies", studies, bool(studies) and len(names) < 2, "none, because id_names has no "
             "study"),
            ("studies", [], "platform" in entry and not (studies or self.ids), "ids of the studies "
             "whose people may take part, or server.ids=FILE of people's ids"),
            # A paid person with an incomplete link would become a pilot without usable data.
            ("entry", entry, "open" in entry and self.from_platform, "open without platform and "
             "signed"),
            ("signed_by", self.signed_by, signed != bool(self.signed_by), "a file with the key if "
             "server.entry has signed, otherwise none"),
            ("completion_url", back, "{id}" in back and not self.keep_ids, "an address without "
             "{id}, or server.keep_ids=true"),
            ("key", "…", 0 < len(self.key) < LEAST_KEY, f"{LEAST_KEY} characters or more, or none"),
            ("address", self.address, bool(self.address) and not urlsplit(self.address).netloc,
             "an address with https:// or http://, such as https://lab.example.org/robots"),
        ]  # fmt: skip
        for key, value, wrong, allowed in rules:
            if wrong:
                raise InputError(f"server.{key}", value, allowed)
        if self.ids:
            self.read_ids()
        if self.signed_by:
            self.verify("")

    @property
    def path(self) -> str:
        """The path of the address, a prefix of every route, link and cookie; "" for none."""
        return urlsplit(self.address).path.rstrip("/")

    @property
    def from_platform(self) -> bool:
        """True if people enter with a platform's ids, signed or not."""
        return bool({"platform", "signed"} & {*self.entry})

    def read_ids(self) -> set[str]:
        """Reads the ids in the file ``ids``.

        Raises:
            InputError: the file cannot be read.
        """
        try:
            lines = Path(self.ids).read_text(encoding="utf-8-sig").splitlines()
            return {line.strip() for line in lines} - {""}
        except (OSError, UnicodeDecodeError) as error:
            raise InputError("server.ids", self.ids, f"a file of ids ({error})") from None

    def lets_in(self, ids: Sequence[str]) -> bool:
        """True if a person may take part; ``ids`` are the person's values of the parameters
        ``id_names``."""
        whole = bool(ids) and all(0 < len(one) <= 100 and one.isprintable() for one in ids)
        of_study = not self.studies or ids[1] in self.studies
        return whole and of_study and (not self.ids or ids[0] in self.read_ids())

    def verify(self, token: str) -> dict[str, str]:
        """Reads the ids in a signed token, by the names in ``id_names``; empty if the token has
        expired or is not genuine.

        Raises:
            InputError: the file with the key cannot be used.
        """
        wanted = "a file with a public key (PEM or JWKS), or a secret of 32 bytes or more"
        try:
            text = Path(self.signed_by).read_text(encoding="utf-8").strip()
            keys: list[tuple[Any, list[str]]] = [(text, ["HS256"])]
            if text.startswith("{"):
                known = jwt.PyJWKSet.from_json(text).keys
                keys = [(one.key, [one.algorithm_name]) for one in known]
            elif text.startswith("-----BEGIN PUBLIC KEY"):
                keys = [(text, ["RS256", "ES256", "EdDSA"])]
            elif len(text.encode()) < LEAST_SECRET:
                raise ValueError("neither")
        except (OSError, ValueError, jwt.PyJWTError) as error:
            raise InputError("server.signed_by", self.signed_by, f"{wanted} ({error})") from None
        for key, algorithms in keys:
            with suppress(jwt.PyJWTError):
                options: Any = {"require": ["exp"], "verify_aud": False}
                claims = jwt.decode(token, key, algorithms=algorithms, options=options)
                audience = str(claims.get("aud", self.address))
                if urlsplit(audience).netloc == urlsplit(self.address).netloc:
                    ids = claims.get("prolific", claims)
                    return {name: str(ids.get(name, "")) for name in self.id_names}
        return {}


class Site:
    """A flow and its store, for the pages.

    Attributes:
        sessions: logged-in researchers, until the server stops.
        guesses: number of wrong researcher's keys in each minute from each address.
        invitations: recent invitations, ``{name: tokens}``; shown again when the page is reloaded.
    """

    def __init__(self, store: Store, server: Server) -> None:
        self.store, self.server = store, server
        self.flow: Flow[Any, Any] = store.flow
        self.sessions: set[str] = set()
        self.guesses: Counter[tuple[int, str]] = Counter()
        self.invitations: dict[str, list[str]] = {}
        # A character takes at most nine bytes, so the page's limit holds in any language.
        questions = (*self.flow.plan.before, *self.flow.plan.asked)
        self.most = MAX_BODY + 9 * sum(question.max_length for question in questions)
        folders = [jinja2.PackageLoader(name) for name in (self.flow.PACKAGE, "xplain.people")]
        self.templates = jinja2.Environment(
            loader=jinja2.ChoiceLoader(folders),
            autoescape=True,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        own = {"root": server.path, "mark": store.mark}
        self.templates.globals |= list_globals(self.flow) | own
        frames = " ".join(server.frames) or "'none'"
        self.headers = HEADERS | {"Content-Security-Policy": POLICY + frames}
        self.headers |= {} if server.frames else {"X-Frame-Options": "DENY"}
        self.headers |= {"Strict-Transport-Security": "max-age=31536000"} if server.https else {}

    def say(self, key: str) -> str:
        """Returns the text of a key; an unknown key is returned unchanged."""
        return self.flow.words.get(key, key)

    def token(self, who: str) -> str:
        """Makes the token that is in every form of a participant, visitor or researcher."""
        return self.store.hash_texts("form", who)

    def code(self, found: Participant[Any]) -> str:
        """Returns a participant's completion code. The code depends on how participation ended, so
        only people who finished have the code for finishing."""
        stage, digits = (
            found.state.stage,
            self.store.hash_texts("code", found.id, found.state.stage),
        )
        own = {"done": found.identity["code"]}.get(stage, digits[:8].translate(DIGITS))
        codes: Mapping[str, str] = {"done": self.server.completion_code} | {**self.server.codes}
        return codes.get(stage) or own

    def back(self, found: Participant[Any], code: str) -> str:
        """Returns the address that a participant's last page links to; "" if none is configured."""
        person = found.identity.get("kept", {}).get(self.server.id_names[0], "")
        address = self.server.completion_url.replace("{code}", code)
        return address.replace("{id}", quote(person, safe=""))


def list_globals(flow: Flow[Any, Any]) -> dict[str, Any]:
    """Lists the texts and functions that all templates of a flow's pages may use."""
    plan = flow.plan
    return {
        "texts": plan.texts,
        "words": flow.words,
        "direction": direction(flow.words["language"]),
        "checked": checked,
        "map": lru_cache(4096)(lambda what: map_svg.picture(plan, *flow.find_drawing(what))),
        "ahead": lambda steps: map_svg.picture(plan, plan.ahead.way, steps),
        "legend": map_svg.legend(plan),
        "about": partial(map_svg.about, plan),
        "clips": plan.shown,
    }


def direction(language: str) -> str:
    """Returns the writing direction of a language: "rtl" or "ltr"."""
    first, *others = re.split("[-_]", language.lower())
    script = next((one for one in others if len(one) == 4 and one.isalpha()), first)
    return "rtl" if script in RIGHT_TO_LEFT else "ltr"


@jinja2.pass_context
def checked(page: jinja2.runtime.Context, name: str, value: object) -> Markup:
    """Returns the HTML attribute ``checked`` if a refused form had this choice; "" otherwise."""
    return Markup(" checked" if str(value) in page["typed"].getlist(name) else "")


@dataclass(frozen=True)
class Visit:
    """A request and its responses.

    Attributes:
        site: the site that received the request.
        request: headers of the request.
        body: body of the request.
    """

    site: Site
    request: Request
    body: bytes = b""

    @cached_property
    def form(self) -> ImmutableMultiDict[str, str]:
        """The fields of the sent form, which are not trusted."""
        text = self.body.decode(errors="replace")
        try:
            fields = parse_qsl(text, keep_blank_values=True, max_num_fields=MAX_FIELDS)
        except ValueError:
            raise HTTPException(400, "not_understood") from None
        return ImmutableMultiDict(fields)

    def field(self, name: str) -> str:
        """Returns the text of a field; "" if it is missing."""
        return str(self.form.get(name, ""))

    @property
    def session(self) -> dict[str, str]:
        """The content of the signed cookie: the ids of the browser's ``visitor`` and
        ``participant``, and of the session of a logged-in ``researcher``."""
        return self.request.session

    @property
    def researcher(self) -> str:
        """The session of the logged-in researcher; "" for none."""
        found = self.session.get("researcher", "")
        return found if found in self.site.sessions else ""

    @property
    def host(self) -> str:
        """The server's host name in the request, without a port."""
        return re.sub(r":\d*$", "", self.request.headers.get("host", "")).strip("[]")

    @property
    def address(self) -> str:
        """The browser's address. For IPv6 this is the network's address, because one person has all
        addresses of a network."""
        found = self.request.client.host if self.request.client else ""
        return ":".join(found.split(":")[:4])

    @property
    def participant(self) -> Participant[Any]:
        """The participant of the cookie."""
        return self.site.store.participant(self.session.get("participant", ""))

    def genuine(self, who: str) -> bool:
        """True if the sent form has the token of this participant, visitor or researcher."""
        return self.owns(who, self.field("token"))

    def owns(self, who: str, token: str) -> bool:
        """True if this is the token of this participant, visitor or researcher."""
        sent, own = (text.encode(errors="replace") for text in (token, self.site.token(who)))
        return bool(who) and secrets.compare_digest(sent, own)

    def page(self, template: str, status: int = 200, **values: Any) -> Response:
        """Renders a page."""
        made = self.site.templates.get_template(template).render(values)
        return HTMLResponse(made, status)

    def error(self, status: int, text: str) -> Response:
        """Renders a page with an error message; ``text`` is a key of the flow's words, or the
        message itself."""
        said, known = self.site.say(text), "participant" in self.session
        return self.page("error.html", status, text=said, number=status, known=known)

    def lead(self, path: str) -> Response:
        """Redirects to another page."""
        return RedirectResponse(f"{self.site.server.path}{path}", 303)

    def let_in(self, who: str) -> Response:
        """Sets the cookie that identifies the browser's participant, and redirects to the study."""
        self.session["participant"] = who
        return self.lead("/study")


async def visit(request: Request) -> Visit:
    """Reads the request.

    Raises:
        HTTPException: the request is too large.
    """
    site, body = request.app.state.site, bytearray()
    async for part in request.stream():
        body += part
        if len(body) > site.most:
            raise HTTPException(413)
    return Visit(site, request, bytes(body))


Visiting = Annotated[Visit, Depends(visit)]
