"""The researcher's page: who is where, which slots are left, invitations, the data."""

from __future__ import annotations

import io
import tempfile
import zipfile
from pathlib import Path

from flask import Blueprint, Response, make_response, redirect, render_template, request, url_for
from werkzeug.wrappers import Response as AnyResponse

from xplain.participants.server import forms
from xplain.participants.server.http import context, error_page, genuine, set_cookie
from xplain.study.stored import STREAMS

pages = Blueprint("researcher", __name__, url_prefix="/researcher")
COOKIE, WHO = "researcher", "researcher"
MOST_INVITATIONS = 500


def _known() -> bool:
    return context().keys.is_researcher_cookie(request.cookies.get(COOKIE, ""))


def _genuine() -> bool:
    return _known() and genuine(WHO)


@pages.get("")
def overview() -> AnyResponse:
    """Everything at a glance, or the way in."""
    return _overview([]) if _known() else make_response(render_template("login.html"))


def _overview(invitations: list[str]) -> Response:
    own = context()
    own.store.time_out_stale()
    people = own.store.query(
        "SELECT participant.id, stream, json_extract(state, '$.stage') AS stage, "
        "json_extract(state, '$.step') AS step, json_extract(state, '$.user_type') AS user_type, "
        "json_extract(state, '$.condition') AS condition, entered, seen, over "
        "FROM participant ORDER BY over, seen DESC LIMIT 500"
    )
    now = own.store.clock.wall()
    flow = own.store.query(
        "SELECT stream, json_extract(state, '$.stage') AS stage, count(*) AS number "
        "FROM participant GROUP BY 1, 2"
    )
    return make_response(
        render_template(
            own.protocol.overview,
            **own.protocol.glance(own.store.query),
            token=own.keys.form(WHO),
            people=people,
            now=now,
            stages=(*own.protocol.stages, *own.protocol.ends),
            flow={(row["stream"], row["stage"]): row["number"] for row in flow},
            streams=[name for name in STREAMS if any(row["stream"] == name for row in flow)],
            entrance=url_for("participant.entrance", _external=True),
            invitations=invitations,
            plan_hash=own.protocol.plan.hash,
        )
    )


@pages.post("/login")
def login() -> AnyResponse:
    """Trades the token for a cookie."""
    keys = context().keys
    if not keys.is_researcher(request.form.get("key", "")):
        return error_page(403, "This is not the researcher's key. The server prints it at start.")
    response = redirect(url_for("researcher.overview"), 303)
    set_cookie(response, COOKIE, keys.researcher_cookie, "Strict")
    return response


@pages.post("/invitations")
def invitations() -> AnyResponse:
    """Makes invitations and shows them, once."""
    if not _genuine():
        return error_page(403, "Please log in first.")
    count, stream = forms.small(request.form.get("count", "")), request.form.get("stream", "")
    if not count or count > MOST_INVITATIONS or stream not in STREAMS:
        return error_page(400, f"1 to {MOST_INVITATIONS} invitations: {', '.join(STREAMS)}.")
    return _overview(context().store.invite(count, stream))


@pages.post("/export")
def export() -> AnyResponse:
    """All data as one archive, made from a snapshot."""
    if not _genuine():
        return error_page(403, "Please log in first.")
    archive = io.BytesIO()
    with tempfile.TemporaryDirectory() as folder:
        snapshot = Path(folder) / "snapshot.sqlite"
        context().store.snapshot(snapshot)
        tables = Path(folder) / "tables"
        context().protocol.export(snapshot, tables)
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as out:
            for file in sorted([snapshot, *tables.iterdir()]):
                out.write(file, f"study/{file.name}")
    response = make_response(archive.getvalue())
    response.headers["Content-Type"] = "application/zip"
    response.headers["Content-Disposition"] = "attachment; filename=study.zip"
    return response
