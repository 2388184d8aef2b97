"""What the pages share: the flow and its store as pages show them, a request, and its answers."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
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
"""Bytes of a request; the largest honest one has a few thousand."""
MAX_FIELDS = 200
"""Fields of a form."""
PARTICIPANT, VISITOR, RESEARCHER = "participant", "visitor", "researcher"
"""Cookies of somebody who was let in, of somebody who was not yet, and of a researcher."""
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
RIGHT_TO_LEFT = ("ar", "arc", "ckb", "dv", "fa", "he", "ks", "ps", "sd", "ug", "ur", "yi")


class Site:
    """A flow and its store, as pages show them.

    Attributes:
        sessions: of the researchers who are logged in, until the server ends.
        invitations: made lately, ``{name: tokens}``: shown again where the page is reloaded.
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
        # A character takes nine bytes on its way, at most: the page's limit holds in any language.
        questions = self.flow.plan.lab_questions
        self.most = MAX_BODY + 9 * sum(question.max_length for question in questions)
        self.templates = environment(self.flow)
        self.templates.globals |= {"root": server.path, "mark": self.keys.mark}
        frames = " ".join(server.frames)
        self.headers = HEADERS | {"Content-Security-Policy": POLICY + (frames or "'none'")}
        self.headers |= {} if frames else {"X-Frame-Options": "DENY"}
        if server.https:
            self.headers["Strict-Transport-Security"] = "max-age=31536000"

    def say(self, key: str) -> str:
        """The words of a key; what is no key is said as it is."""
        return self.words.get(key, key)

    def code(self, found: Participant[Any]) -> str:
        """What a participant shows to be paid: one for each way in which a part can end, so that
        nobody who did not finish has the code of those who did."""
        stage, own = found.state.stage, found.identity["code"]
        configured = self.server.codes.get(stage, "")
        if stage == "done":
            return configured or self.server.completion_code or own
        digest = hashlib.sha256(f"{own} {stage}".encode()).digest()
        return configured or "".join(LETTERS[byte % len(LETTERS)] for byte in digest[:8])

    def back(self, found: Participant[Any], code: str) -> str:
        """Where a participant may go at the end; "" for nowhere."""
        person = found.identity.get("kept", {}).get(self.server.id_names[0], "")
        address = self.server.completion_url.replace("{code}", code)
        return address.replace("{id}", quote(person, safe=""))


def environment(flow: Flow[Any, Any]) -> jinja2.Environment:
    """The templates of a flow, and what every one of them may use."""
    folders = [jinja2.PackageLoader(name) for name in (flow.PACKAGE, "xplain.people")]
    found = jinja2.Environment(
        loader=jinja2.ChoiceLoader(folders), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    plan = flow.plan
    found.globals |= {
        "texts": plan.texts,
        "words": flow.words,
        "direction": direction(flow.words["language"]),
        "checked": checked,
        "map": lru_cache(4096)(lambda what: map_svg.picture(plan, *flow.drawn(what))),
        "ahead": lambda steps: map_svg.picture(plan, plan.ahead.way, steps),
        "legend": map_svg.legend(plan, plan.shows_way),
        "about": partial(map_svg.about, plan),
        "changes": plan.changes,
        "pictures": [clip.picture for clip in plan.shown],
        "titles": flow.titles,
    }
    return found


def direction(language: str) -> str:
    """In which direction a language is written: "rtl" or "ltr"."""
    return "rtl" if language.lower().split("-")[0] in RIGHT_TO_LEFT else "ltr"


@jinja2.pass_context
def checked(page: jinja2.runtime.Context, name: str, value: object) -> Markup:
    """The attribute of a choice that was made in a refused form."""
    return Markup(" checked" if str(value) in page["typed"].getlist(name) else "")


@dataclass(frozen=True)
class Visit:
    """A request, and its answers.

    Attributes:
        site: that it came to.
        request: its headers.
        body: what was sent.
    """

    site: Site
    request: Request
    body: bytes = b""

    @cached_property
    def form(self) -> ImmutableMultiDict[str, str]:
        """The fields of the form that was sent. Nothing in it is trusted."""
        text = self.body.decode(errors="replace")
        try:
            fields = parse_qsl(text, keep_blank_values=True, max_num_fields=MAX_FIELDS)
        except ValueError:
            raise HTTPException(400, "not_understood") from None
        return ImmutableMultiDict(fields)

    def field(self, name: str) -> str:
        """The text of a field; "" for none."""
        return str(self.form.get(name, ""))

    def cookie(self, name: str) -> str:
        """What the browser sent; "" for nothing. No other server on this host uses its name."""
        return self.request.cookies.get(f"{name}_{self.site.keys.mark}", "")

    def set_cookie(
        self, reply: Response, name: str, value: str, same_site: Literal["lax", "strict"] = "lax"
    ) -> None:
        """Adds a cookie that scripts cannot read; "" takes it away."""
        server, request = self.site.server, self.request
        # Whoever comes past the proxy is not below its path, and would get no cookie of it back.
        below = request.scope["raw_path"].startswith(f"{server.path}/".encode())
        outside = below or "x-forwarded-prefix" in request.headers
        reply.set_cookie(
            f"{name}_{self.site.keys.mark}",
            value,
            httponly=True,
            # In another page's frame a browser sends only cookies that are meant for it.
            samesite="none" if server.frames else same_site,
            secure=server.https or bool(server.frames),
            path=f"{server.path}/" if outside else "/",
            max_age=14 * 86400 if value else 0,
        )

    @property
    def owner(self) -> str | None:
        """The participant whose cookie came along, if the cookie is genuine."""
        return self.site.keys.owner(self.cookie(PARTICIPANT))

    @property
    def researcher(self) -> str | None:
        """The session of the researcher who is logged in."""
        found = self.site.keys.owner(self.cookie(RESEARCHER), SESSION)
        return found if found in self.site.sessions else None

    @property
    def host(self) -> str:
        """The host name of the server, as the browser typed it, without a port."""
        return re.sub(r":\d*$", "", self.request.headers.get("host", "")).strip("[]")

    @property
    def address(self) -> str:
        """The address of the browser, as the outermost trusted proxy saw it."""
        hops = ",".join(self.request.headers.getlist("x-forwarded-for")).split(",")
        count = min(self.site.server.proxies, len(hops))
        peer = self.request.client.host if self.request.client else ""
        return hops[-count].strip() if count else peer

    @property
    def participant(self) -> Participant[Any]:
        """The participant whose cookie came along."""
        return self.site.store.participant(self.owner or "")

    def genuine(self, who: str | None) -> bool:
        """Whether the form that was sent carries the token of this participant or visitor."""
        return bool(who) and self.site.keys.owns_form(str(who), self.field("token"))

    def page(self, template: str, status: int = 200, **values: Any) -> Response:
        """A page."""
        made = self.site.templates.get_template(template).render(values)
        return HTMLResponse(made, status)

    def error(self, status: int, text: str) -> Response:
        """A page that says what is wrong, by the key of its words or in words."""
        said, known = self.site.say(text), self.owner is not None
        return self.page("error.html", status, text=said, number=status, known=known)

    def lead(self, path: str) -> Response:
        """Leads on to another page."""
        return RedirectResponse(f"{self.site.server.path}{path}", 303)

    def let_in(self, who: str) -> Response:
        """Makes this browser that of a participant."""
        reply = self.lead("/study")
        self.set_cookie(reply, PARTICIPANT, self.site.keys.cookie(who))
        return reply


async def visit(request: Request) -> Visit:
    """The request that came.

    Raises:
        HTTPException: it is too large.
    """
    site, body = request.app.state.site, bytearray()
    async for part in request.stream():
        body += part
        if len(body) > site.most:
            raise HTTPException(413)
    return Visit(site, request, bytes(body))


Visiting = Annotated[Visit, Depends(visit)]
