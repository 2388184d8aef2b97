"""The application: the pages put together, and what every request passes through."""

from __future__ import annotations

import logging

from flask import Flask, Response, request
from jinja2 import ChoiceLoader, FileSystemLoader
from werkzeug.exceptions import HTTPException
from werkzeug.middleware.proxy_fix import ProxyFix
from werkzeug.wrappers import Response as AnyResponse

from xplain.participants.server import security
from xplain.participants.server.http import Context, Desk, Server, context, error_page, owner
from xplain.participants.server.participant_pages import pages as participant_pages
from xplain.participants.server.researcher_pages import pages as researcher_pages
from xplain.participants.server.security import Keys, RateLimit
from xplain.participants.server.store import Store

log = logging.getLogger(__name__)


def create_app(store: Store, server: Server) -> Flask:
    """The application for one open store."""
    app = Flask(__name__)
    words = store.protocol.plan.texts.words
    app.config.update(
        MAX_CONTENT_LENGTH=security.MAX_BODY,
        MAX_FORM_MEMORY_SIZE=security.MAX_BODY,
        MAX_FORM_PARTS=200,
    )
    app.extensions["study"] = Context(
        store,
        store.protocol,
        Keys(store.secret),
        server,
        RateLimit(server.requests_per_second, server.burst),
        RateLimit(server.visitors_per_second, server.visitor_burst),
        words,
        Desk(),
    )
    own = FileSystemLoader(store.protocol.templates)
    app.jinja_loader = ChoiceLoader([own, app.jinja_loader])  # type: ignore[list-item]
    app.jinja_env.trim_blocks = app.jinja_env.lstrip_blocks = True
    drawn = dict(store.protocol.drawing())
    app.jinja_env.globals.update(drawn | {"texts": store.protocol.plan.texts, "words": words})
    app.before_request(_limit)
    app.after_request(_secure)
    app.register_error_handler(HTTPException, _http_error)
    app.register_error_handler(Exception, _failure)
    app.add_url_rule("/alive", "alive", lambda: ("alive\n", {"Content-Type": "text/plain"}))
    app.register_blueprint(participant_pages)
    app.register_blueprint(researcher_pages)
    if server.proxies:
        app.wsgi_app = ProxyFix(app.wsgi_app, server.proxies, server.proxies)  # type: ignore[method-assign]
    app.wsgi_app = security.ReadToTheEnd(app.wsgi_app)  # type: ignore[method-assign]
    return app


def _limit() -> AnyResponse | None:
    if request.endpoint in ("static", "alive"):
        return None
    who, own = owner(), context()
    allowed = (
        own.participant_limit.allows(who)
        if who
        else own.visitor_limit.allows(request.remote_addr or "?")
    )
    if allowed:
        return None
    response = error_page(429, "too_fast")
    response.headers["Retry-After"] = "5"
    return response


def _secure(response: Response) -> Response:
    kept = request.endpoint == "static" and response.status_code == 200
    return security.secure(response, context().server.https, kept)


def _http_error(error: HTTPException) -> AnyResponse:
    if isinstance(error.code, int) and error.code >= 400:
        texts = {404: "no_page", 405: "not_here", 413: "too_much"}
        return error_page(error.code, texts.get(error.code, "not_understood"))
    return error.get_response()


def _failure(error: Exception) -> Response:
    # Whatever went wrong, the participant gets a page; the log gets the traceback.
    log.error("request failed", exc_info=error)
    return error_page(500, "failed")
