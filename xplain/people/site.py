"""The classes that all pages of a study or a collection use: :class:`Site`, the flow with its
store, and :class:`Visit`, a request with its responses."""

import hashlib
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from ipaddress import ip_network
from typing import Annotated, Any, Literal
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
from xplain.people.server import GUESSES, SESSION, Keys, RateLimit, Server
from xplain.people.store import Store

MAX_BODY = 64 * 1024
"""Maximum bytes of a request; the largest valid request has a few thousand."""
MAX_FIELDS = 200
"""Maximum number of fields in a form."""
PARTICIPANT, VISITOR, RESEARCHER = "participant", "visitor", "researcher"
"""Cookie names of an admitted participant, of a visitor before that, and of a researcher."""
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
RIGHT_TO_LEFT = (
    *("ar", "arc", "ckb", "dv", "fa", "he", "iw", "ks", "nqo", "ps", "sd", "syr", "ug", "ur", "yi"),
    *("adlm", "arab", "hebr", "nkoo", "rohg", "syrc", "thaa"),  # scripts, which decide if given
)
_PORT = re.compile(r"^(?:\[(.*)\](?::\d+)?|([^:]*):\d+)$")


class Site:
    """A flow and its store, for the pages.

    Attributes:
        sessions: logged-in researchers, until the server stops.
        invitations: recent invitations, ``{name: tokens}``; shown again when the page is reloaded.
    """

    def __init__(self, store: Store, server: Server) -> None:
        self.store, self.server = store, server
        self.flow: Flow[Any, Any] = store.flow
        self.words: Mapping[str, str] = self.flow.words
        self.keys = Keys(store.secret)
        self.participant_limit = RateLimit(server.requests_per_second, server.burst)
        self.visitor_limit = RateLimit(server.visitors_per_second, server.visitor_burst)
        self.guess_limit = RateLimit(GUESSES / 60, GUESSES)
        self.sessions: set[str] = set()
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
        self.templates.globals |= {"root": server.path, "mark": self.keys.mark}
        frames = " ".join(server.frames)
        self.headers = HEADERS | {"Content-Security-Policy": POLICY + (frames or "'none'")}
        self.headers |= {} if frames else {"X-Frame-Options": "DENY"}
        if server.https:
            self.headers["Strict-Transport-Security"] = "max-age=31536000"

    def say(self, key: str) -> str:
        """Returns the text of a key; an unknown key is returned unchanged."""
        return self.words.get(key, key)

    def code(self, found: Participant[Any]) -> str:
        """Returns a participant's completion code. The code depends on how participation ended, so
        only people who finished have the code for finishing."""
        stage, own = found.state.stage, found.identity["code"]
        configured = self.server.codes.get(stage, "")
        if stage == "done":
            return configured or self.server.completion_code or own
        digest = hashlib.sha256(f"{own} {stage}".encode()).digest()
        return configured or "".join(LETTERS[byte % len(LETTERS)] for byte in digest[:8])

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

    def cookie(self, name: str) -> str:
        """Returns the value of a cookie; "" if it is missing. The name is unique among servers on
        this host."""
        return self.request.cookies.get(f"{name}_{self.site.keys.mark}", "")

    def set_cookie(
        self, reply: Response, name: str, value: str, same_site: Literal["lax", "strict"] = "lax"
    ) -> None:
        """Sets a cookie that scripts cannot read; "" removes it."""
        server, request = self.site.server, self.request
        # A browser that bypasses the proxy uses paths without the prefix, and would not return a
        # cookie for the prefix.
        below = request.scope["raw_path"].startswith(f"{server.path}/".encode())
        outside = below or "x-forwarded-prefix" in request.headers
        reply.set_cookie(
            f"{name}_{self.site.keys.mark}",
            value,
            httponly=True,
            # In another page's frame a browser sends only cookies with SameSite=None.
            samesite="none" if server.frames else same_site,
            secure=server.https or bool(server.frames),
            path=f"{server.path}/" if outside else "/",
            max_age=14 * 86400 if value else 0,
        )

    @property
    def owner(self) -> str | None:
        """The id of the participant in the cookie, if the cookie is genuine."""
        return self.site.keys.owner(self.cookie(PARTICIPANT))

    @property
    def researcher(self) -> str | None:
        """The session of the logged-in researcher."""
        found = self.site.keys.owner(self.cookie(RESEARCHER), SESSION)
        return found if found in self.site.sessions else None

    @property
    def host(self) -> str:
        """The server's host name in the request, without a port."""
        return re.sub(r":\d*$", "", self.request.headers.get("host", "")).strip("[]")

    @property
    def address(self) -> str:
        """The browser's address without a port, as the first trusted proxy saw it. For IPv6 this is
        the network's address, because one person has all addresses of a network."""
        hops = ",".join(self.request.headers.getlist("x-forwarded-for")).split(",")
        count = min(self.site.server.proxies, len(hops))
        peer = self.request.client.host if self.request.client else ""
        found = _PORT.sub(r"\1\2", hops[-count].strip() if count else peer)
        with suppress(ValueError):
            return str(ip_network((found, 64 if ":" in found else 32), strict=False))
        return found

    @property
    def participant(self) -> Participant[Any]:
        """The participant of the cookie."""
        return self.site.store.participant(self.owner or "")

    def genuine(self, who: str | None) -> bool:
        """True if the sent form has the token of this participant or visitor."""
        return bool(who) and self.site.keys.owns_form(str(who), self.field("token"))

    def page(self, template: str, status: int = 200, **values: Any) -> Response:
        """Renders a page."""
        made = self.site.templates.get_template(template).render(values)
        return HTMLResponse(made, status)

    def error(self, status: int, text: str) -> Response:
        """Renders a page with an error message; ``text`` is a key of the flow's words, or the
        message itself."""
        said, known = self.site.say(text), self.owner is not None
        return self.page("error.html", status, text=said, number=status, known=known)

    def lead(self, path: str) -> Response:
        """Redirects to another page."""
        return RedirectResponse(f"{self.site.server.path}{path}", 303)

    def let_in(self, who: str) -> Response:
        """Sets the cookie that identifies the browser's participant, and redirects to the study."""
        reply = self.lead("/study")
        self.set_cookie(reply, PARTICIPANT, self.site.keys.cookie(who))
        return reply


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
