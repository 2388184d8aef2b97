"""The classes that all pages of a study or a collection use: :class:`Site`, the flow with its
store, and :class:`Visit`, a request with its responses."""

import re
import secrets
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Annotated, Any
from urllib.parse import parse_qsl, quote

import jinja2
from fastapi import Depends, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from markupsafe import Markup
from starlette.datastructures import ImmutableMultiDict
from starlette.exceptions import HTTPException

from xplain.people import map_svg
from xplain.people.flow import Flow, Participant
from xplain.people.log import LETTERS
from xplain.people.server import Server
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
        self.words: Mapping[str, str] = self.flow.words
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
        self.templates.globals |= list_globals(self.flow)
        self.templates.globals |= {"root": server.path, "mark": store.mark}
        frames = " ".join(server.frames)
        self.headers = HEADERS | {"Content-Security-Policy": POLICY + (frames or "'none'")}
        self.headers |= {} if frames else {"X-Frame-Options": "DENY"}
        if server.https:
            self.headers["Strict-Transport-Security"] = "max-age=31536000"

    def say(self, key: str) -> str:
        """Returns the text of a key; an unknown key is returned unchanged."""
        return self.words.get(key, key)

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
