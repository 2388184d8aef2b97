"""The participants' pages. One address for all of them: it shows where the participant is, so
reload, back button, a second tab or a restart of the server end up at the same place."""

from __future__ import annotations

import functools
import logging
import secrets
from dataclasses import dataclass
from typing import Any

from flask import (
    Flask,
    Response,
    current_app,
    make_response,
    redirect,
    render_template,
    request,
    url_for,
)
from markupsafe import Markup
from werkzeug.exceptions import HTTPException
from werkzeug.middleware.proxy_fix import ProxyFix
from werkzeug.wrappers import Response as AnyResponse

from xplain.errors import InputError
from xplain.participants.server import forms
from xplain.participants.server import map_svg as picture
from xplain.participants.server import security as guard
from xplain.participants.server.slots import Full
from xplain.participants.server.store import Participant, Store, Unknown
from xplain.study.protocol import machine as protocol
from xplain.study.protocol.machine import Refused
from xplain.study.protocol.plan import Study

log = logging.getLogger(__name__)

VISITOR, PARTICIPANT = "visitor", "participant"
TITLES = {
    "consent": "Before you start",
    "briefing": "What you know about the robot",
    "training": "Practice",
    "eligibility": "A short check",
    "evaluation": "Watch the robot",
    "quiz": "What do you know now?",
    "questions": "A few questions",
    "done": "Thank you",
}


@dataclass(frozen=True)
class Server:
    """How the pages are served; no part of the study's plan.

    Attributes:
        entry: who may come in: "invitation", "prolific", "open" (as pilots).
        keep_prolific_ids: whether a platform's ids are stored in clear; else only keyed hashes.
        completion_url: where finished participants may go, "" for nowhere. ``{code}`` in it is
            replaced by the completion code.
        completion_code: one for all (platforms want that), "" for one a participant.
        https: whether the outside world sees https.
        proxies: how many proxies in front add X-Forwarded-For.
        requests_per_second, burst: limit of a participant.
        visitors_per_second, visitor_burst: limit of an address, for those without a cookie.
    """

    entry: tuple[str, ...] = ("invitation", "prolific")
    keep_prolific_ids: bool = False
    completion_url: str = ""
    completion_code: str = ""
    https: bool = False
    proxies: int = 0
    requests_per_second: float = 5.0
    burst: float = 40.0
    visitors_per_second: float = 20.0
    visitor_burst: float = 300.0

    def __post_init__(self) -> None:
        """Raises InputError."""
        object.__setattr__(self, "entry", tuple(self.entry))
        for kind in self.entry:
            if kind not in ("invitation", "prolific", "open"):
                raise InputError("server.entry", kind, "invitation, prolific or open")


@dataclass(frozen=True)
class Context:
    """What every page needs."""

    store: Store
    study: Study
    keys: guard.Keys
    server: Server
    participants: guard.RateLimit
    visitors: guard.RateLimit


def context() -> Context:
    """Of the running application."""
    found: Context = current_app.extensions["study"]
    return found


def create_app(store: Store, server: Server) -> Flask:
    """The application for one open store."""
    from xplain.participants.server.researcher_pages import pages as researcher_pages

    app = Flask(__name__)
    app.config.update(
        MAX_CONTENT_LENGTH=guard.MAX_BODY,
        MAX_FORM_MEMORY_SIZE=guard.MAX_BODY,
        MAX_FORM_PARTS=200,
    )
    app.extensions["study"] = Context(
        store,
        store.study,
        guard.Keys(store.keyed),
        server,
        guard.RateLimit(server.requests_per_second, server.burst),
        guard.RateLimit(server.visitors_per_second, server.visitor_burst),
    )
    app.jinja_env.trim_blocks = app.jinja_env.lstrip_blocks = True
    app.jinja_env.globals.update(
        map=functools.cache(lambda steps: Markup(picture.picture(store.study.plan, steps))),
        legend=[(name, Markup(svg)) for name, svg in picture.legend(store.study.plan)],
        texts=store.study.plan.texts,
        titles=TITLES,
    )
    app.before_request(_limit)
    app.after_request(_secure)
    app.register_error_handler(HTTPException, _http_error)
    app.register_error_handler(Exception, _failure)
    app.add_url_rule("/", "entrance", entrance)
    app.add_url_rule("/enter", "enter", enter, methods=["POST"])
    app.add_url_rule("/study", "show", show)
    app.add_url_rule("/study", "answer", answer, methods=["POST"])
    app.add_url_rule("/events", "events", events, methods=["POST"])
    app.add_url_rule("/alive", "alive", lambda: ("alive\n", {"Content-Type": "text/plain"}))
    app.register_blueprint(researcher_pages)
    if server.proxies:
        app.wsgi_app = ProxyFix(app.wsgi_app, server.proxies, server.proxies)  # type: ignore[method-assign]
    app.wsgi_app = guard.ReadToTheEnd(app.wsgi_app)  # type: ignore[method-assign]
    return app


# Every request ---------------------------------------------------------------------------------


def owner() -> str | None:
    """The participant whose cookie came along, if the cookie is genuine."""
    return context().keys.owner(request.cookies.get(PARTICIPANT, ""))


def _limit() -> AnyResponse | None:
    if request.endpoint in ("static", "alive"):
        return None
    who, own = owner(), context()
    allowed = (
        own.participants.allows(who) if who else own.visitors.allows(request.remote_addr or "?")
    )
    if allowed:
        return None
    response = error_page(429, "That was a little fast. Please wait some seconds and try again.")
    response.headers["Retry-After"] = "5"
    return response


def _secure(response: Response) -> Response:
    kept = request.endpoint == "static" and response.status_code == 200
    return guard.secure(response, context().server.https, kept)


def error_page(status: int, text: str) -> Response:
    """A page that says what is wrong."""
    return make_response(render_template("error.html", text=text, status=status), status)


def _http_error(error: HTTPException) -> AnyResponse:
    if isinstance(error.code, int) and error.code >= 400:
        texts = {
            404: "There is no such page.",
            405: "That cannot be done here.",
            413: "That was too much at once.",
        }
        return error_page(error.code, texts.get(error.code, "The server did not understand that."))
    return error.get_response()


def _failure(error: Exception) -> Response:
    # Whatever went wrong, the participant gets a page; the log gets the traceback.
    log.error("request failed", exc_info=error)
    return error_page(500, "Something went wrong on our side. Your answers so far are safe.")


def set_cookie(response: AnyResponse, name: str, value: str, samesite: str = "Lax") -> None:
    """A cookie that scripts cannot read."""
    https = context().server.https
    response.set_cookie(
        name, value, httponly=True, samesite=samesite, secure=https, max_age=14 * 86400
    )


def _genuine(who: str) -> bool:
    keys = context().keys
    return keys.same(request.form.get("token", ""), keys.form(who))


# Entry -----------------------------------------------------------------------------------------


def entrance() -> AnyResponse:
    """Where invitations and recruiting platforms lead; changes nothing yet."""
    visitor = request.cookies.get(VISITOR, "")
    if not (len(visitor) == 32 and visitor.isascii() and visitor.isalnum()):
        visitor = secrets.token_hex(16)
    own = context()
    prolific = [request.args.get(key, "")[:100] for key in _PROLIFIC]
    page = make_response(
        render_template(
            "entrance.html",
            token=own.keys.form(visitor),
            invitation=request.args.get("invitation", "")[:100],
            prolific=dict(zip(_PROLIFIC, prolific, strict=True)) if all(prolific) else {},
            entry=own.server.entry,
        )
    )
    set_cookie(page, VISITOR, visitor)
    return page


_PROLIFIC = ("PROLIFIC_PID", "STUDY_ID", "SESSION_ID")


def enter() -> AnyResponse:
    """Admits, or leads back to where the participant was."""
    own = context()
    if not _genuine(request.cookies.get(VISITOR, "")):
        return error_page(403, "This form is out of date. Please open your link again.")
    ids = [request.form.get(key, "") for key in _PROLIFIC]
    invitation = request.form.get("invitation", "").strip()
    try:
        if all(ids) and "prolific" in own.server.entry:
            if max(map(len, ids)) > 100:
                raise Unknown
            who = own.store.enter_prolific(
                ids[0], ids[1], ids[2], keep=own.server.keep_prolific_ids
            )
        elif invitation and "invitation" in own.server.entry:
            who = own.store.enter_invited(invitation)
        elif "open" in own.server.entry and not invitation:
            who = own.store.enter_open()
        else:
            raise Unknown
    except Unknown:
        return error_page(
            403, "This invitation is not valid, or it has been used for another session."
        )
    response = redirect(url_for("show"), 303)
    set_cookie(response, PARTICIPANT, own.keys.cookie(who))
    return response


# The pages of the study ------------------------------------------------------------------------


def _current() -> Participant | None:
    who = owner()
    try:
        return context().store.participant(who) if who else None
    except Unknown:
        return None


def show() -> AnyResponse:
    """The page where the participant is."""
    found = _current()
    if found is None:
        return error_page(403, "Please open the link of your invitation to take part.")
    return _page(found)


def _page(found: Participant, problem: str = "", status: int = 200) -> Response:
    own = context()
    view = protocol.page(own.study, found.state)
    stage = found.state.stage
    own.store.shown(found.id, found.state.accepted, stage)
    code = own.server.completion_code or found.code
    return make_response(
        render_template(
            "ended.html" if stage in protocol.ENDS else f"{stage}.html",
            **view,
            token=own.keys.form(found.id),
            kind=protocol.KINDS.get(stage, ""),
            problem=problem,
            code=code,
            back=own.server.completion_url.replace("{code}", code),
            stages=protocol.STAGES if own.study.plan.asked else _WITHOUT_QUESTIONS,
            stream=found.stream,
            recall=own.study.plan.rules.recall,
            n_steps=own.study.plan.n_steps,
        ),
        status,
    )


_WITHOUT_QUESTIONS = tuple(stage for stage in protocol.STAGES if stage != "questions")


def answer() -> AnyResponse:
    """Accepts an answer, once, and leads on. Says 303 only when the answer is on the disk."""
    found = _current()
    if found is None:
        return error_page(403, "Please open the link of your invitation to take part.")
    own, form = context(), request.form
    if not _genuine(found.id):
        return error_page(
            403, "This page belongs to another participant or visit. Please reload it."
        )
    kind = form.get("kind", "")[:20]
    try:
        if kind == "time_out":
            raise Refused("There is no such answer.")
        own.store.submit(
            found.id,
            forms.sequence_of(form),
            kind,
            forms.payload_of(kind, form, own.study, found.state),
            forms.milliseconds(form.get("ms")),
        )
    except Full as error:
        return _page(found, f"{error} Please try again later: this link stays valid.", 503)
    except Refused as error:
        return _page(own.store.participant(found.id), str(error), 400)
    return redirect(url_for("show"), 303)


def events() -> AnyResponse:
    """A page's own events: seen, hidden, a label clicked. Changes no state."""
    found = _current()
    try:
        value: Any = request.get_json(force=True, silent=True)
    except RecursionError:  # brackets within brackets
        value = None
    keys = context().keys
    token = value.get("token") if isinstance(value, dict) else None
    if found is None or not isinstance(token, str) or not keys.same(token, keys.form(found.id)):
        return make_response({"error": "not yours"}, 403)
    try:
        tab, items = forms.tab_items(value)
        context().store.from_tab(found.id, tab, items)
    except Refused as error:
        return make_response({"error": str(error)}, 400)
    return make_response({"kept": len(items)})
