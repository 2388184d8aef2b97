"""What the pages share: how they are served, whose request it is, replies that any page gives."""

from __future__ import annotations

from dataclasses import dataclass

from flask import Response, current_app, make_response, render_template, request
from werkzeug.wrappers import Response as AnyResponse

from xplain.errors import InputError
from xplain.participants.server.protocol import Protocol
from xplain.participants.server.security import Keys, RateLimit
from xplain.participants.server.store import Store

PARTICIPANT = "participant"
"""The cookie of somebody who was let in."""


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
        """Raises InputError: an unknown way to come in."""
        object.__setattr__(self, "entry", tuple(self.entry))
        for kind in self.entry:
            if kind not in ("invitation", "prolific", "open"):
                raise InputError("server.entry", kind, "invitation, prolific or open")


@dataclass(frozen=True)
class Context:
    """What every page needs."""

    store: Store
    protocol: Protocol
    keys: Keys
    server: Server
    participant_limit: RateLimit
    visitor_limit: RateLimit


def context() -> Context:
    """The context of the running application."""
    found: Context = current_app.extensions["study"]
    return found


def owner() -> str | None:
    """The participant whose cookie came along, if the cookie is genuine."""
    return context().keys.owner(request.cookies.get(PARTICIPANT, ""))


def genuine(who: str) -> bool:
    """Whether the form that was sent carries the token of this participant or visitor."""
    return context().keys.owns_form(who, request.form.get("token", ""))


def error_page(status: int, text: str) -> Response:
    """A page that says what is wrong."""
    return make_response(render_template("error.html", text=text, status=status), status)


def set_cookie(response: AnyResponse, name: str, value: str, samesite: str = "Lax") -> None:
    """A cookie that scripts cannot read."""
    https = context().server.https
    response.set_cookie(
        name, value, httponly=True, samesite=samesite, secure=https, max_age=14 * 86400
    )
