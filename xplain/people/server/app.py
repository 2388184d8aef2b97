"""The application: the pages put together, and what every request passes through."""

from __future__ import annotations

import logging
import shutil

import jinja2
from flask import Flask, Response, request
from jinja2 import ChoiceLoader, FileSystemLoader, pass_context
from markupsafe import Markup
from werkzeug.exceptions import HTTPException
from werkzeug.middleware.proxy_fix import ProxyFix
from werkzeug.wrappers import Response as AnyResponse

from xplain.people.server import security
from xplain.people.server.http import Context, Server, context, error_page, owner, session
from xplain.people.server.participant_pages import pages as participant_pages
from xplain.people.server.researcher_pages import pages as researcher_pages
from xplain.people.server.store import Store

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
    longest = 9 * sum(question.max_length for question in store.site.plan.lab_questions)
    app.config.update(
        MAX_CONTENT_LENGTH=security.MAX_BODY + longest,
        MAX_FORM_MEMORY_SIZE=security.MAX_BODY + longest,
        MAX_FORM_PARTS=200,
    )
    own = app.extensions["study"] = Context(store, server)
    templates = FileSystemLoader(store.site.TEMPLATES)
    app.jinja_loader = ChoiceLoader([templates, app.jinja_loader])  # type: ignore[list-item]
    app.jinja_env.trim_blocks = app.jinja_env.lstrip_blocks = True
    app.jinja_env.globals.update(
        store.site.drawing()
        | {"texts": store.site.plan.texts, "words": own.words, "mark": own.keys.mark}
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
        app.wsgi_app = security.BelowPath(app.wsgi_app, server.path)  # type: ignore[method-assign]
    app.wsgi_app = security.ReadToTheEnd(app.wsgi_app)  # type: ignore[method-assign]
    return app


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
    response.headers.update(security.headers(context().server.frames))
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
