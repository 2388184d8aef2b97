"""The researcher's page: what can be done, who is where, invitations, the data.

Who has which type and condition stays hidden unless the server is told otherwise.
"""

from __future__ import annotations

import io
import secrets
import shutil
import tempfile
from collections import Counter
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from urllib.parse import urlsplit

from flask import (
    Blueprint,
    make_response,
    redirect,
    render_template,
    request,
    send_file,
    url_for,
)
from werkzeug.wrappers import Response as AnyResponse

from xplain.errors import InputError, Refused
from xplain.people.export import STREAMS, write_identifiers
from xplain.people.flow import small
from xplain.people.http import (
    COOKIE_PATH,
    LOOPBACK,
    PARTICIPANT,
    RESEARCHER,
    SESSION,
    context,
    error_page,
    genuine,
    session,
    set_cookie,
)

pages = Blueprint("researcher", __name__, url_prefix="/researcher")
MOST_INVITATIONS = 500
MOST_SHOWN = 500
MOST_BATCHES = 20
"""Batches of invitations that can be looked at again."""


@pages.before_request
def _only_known() -> AnyResponse | None:
    """Nothing is done without a login and the form's token."""
    free = request.endpoint == "researcher.login" or request.method not in ("POST", "PUT")
    if free or genuine(session() or ""):
        return None
    return error_page(403, "Please log in first.")


@pages.app_template_filter()
def moment(at: float) -> str:
    """A time (seconds since 1970) for people."""
    return f"{datetime.fromtimestamp(at, UTC):%d %b %H:%M}"


@pages.get("")
def overview() -> AnyResponse:
    """Everything at a glance, or the way in."""
    own, here = context(), session()
    if here is None:
        return make_response(render_template("login.html"))
    flow, blinded, people = own.flow, own.server.blinded, own.store.people()
    counted = Counter((one.row["stream"], flow.part(one.state.stage)) for one in people)
    latest = sorted(people, key=lambda one: -one.row["wall"])
    tables = import_module(f"{flow.PACKAGE}.tables")
    given = own.store.query(
        "SELECT event.wall FROM event JOIN participant ON participant.id = event.participant "
        "WHERE kind = 'labels' AND source = 'protocol' AND stream = 'person' ORDER BY 1"
    )
    outside = urlsplit(own.server.address or request.host_url)
    entrance = f"{outside.scheme}://{outside.netloc}{url_for('participant.entrance')}"
    return make_response(
        render_template(
            "glance.html",
            **tables.glance(flow, people),
            token=own.keys.form(here),
            cells=flow.cells,
            data=flow.DATA,
            columns=flow.about(flow.STATE(), blinded),
            people=[
                {**one.row, "about": flow.about(one.state, blinded)}
                for one in latest[:MOST_SHOWN]
                if not one.row["erased"]
            ],
            now=own.store.clock.wall(),
            stages=(*flow.stages, *flow.STATE.ENDS),
            flow=counted,
            times=[row["wall"] for row in given],
            streams=[name for name in STREAMS if any(one == name for one, _ in counted)],
            entrance=entrance,
            local=outside.hostname in LOOPBACK,
            invitations=own.invitations.get(request.args.get("made", ""), []),
            plan_hash=flow.plan.hash,
            paused=own.store.paused,
            blinded=blinded,
        )
    )


@pages.post("/login")
def login() -> AnyResponse:
    """Trades the key for a session of one's own."""
    own = context()
    if not own.keys.is_researcher(request.form.get("key", ""), own.server.key):
        if not own.guess_limit.allows(request.remote_addr or "?"):
            return error_page(429, "too_fast")
        return error_page(403, "This is not the researcher's key. The server prints it at start.")
    new = secrets.token_hex(16)
    own.sessions.add(new)
    response = _back()
    set_cookie(response, RESEARCHER, own.keys.cookie(new, SESSION), "Strict")
    return response


@pages.post("/logout")
def logout() -> AnyResponse:
    """Ends this browser's session, here and in the browser."""
    context().sessions.discard(session() or "")
    response = _back()
    path = request.environ.get(COOKIE_PATH, "/")
    response.delete_cookie(context().cookie(RESEARCHER), path=path)
    return response


@pages.post("/invitations")
def invitations() -> AnyResponse:
    """Makes invitations; the page that is led to shows them."""
    count, stream = small(request.form.get("count", "")), request.form.get("stream", "")
    if not count or count > MOST_INVITATIONS or stream not in STREAMS:
        return error_page(400, f"1 to {MOST_INVITATIONS} invitations: {', '.join(STREAMS)}.")
    made, name = context().invitations, secrets.token_hex(8)
    made[name] = context().store.invite(count, stream)
    for old in list(made)[:-MOST_BATCHES]:
        del made[old]
    return redirect(url_for("researcher.overview", made=name), 303)


@pages.post("/pause")
def pause() -> AnyResponse:
    """Lets nobody new in, or lets them in again."""
    context().store.pause(request.form.get("on") == "1")
    return _back()


@pages.post("/preview")
def preview() -> AnyResponse:
    """Makes this browser a pilot of a chosen type and condition."""
    own, cell = context(), small(request.form.get("cell", ""))
    try:
        who = own.store.enter_preview(-1 if cell is None else cell)
    except Refused as error:
        return error_page(400, str(error))
    response = redirect(url_for("participant.show"), 303)
    set_cookie(response, PARTICIPANT, own.keys.cookie(who))
    return response


@pages.post("/erase")
def erase() -> AnyResponse:
    """Erases the data of the participant who gave their reference."""
    try:
        context().store.erase(request.form.get("reference", "")[:100])
    except InputError as error:
        return error_page(404, f"Nobody has this reference, or no data any more: {error.value!r}")
    return _back()


@pages.post("/export")
def export() -> AnyResponse:
    """An archive, made from a snapshot: the tables without anything that says who is who, or with
    ``what=identifiers`` the completion codes, the platform's ids and the snapshot itself."""
    name = "identifiers" if request.form.get("what") == "identifiers" else "study"
    with tempfile.TemporaryDirectory() as folder:
        inside, snapshot = Path(folder) / name, Path(folder) / "snapshot.sqlite"
        inside.mkdir()
        context().store.snapshot(snapshot)
        if name == "study":
            import_module(f"{context().flow.PACKAGE}.tables").export(snapshot, inside)
        else:
            write_identifiers(snapshot, inside / "identifiers.csv")
            snapshot.rename(inside / snapshot.name)
        archive = shutil.make_archive(f"{folder}/{name}", "zip", folder, name)
        content = io.BytesIO(Path(archive).read_bytes())
    return send_file(content, download_name=f"{name}.zip", as_attachment=True)


def _back() -> AnyResponse:
    return redirect(url_for("researcher.overview"), 303)
