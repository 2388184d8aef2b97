"""The web application: checks on every request, and the pages of participants."""

import base64
import logging
import re
import secrets
import shutil
from collections.abc import Awaitable, Callable
from contextlib import suppress
from http import HTTPStatus
from typing import Any, Literal

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.responses import JSONResponse, PlainTextResponse
from fastapi.staticfiles import StaticFiles
from pydantic import BaseModel, Field, ValidationError
from starlette.datastructures import ImmutableMultiDict
from starlette.exceptions import HTTPException
from starlette.middleware.sessions import SessionMiddleware

from xplain.errors import Refused
from xplain.people.desk import desk
from xplain.people.flow import Conflict, Full, Participant, State
from xplain.people.log import Unknown
from xplain.people.site import LOOPBACK, Server, Site, Visit, Visiting
from xplain.people.store import DataErased, Store

MAX_ITEMS = 50
"""Maximum number of events in a page's report."""
LEAST_FREE = 64 << 20
"""Minimum of free bytes on the disk; with fewer bytes the server reports an error."""
TEXTS = {404: "no_page", 405: "not_here", 413: "too_much"}
"""Keys of the texts for errors that have no text."""
TAB_KINDS = Literal["visible", "hidden", "label", "recall", "retry", "active"]
log = logging.getLogger(__name__)
pages = APIRouter()

# Entry -----------------------------------------------------------------------------------------


@pages.api_route("/", methods=["GET", "HEAD"])
def entrance(visit: Visiting) -> Response:
    """Shows the page that invitations and links of recruiting platforms open. Stores nothing."""
    site, given = visit.site, visit.request.query_params
    visitor = visit.session.setdefault("visitor", secrets.token_hex(16))
    names = (*site.server.id_names, site.server.signed_name)
    ids = {key: given[key][:4000] for key in names if given.get(key)}
    return visit.page(
        "entrance.html",
        token=site.token(visitor),
        invitation=given.get("invitation", "")[:100],
        ids=ids if site.server.from_platform else {},
        entry=site.server.entry,
    )


@pages.post("/enter")
def enter(visit: Visiting) -> Response:
    """Admits a person, who may return, and redirects to the person's current page.

    Raises:
        HTTPException: the person is not invited or was erased, the form is not from this browser,
            or the plan's texts are not ready.
    """
    visitor, server, store = visit.session.get("visitor"), visit.site.server, visit.site.store
    if not visitor:
        raise HTTPException(403, "no_cookies")
    here = visit.host in LOOPBACK
    if visit.site.flow.plan.unedited and not (server.demo or here):
        raise HTTPException(403, "not_ready")
    if not visit.genuine(visitor):
        raise HTTPException(403, "old_form")
    # A link may end with the full stop of a sentence, or be typed in small letters.
    invitation = re.sub("[^A-Z]", "", visit.field("invitation").upper())
    ids = {key: visit.field(f"id_{key}").strip() for key in server.id_names}
    if "signed" in server.entry and not invitation:
        ids = server.verify(visit.field(f"id_{server.signed_name}"))
    try:
        if invitation:
            who = store.enter_invited(invitation, "invitation" in server.entry)
        elif server.from_platform and server.lets_in([*ids.values()]):
            who = store.enter_from_platform(ids, server.keep_ids)
        elif "open" in server.entry:
            who = store.enter_as_pilot()
        else:
            raise Unknown
    except DataErased:
        raise HTTPException(410, "erased") from None
    except Unknown:
        raise HTTPException(403, "not_invited") from None
    return visit.let_in(who)


# The pages of the study ------------------------------------------------------------------------


@pages.get("/study")
def show(visit: Visiting) -> Response:
    """Shows the participant's current page."""
    return page_of(visit, visit.participant)


def page_of(
    visit: Visit, found: Participant[Any], problem: str = "", status: int = 200, kept: bool = False
) -> Response:
    """Renders the participant's current page. After the server refused a form, renders the same
    page with the entered values."""
    site = visit.site
    state: State = site.flow.asking(found.state) if kept else found.state
    if not state.paused:
        site.store.show(found, state)
    code = site.code(found)
    return visit.page(
        "ended.html" if state.over else f"{state.stage}.html",
        status,
        **site.flow.view(state),
        kind=site.flow.waits_for(state),
        code=code,
        back=site.back(found, code),
        stages=site.flow.stages,
        within=site.flow.part(state.stage),
        stream=found.stream,
        typed=visit.form if kept else ImmutableMultiDict(),
        token=site.token(found.id),
        problem=site.say(problem),
        reference="-".join(re.findall(".{4}", site.store.reference(found.id))),
    )


@pages.post("/study")
def answer(visit: Visiting) -> Response:
    """Accepts an answer once and redirects. Only after the answer is on the disk, the status is 303
    (204 for scripts, which load the next page themselves)."""
    found, site, store = visit.participant, visit.site, visit.site.store
    if not visit.genuine(found.id):
        raise HTTPException(403, "not_yours")
    kind, number, ms = visit.field("kind")[:20], visit.field("sequence"), -1.0
    with suppress(ValueError):
        ms = float(visit.field("ms"))
    sequence = int(number) if re.fullmatch("[0-9]{1,5}", number) else -1
    try:
        if sequence < 0:
            raise Refused("not_complete")
        if kind == "time_out":
            raise Refused("not_understood")
        if kind not in ("withdraw", "return") and sequence > found.shown:
            raise Conflict("other_page")  # the page of this answer was never shown
        payload = site.flow.read(store.find_state(found, sequence), kind, visit.form)
        store.submit(found.id, sequence, kind, payload, ms if 0 <= ms < 1e10 else None)
    except Full as error:
        code = site.server.codes.get("full", "")
        said = f"{site.say(str(error))} {site.say('code')}: {code}" if code else str(error)
        return page_of(visit, found, said, 503, kept=True)
    except Conflict as error:
        return page_of(visit, store.participant(found.id), str(error), 409)
    except Refused as error:
        found = store.participant(found.id)
        return page_of(visit, found, str(error), 400, kept=sequence == found.state.accepted)
    if "study-script" in visit.request.headers:
        return Response(status_code=204)
    return visit.lead("/study")


@pages.get("/consent.txt")
def consent(visit: Visiting) -> Response:
    """Returns a copy of the consent text to keep."""
    texts, _ = visit.site.flow.plan.texts, visit.participant
    content = "\n\n".join([texts.title, *texts.consent, texts.contact, texts.consent_hash])
    kept = {"Content-Disposition": "attachment; filename=consent.txt"}
    return PlainTextResponse(f"{content}\n", headers=kept)


@pages.get("/picture/{number:int}")
def picture(visit: Visiting, number: int) -> Response:
    """Returns an image of a transition in the plan."""
    shown, _ = visit.site.flow.plan.shown, visit.participant
    found = shown[number].picture if number < len(shown) else None
    if found is None:
        raise HTTPException(404)
    return Response(base64.b64decode(found.content), media_type=found.media)


class PageEvent(BaseModel, strict=True):
    """One event of a page: its number on the page, the page's clock, the browser's wall clock
    (ms)."""

    n: int = Field(ge=0, lt=100_000)
    kind: TAB_KINDS
    ms: float = Field(ge=0, lt=1e14)
    at: float = Field(ge=0, lt=1e14)
    what: str = Field("", max_length=40)


class Report(BaseModel, strict=True):
    """The events that a page sends from the browser, such as "visible" or "hidden", with the token
    of the page's form."""

    token: str
    tab: str = Field(pattern=r"^[a-z0-9]{8,32}$")
    items: list[PageEvent] = Field(max_length=MAX_ITEMS)


@pages.post("/events")
def events(visit: Visiting) -> Response:
    """Stores a page's own events, such as "visible", "hidden" or "label". Changes no state."""
    found, site = visit.participant, visit.site
    try:
        report = Report.model_validate_json(visit.body)
        if not visit.owns(found.id, report.token):
            return JSONResponse({"error": "not yours"}, 403)
        items = [(i.n, str(i.kind), i.ms, {"at": i.at, "what": i.what}) for i in report.items]
        if found.state.stage != "declined":
            site.store.report(found.id, report.tab, items)
    except (ValidationError, Refused):
        return JSONResponse({"error": "not understood, or too much"}, 400)
    return JSONResponse({"kept": len(items)})


@pages.api_route("/alive", methods=["GET", "HEAD"])
def alive(request: Request) -> Response:
    """Reports that answers can be stored: the server runs, and its disk has space."""
    free = shutil.disk_usage(request.app.state.site.store.path.parent).free
    well = free >= LEAST_FREE
    said = "alive" if well else f"disk full: {free} bytes left"
    return PlainTextResponse(f"{said}\n", 200 if well else 503)


# The application --------------------------------------------------------------------------------


def create_app(store: Store, server: Server) -> FastAPI:
    """Creates the application for one open store."""
    site = Site(store, server)
    app = FastAPI(openapi_url=None, redirect_slashes=False)
    app.state.site = site
    app.mount("/static", StaticFiles(packages=[("xplain.people", "static")]))
    app.include_router(pages)
    app.include_router(desk)

    @app.exception_handler(HTTPException)
    def refuse(request: Request, error: HTTPException) -> Response:
        silent = error.detail == HTTPStatus(error.status_code).phrase
        text = TEXTS.get(error.status_code, "not_understood") if silent else error.detail
        return Visit(site, request).error(error.status_code, text)

    @app.exception_handler(Unknown)
    @app.exception_handler(Refused)
    def not_accepted(request: Request, error: Exception) -> Response:
        known = isinstance(error, Refused)
        return Visit(site, request).error(*((400, str(error)) if known else (403, "no_invitation")))

    @app.middleware("http")
    async def guard(request: Request, go_on: Callable[[Request], Awaitable[Response]]) -> Response:
        """Applies headers. After an error, logs the traceback and returns a page."""
        came, path = Visit(site, request), request.scope["path"].removeprefix(server.path)
        path = path.rstrip("/") or "/"
        fixed = path.startswith("/static/")
        # A proxy in front may or may not remove the path of the address.
        request.scope.update(root_path=server.path, path=f"{server.path}{path}")
        try:
            reply = await go_on(request)
            # A page accepts only marked replies, because other replies may come from a proxy.
            reply.headers["Study-Mark"] = store.mark
        except Exception:
            log.exception("request failed")
            reply = came.error(500, "failed")
        reply.headers.update(site.headers)
        # Browsers never cache pages: back and reload ask the server again.
        kept = fixed and reply.status_code == 200
        reply.headers["Cache-Control"] = "public, max-age=3600" if kept else "no-store"
        return reply

    app.add_middleware(
        SessionMiddleware,
        secret_key=store.hash_texts("session"),
        session_cookie=f"study_{store.mark}",
        path=f"{server.path}/",
        # In another page's frame a browser sends only cookies with SameSite=None.
        same_site="none" if server.frames else "lax",
        https_only=server.https or bool(server.frames),
    )
    return app
