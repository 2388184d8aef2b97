"""The application: the pages put together, and what every request passes through."""

from __future__ import annotations

import base64
import logging
import re
import secrets
import shutil
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, Literal
from urllib.parse import urlsplit

import jinja2
from flask import (
    Blueprint,
    Flask,
    Response,
    make_response,
    redirect,
    render_template,
    request,
    url_for,
)
from jinja2 import ChoiceLoader, PackageLoader, pass_context
from markupsafe import Markup
from pydantic import BaseModel, Field, ValidationError
from werkzeug.datastructures import MultiDict
from werkzeug.exceptions import HTTPException
from werkzeug.middleware.proxy_fix import ProxyFix
from werkzeug.wrappers import Response as AnyResponse

from xplain.errors import Refused
from xplain.people import map_svg
from xplain.people.desk import pages as researcher_pages
from xplain.people.flow import Conflict, Flow, Form, Full, Participant
from xplain.people.http import (
    LOOPBACK,
    MAX_BODY,
    PARTICIPANT,
    BelowPath,
    Context,
    ReadToTheEnd,
    Server,
    context,
    error_page,
    genuine,
    headers,
    owner,
    read_cookie,
    session,
    set_cookie,
)
from xplain.people.store import Gone, Store, Unknown

participant_pages = Blueprint("participant", __name__)
VISITOR = "visitor"
"""The cookie of somebody who has not entered yet; forms are bound to it."""
TAB_KINDS = Literal["visible", "hidden", "label", "recall", "retry", "active"]
MAX_ITEMS = 50
MOST_ANSWERS = 100_000
"""Numbers that no page reaches."""

# Entry -----------------------------------------------------------------------------------------


@participant_pages.get("/")
def entrance() -> AnyResponse:
    """Where invitations and recruiting platforms lead; changes nothing yet."""
    visitor = read_cookie(VISITOR)
    if not (len(visitor) == 32 and visitor.isascii() and visitor.isalnum()):
        visitor = secrets.token_hex(16)
    own = context()
    names = (*own.server.id_names, own.server.signed_name)
    ids = {key: request.args[key][:4000] for key in names if request.args.get(key)}
    response = make_response(
        render_template(
            "entrance.html",
            token=own.keys.form(visitor),
            invitation=request.args.get("invitation", "")[:100],
            ids=ids if {"platform", "signed"} & {*own.server.entry} else {},
            entry=own.server.entry,
        )
    )
    set_cookie(response, VISITOR, visitor)
    return response


@participant_pages.post("/enter")
def enter() -> AnyResponse:
    """Admits, or leads back to where the participant was."""
    own = context()
    if not read_cookie(VISITOR):
        return error_page(403, "no_cookies")
    here = urlsplit(request.host_url).hostname in LOOPBACK
    if own.flow.plan.unedited and not (own.server.demo or here):
        return error_page(403, "not_ready")
    if not genuine(read_cookie(VISITOR)):
        return error_page(403, "old_form")
    ids = {key: request.form.get(key, "") for key in own.server.id_names}
    if "signed" in own.server.entry:
        ids = own.server.verify(request.form.get(own.server.signed_name, ""))
    # Mail programs cut the last character of a link, or add the full stop of a sentence.
    invitation = request.form.get("invitation", "").strip().rstrip(".,;-_)>")
    try:
        if {"platform", "signed"} & {*own.server.entry} and own.server.lets_in([*ids.values()]):
            who = own.store.enter_from_platform(ids, own.server.keep_ids)
        elif invitation and "invitation" in own.server.entry:
            who = own.store.enter_invited(invitation)
        elif "open" in own.server.entry and not invitation:
            who = own.store.enter_open()
        else:
            raise Unknown
    except Unknown:
        return error_page(403, "not_invited")
    except Gone:
        return error_page(410, "erased")
    response = redirect(url_for("participant.show"), 303)
    set_cookie(response, PARTICIPANT, own.keys.cookie(who))
    return response


# The pages of the study ------------------------------------------------------------------------


def _current() -> Participant[Any]:
    """Whose cookie came along."""
    return context().store.participant(owner() or "")


@participant_pages.app_errorhandler(Unknown)
def unknown(error: Unknown) -> AnyResponse:
    """The page for people who are not known."""
    return error_page(403, "no_invitation")


@participant_pages.get("/study")
def show() -> AnyResponse:
    """The page where the participant is."""
    return _page(_current())


def _page(
    found: Participant[Any], problem: str = "", status: int = 200, typed: Form | None = None
) -> Response:
    """The page where somebody is; of a refused form the page that it is of, with what was typed."""
    own = context()
    if typed:
        found = replace(found, state=own.flow.asking(found.state))
    if not found.state.paused:
        own.store.shown(found.id, found.state.accepted, found.state.stage)
    reference = "-".join(re.findall(".{4}", own.store.reference(found.id)))
    flow, code = own.flow, own.code(found)
    html = render_template(
        "ended.html" if found.state.over else f"{found.state.stage}.html",
        **flow.view(found.state),
        kind=flow.waits_for(found.state),
        code=code,
        back=own.back(found, code),
        stages=flow.stages,
        within=flow.part(found.state.stage),
        stream=found.row["stream"],
        typed=typed or MultiDict(),
        token=own.keys.form(found.id),
        problem=own.say(problem),
        reference=reference,
    )
    return make_response(html, status)


@participant_pages.post("/study")
def answer() -> AnyResponse:
    """Accepts an answer, once, and leads on. Says 303 (204 to scripts, which then go on by
    themselves) only when the answer is on the disk."""
    found, own, form = _current(), context(), request.form
    if not genuine(found.id):
        return error_page(403, "not_yours")
    kind, sequence = form.get("kind", "")[:20], form.get("sequence", -1, type=int)
    ms = form.get("ms", -1.0, type=float)
    try:
        if not 0 <= sequence < MOST_ANSWERS:
            raise Refused("not_complete")
        if kind == "time_out":
            raise Refused("not_understood")
        if kind not in ("withdraw", "return") and not own.store.was_shown(found.id, sequence):
            raise Conflict("other_page")  # nobody has seen the page of this answer
        own.store.submit(
            found.id,
            sequence,
            kind,
            own.flow.read(own.store.asked(found, sequence), kind, form),
            ms if 0 <= ms < 1e10 else None,
        )
    except Full as error:
        code = own.server.codes.get("full", "")
        said = f"{own.say(str(error))} {own.say('code')}: {code}" if code else str(error)
        return _page(found, said, 503, form)
    except Conflict as error:
        return _page(own.store.participant(found.id), str(error), 409)
    except Refused as error:
        found = own.store.participant(found.id)
        return _page(found, str(error), 400, form if sequence == found.state.accepted else None)
    if "Study-Script" in request.headers:
        return make_response("", 204)
    return redirect(url_for("participant.show"), 303)


@participant_pages.get("/consent.txt")
def consent() -> AnyResponse:
    """A copy of the consent text to keep."""
    _current()
    texts = context().flow.plan.texts
    content = "\n\n".join([texts.title, *texts.consent, texts.contact, texts.consent_hash])
    kept = {"Content-Disposition": "attachment; filename=consent.txt"}
    return Response(f"{content}\n", mimetype="text/plain", headers=kept)


@participant_pages.get("/picture/<int:number>")
def picture(number: int) -> AnyResponse:
    """An image that belongs to the plan, of a transition."""
    _current()
    shown = context().flow.plan.shown
    found = shown[number].picture if number < len(shown) else None
    if found is None:
        return error_page(404, "no_page")
    return Response(base64.b64decode(found.content), mimetype=found.media)


@participant_pages.post("/events")
def events() -> AnyResponse:
    """A page's own events: seen, hidden, a label clicked. Changes no state."""
    found, own = _current(), context()
    try:
        report = Report.model_validate_json(request.get_data())
        if not own.keys.owns_form(found.id, report.token):
            return make_response({"error": "not yours"}, 403)
        items = [(i.n, str(i.kind), i.ms, {"at": i.at, "what": i.what}) for i in report.items]
        if found.state.stage != "declined":
            own.store.from_tab(found.id, report.tab, items)
    except (ValidationError, Refused):
        return make_response({"error": "not understood, or too much"}, 400)
    return make_response({"kept": len(items)})


# From what a browser sent; nothing of it is trusted ----------------------------------------------


class PageEvent(BaseModel, strict=True):
    """One event of a page: its number there, the page's clock, the browser's wall clock (ms)."""

    n: int = Field(ge=0, lt=100_000)
    kind: TAB_KINDS
    ms: float = Field(ge=0, lt=1e14)
    at: float = Field(ge=0, lt=1e14)
    what: str = Field("", max_length=40)


class Report(BaseModel, strict=True):
    """A page's own events, and its form's token."""

    token: str
    tab: str = Field(pattern=r"^[a-z0-9]{8,32}$")
    items: list[PageEvent] = Field(max_length=MAX_ITEMS)


MARKED = ("participant.answer", "participant.events")
"""Routes whose replies scripts take for an acknowledgement only with the server's mark: a proxy in
between may answer anything."""
RIGHT_TO_LEFT = ("ar", "arc", "ckb", "dv", "fa", "he", "ks", "ps", "sd", "ug", "ur", "yi")
LEAST_FREE = 64 << 20
"""Bytes on the disk below which the server calls itself not well."""
log = logging.getLogger(__name__)
FREE = ("static", "alive", "researcher.login")
"""Routes that take nothing from anybody's limit; the login has one of its own, of wrong keys."""


def create_app(store: Store, server: Server) -> Flask:
    """The application for one open store."""
    app = Flask(__name__)
    # A character takes nine bytes on its way, at most: the page's own limit holds in any language.
    longest = 9 * sum(question.max_length for question in store.flow.plan.lab_questions)
    app.config.update(
        MAX_CONTENT_LENGTH=MAX_BODY + longest,
        MAX_FORM_MEMORY_SIZE=MAX_BODY + longest,
        MAX_FORM_PARTS=200,
    )
    own = app.extensions["study"] = Context(store, server)
    folders = PackageLoader(store.flow.PACKAGE), PackageLoader("xplain.people")
    app.jinja_loader = ChoiceLoader(folders)
    app.jinja_env.trim_blocks = app.jinja_env.lstrip_blocks = True
    app.jinja_env.globals.update(
        drawing(store.flow)
        | {"texts": store.flow.plan.texts, "words": own.words, "mark": own.keys.mark}
        | {"checked": checked, "direction": direction(own.words["language"])}
    )
    app.before_request(_limit)
    app.after_request(_secure)
    app.register_error_handler(HTTPException, _http_error)
    app.register_error_handler(Exception, _failure)
    app.add_url_rule("/alive", "alive", _alive)
    app.register_blueprint(participant_pages)
    app.register_blueprint(researcher_pages)
    if server.proxies:
        app.wsgi_app = ProxyFix(app.wsgi_app, server.proxies, server.proxies)  # type: ignore[method-assign]
    if server.path:
        app.wsgi_app = BelowPath(app.wsgi_app, server.path)  # type: ignore[method-assign]
    app.wsgi_app = ReadToTheEnd(app.wsgi_app)  # type: ignore[method-assign]
    return app


def drawing(flow: Flow[Any, Any]) -> dict[str, Any]:
    """What every template may use of a flow."""
    plan = flow.plan
    return {
        "map": lru_cache(4096)(lambda what: map_svg.picture(plan, *flow.drawn(what))),
        "ahead": lambda steps: map_svg.picture(plan, plan.ahead.way, steps),
        "legend": map_svg.legend(plan, plan.shows_way),
        "about": partial(map_svg.about, plan),
        "changes": plan.changes,
        "pictures": [clip.picture for clip in plan.shown],
        "titles": flow.titles,
    }


def direction(language: str) -> str:
    """In which direction a language is written: "rtl" or "ltr"."""
    return "rtl" if language.lower().split("-")[0] in RIGHT_TO_LEFT else "ltr"


@pass_context
def checked(page: jinja2.runtime.Context, name: str, value: object) -> Markup:
    """The attribute of a choice that was made in a refused form."""
    return Markup(" checked" if str(value) in page["typed"].getlist(name) else "")


def _alive() -> AnyResponse:
    """Whether answers can be taken: the server runs, and its disk has room."""
    free = shutil.disk_usage(context().store.path.parent).free
    said, status = ("alive", 200) if free >= LEAST_FREE else (f"disk full: {free} bytes left", 503)
    return Response(f"{said}\n", status, content_type="text/plain")


def _limit() -> AnyResponse | None:
    if request.endpoint in FREE:
        return None
    who, own = owner() or session(), context()
    limit = own.participant_limit if who else own.visitor_limit
    if limit.allows(who or request.remote_addr or "?"):
        return None
    response = error_page(429, "too_fast")
    response.headers["Retry-After"] = "5"
    return response


def _secure(response: Response) -> Response:
    """Adds the headers. Pages are never stored: back and reload ask the server again."""
    kept = request.endpoint == "static" and response.status_code == 200
    response.headers.update(headers(context().server.frames))
    if request.endpoint in MARKED and response.status_code not in (429, 500):
        response.headers["Study-Mark"] = context().keys.mark
    response.headers["Cache-Control"] = "public, max-age=3600" if kept else "no-store"
    if context().server.https:
        response.headers["Strict-Transport-Security"] = "max-age=31536000"
    return response


def _http_error(error: HTTPException) -> AnyResponse:
    if isinstance(error.code, int) and error.code >= 400:
        texts = {404: "no_page", 405: "not_here", 413: "too_much"}
        return error_page(error.code, texts.get(error.code, "not_understood"))
    return error.get_response()


def _failure(error: Exception) -> Response:
    # Whatever went wrong, the participant gets a page; the log gets the traceback.
    log.error("request failed", exc_info=error)
    return error_page(500, "failed")
