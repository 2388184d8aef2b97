"""The researcher's page: actions, the state of participants, invitations, and the data.

Types and conditions of participants stay hidden by default.
"""

import secrets
import shutil
import tempfile
from collections import Counter
from importlib import import_module
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

from fastapi import APIRouter, Depends, Response
from starlette.exceptions import HTTPException

from xplain.errors import InputError, Refused
from xplain.people.export import write_identifiers
from xplain.people.flow import STREAMS, small
from xplain.people.server import LOOPBACK, SESSION
from xplain.people.site import RESEARCHER, Visit, Visiting

desk = APIRouter(prefix="/researcher")
MOST_INVITATIONS = 500
MOST_SHOWN = 500


def require_login(visit: Visiting) -> Visit:
    """Checks that a logged-in researcher sent the request, with a valid form token. Returns
    ``visit``, which describes the request.

    Raises:
        HTTPException: the request is not valid.
    """
    if not visit.genuine(visit.researcher):
        raise HTTPException(403, "Please log in first.")
    return visit


Signed = Annotated[Visit, Depends(require_login)]


@desk.get("")
def overview(visit: Visiting) -> Response:
    """Shows the overview, or the login form."""
    site, here, request = visit.site, visit.researcher, visit.request
    if here is None:
        return visit.page("login.html")
    flow, store, blinded = site.flow, site.store, site.server.blinded
    people = store.present()
    counted = Counter((one.stream, flow.part(one.state.stage)) for one in people)
    latest = sorted(people, key=lambda one: -one.latest.number)[:MOST_SHOWN]
    host = f"{request.scope['scheme']}://{request.headers.get('host', '')}{site.server.path}"
    return visit.page(
        "glance.html",
        **import_module(f"{flow.PACKAGE}.tables").glance(flow, people),
        token=site.keys.form(here),
        cells=flow.cells,
        columns={} if blinded else flow.about(flow.STATE()),
        people=[(one, {} if blinded else flow.about(one.state)) for one in latest],
        now=store.clock.wall(),
        stages=(*flow.stages, *flow.STATE.ENDS),
        flow=counted,
        streams=[name for name in STREAMS if any(one == name for one, _ in counted)],
        entrance=f"{site.server.address.rstrip('/') or host}/",
        local=(urlsplit(site.server.address).hostname or visit.host) in LOOPBACK,
        invitations=site.invitations.get(request.query_params.get("made", ""), []),
        plan_hash=flow.plan.hash,
        paused=store.paused,
        blinded=blinded,
    )


@desk.post("/login")
def login(visit: Visiting) -> Response:
    """Checks the key and opens a session for this browser."""
    site = visit.site
    if not site.keys.is_researcher(visit.field("key"), site.server.key):
        if not site.guess_limit.allows(visit.address):
            raise HTTPException(429, "too_fast")
        raise HTTPException(403, "This is not the researcher's key. The server prints it at start.")
    site.sessions.add(new := secrets.token_hex(16))
    reply = visit.lead("/researcher")
    visit.set_cookie(reply, RESEARCHER, site.keys.cookie(new, SESSION), "strict")
    return reply


@desk.post("/logout")
def logout(visit: Signed) -> Response:
    """Ends this browser's session on the server and in the browser."""
    visit.site.sessions.discard(visit.researcher or "")
    reply = visit.lead("/researcher")
    visit.set_cookie(reply, RESEARCHER, "")
    return reply


@desk.post("/invitations")
def invitations(visit: Signed) -> Response:
    """Creates invitations and redirects to the page that shows them."""
    count, stream = small(visit.field("count")), visit.field("stream")
    if not count or count > MOST_INVITATIONS or stream not in STREAMS:
        said = f"1 to {MOST_INVITATIONS} invitations: {', '.join(STREAMS)}."
        raise HTTPException(400, said)
    if stream == "person" and "invitation" not in visit.site.server.entry:
        raise HTTPException(400, "People need server.entry=[invitation]; pilots and bots do not.")
    made, name = visit.site.invitations, secrets.token_hex(8)
    made[name] = visit.site.store.invite(count, stream)
    return visit.lead(f"/researcher?made={name}")


@desk.post("/pause")
def pause(visit: Signed) -> Response:
    """Closes or opens the study for new participants."""
    visit.site.store.pause(visit.field("on") == "1")
    return visit.lead("/researcher")


@desk.post("/preview")
def preview(visit: Signed) -> Response:
    """Makes this browser a pilot with a chosen type and condition."""
    cell = small(visit.field("cell"))
    try:
        return visit.let_in(visit.site.store.enter_as_pilot(-1 if cell is None else cell))
    except Refused as error:
        raise HTTPException(400, str(error)) from None


@desk.post("/erase")
def erase(visit: Signed) -> Response:
    """Erases the data of the participant with this reference."""
    try:
        visit.site.store.erase_by(visit.field("reference")[:100])
    except InputError as error:
        said = f"No participant has this reference, or the data was erased: {error.value!r}"
        raise HTTPException(404, said) from None
    return visit.lead("/researcher")


@desk.post("/export")
def export(visit: Signed) -> Response:
    """Sends an archive made from a snapshot: the tables without identifiers. With
    ``what=identifiers`` the archive has the completion codes, the platform's ids and the snapshot.
    """
    name = "identifiers" if visit.field("what") == "identifiers" else "study"
    store = visit.site.store
    with tempfile.TemporaryDirectory() as folder:
        inside, snapshot = Path(folder) / name, Path(folder) / "snapshot.sqlite"
        inside.mkdir()
        store.snapshot(snapshot)
        if name == "study":
            import_module(f"{store.flow.PACKAGE}.tables").export(snapshot, inside)
        else:
            write_identifiers(store.present(), inside / "identifiers.csv")
            snapshot.rename(inside / snapshot.name)
        content = Path(shutil.make_archive(f"{folder}/{name}", "zip", folder, name)).read_bytes()
    kept = {"Content-Disposition": f"attachment; filename={name}.zip"}
    return Response(content, media_type="application/zip", headers=kept)
