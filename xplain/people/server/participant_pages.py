"""The participants' pages. One address for all of them: it shows where the participant is, so
reload, back button, a second tab or a restart of the server end up at the same place."""

from __future__ import annotations

import base64
import re
import secrets
from dataclasses import replace
from typing import Any, Literal
from urllib.parse import urlsplit

from flask import (
    Blueprint,
    Response,
    abort,
    make_response,
    redirect,
    render_template,
    request,
    url_for,
)
from pydantic import BaseModel, Field, ValidationError
from werkzeug.datastructures import MultiDict
from werkzeug.wrappers import Response as AnyResponse

from xplain.errors import Refused
from xplain.people.analysis.export import ParticipantRow
from xplain.people.flow import Conflict, Form
from xplain.people.server.database import Gone, Unknown
from xplain.people.server.http import (
    LOOPBACK,
    PARTICIPANT,
    context,
    error_page,
    genuine,
    owner,
    read_cookie,
    set_cookie,
)
from xplain.people.server.site import Full

pages = Blueprint("participant", __name__)
VISITOR = "visitor"
"""The cookie of somebody who has not entered yet; forms are bound to it."""
TAB_KINDS = Literal["visible", "hidden", "label", "recall", "retry", "active"]
MAX_ITEMS = 50
MOST_ANSWERS = 100_000
"""Numbers that no page reaches."""

# Entry -----------------------------------------------------------------------------------------


@pages.get("/")
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


@pages.post("/enter")
def enter() -> AnyResponse:
    """Admits, or leads back to where the participant was."""
    own = context()
    if not read_cookie(VISITOR):
        return error_page(403, "no_cookies")
    here = urlsplit(request.host_url).hostname in LOOPBACK
    if own.site.plan.unedited and not (own.server.demo or here):
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


def _current() -> ParticipantRow[Any]:
    """Whose cookie came along; others get a page that says that they are not known."""
    try:
        return context().store.participant(owner() or "")
    except Unknown:
        abort(error_page(403, "no_invitation"))


@pages.get("/study")
def show() -> AnyResponse:
    """The page where the participant is."""
    return _page(_current())


def _page(
    found: ParticipantRow[Any], problem: str = "", status: int = 200, typed: Form | None = None
) -> Response:
    """The page where somebody is; of a refused form the page that it is of, with what was typed."""
    own = context()
    if typed:
        found = replace(found, state=own.site.flow.asking(found.state))
    if not found.state.paused:
        own.store.shown(found.id, found.state.accepted, found.state.stage)
    reference = "-".join(re.findall(".{4}", own.store.reference(found.id)))
    flow, code = own.site.flow, own.code(found)
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


@pages.post("/study")
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
            own.site.flow.read(own.store.asked(found, sequence), kind, form),
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


@pages.get("/consent.txt")
def consent() -> AnyResponse:
    """A copy of the consent text to keep."""
    _current()
    texts = context().site.plan.texts
    content = "\n\n".join([texts.title, *texts.consent, texts.contact, texts.consent_hash])
    kept = {"Content-Disposition": "attachment; filename=consent.txt"}
    return Response(f"{content}\n", mimetype="text/plain", headers=kept)


@pages.get("/picture/<int:number>")
def picture(number: int) -> AnyResponse:
    """An image that belongs to the plan, of a transition."""
    _current()
    pictures = context().site.pictures
    found = pictures[number] if number < len(pictures) else None
    if found is None:
        return error_page(404, "no_page")
    return Response(base64.b64decode(found.content), mimetype=found.media)


@pages.post("/events")
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
