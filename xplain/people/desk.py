"""The researcher's page: actions, the state of participants, invitations, and the data.

Types and conditions of participants stay hidden by default.
"""

import secrets
import shutil
import tempfile
import time
from collections import Counter
from importlib import import_module
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

from fastapi import APIRouter, Depends, Response
from starlette.exceptions import HTTPException

from xplain.errors import InputError
from xplain.people.export import write_identifiers
from xplain.people.flow import STREAMS, pick
from xplain.people.site import LOOPBACK, Visit, Visiting

desk = APIRouter(prefix="/researcher")
MOST_INVITATIONS = 500
MOST_SHOWN = 500
GUESSES = 10
"""Wrong researcher's keys per minute that each address may send."""


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
    if not here:
        return visit.page("login.html")
    flow, store, blinded = site.flow, site.store, site.server.blinded
    people = store.present()
    counted = Counter((one.stream, flow.part(one.state.stage)) for one in people)
    latest = sorted(people, key=lambda one: -one.events[-1].number)[:MOST_SHOWN]
    host = f"{request.scope['scheme']}://{request.headers.get('host', '')}{site.server.path}"
    return visit.page(
        "glance.html",
        **import_module(f"{flow.PACKAGE}.tables").glance(flow, people),
        token=site.token(here),
        cells=flow.cells,
        columns={} if blinded else flow.about(flow.STATE()),
        people=[(one, {} if blinded else flow.about(one.state)) for one in latest],
        now=store.clock.wall(),
        stages=(*flow.stages, *flow.STATE.ENDS),
        flow=counted,
        part=flow.part,
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
    site, sent = visit.site, visit.field("key").encode(errors="replace")
    if not secrets.compare_digest(sent, (site.server.key or site.store.researcher_key).encode()):
        now = int(time.monotonic() // 60)
        site.guesses = Counter({k: n for k, n in site.guesses.items() if k[0] == now})
        site.guesses[now, visit.address] += 1
        if site.guesses[now, visit.address] > GUESSES:
            raise HTTPException(429, "too_fast")
        raise HTTPException(403, "This is not the researcher's key. The server prints it at start.")
    site.sessions.add(new := secrets.token_hex(16))
    visit.session["researcher"] = new
    return visit.lead("/researcher")


@desk.post("/logout")
def logout(visit: Signed) -> Response:
    """Ends this browser's session on the server and in the browser."""
    visit.site.sessions.discard(visit.session.pop("researcher"))
    return visit.lead("/researcher")


@desk.post("/invitations")
def invitations(visit: Signed) -> Response:
    """Creates invitations and redirects to the page that shows them."""
    said = f"1 to {MOST_INVITATIONS} invitations: {', '.join(STREAMS)}."
    count, stream = pick(visit.field("count"), MOST_INVITATIONS + 1, said), visit.field("stream")
    if not count or stream not in STREAMS:
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
    store = visit.site.store
    cell = pick(visit.field("cell"), len(store.flow.cells), "not_understood")
    return visit.let_in(store.enter_as_pilot(cell))


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
