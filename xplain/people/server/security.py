"""What keeps the server safe: signed cookies, forgery tokens, headers, limits."""

from __future__ import annotations

import hashlib
import hmac
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from itsdangerous import BadSignature, Signer

MAX_BODY = 64 * 1024
"""Bytes of a request; the largest honest one has a few thousand."""

COOKIE_PATH = "xplain.cookie_path"
POLICY = (
    "default-src 'none'; style-src 'self'; script-src 'self'; connect-src 'self'; img-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors "
)
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=(), interest-cohort=()",
}


def headers(frames: Sequence[str]) -> dict[str, str]:
    """Headers of every reply.

    Args:
        frames: addresses of pages that may show this one in a frame; none for nobody.
    """
    found = HEADERS | {"Content-Security-Policy": POLICY + (" ".join(frames) or "'none'")}
    return found if frames else found | {"X-Frame-Options": "DENY"}


@dataclass(frozen=True)
class BelowPath:
    """Serves below a path, whether the proxy in front takes it off or not.

    Attributes:
        application: WSGI.
        path: such as "/robots".
    """

    application: Callable[..., Iterable[bytes]]
    path: str

    def __call__(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Any:
        """As WSGI has it."""
        inner = environ["PATH_INFO"].removeprefix(self.path)
        outside = inner != environ["PATH_INFO"] or "HTTP_X_FORWARDED_PREFIX" in environ
        if inner.startswith("/"):
            environ["PATH_INFO"] = inner
        # Whoever comes past the proxy is not below the path, and would get no cookie of it back.
        environ[COOKIE_PATH] = f"{self.path}/" if outside else "/"
        environ["SCRIPT_NAME"] = self.path
        return self.application(environ, start_response)


@dataclass(frozen=True)
class ReadToTheEnd:
    """Reads what is left of a request's body before the answer is sent.

    A server that answers early may read the last bytes of an unread body together with the next
    request on the connection, and then wait for ever for a request that it has already got. Bodies
    too large to be read like this end the connection.

    Attributes:
        application: WSGI.
        patience: seconds to wait for the next bytes of a slow sender.
    """

    application: Callable[..., Iterable[bytes]]
    patience: float = 10.0

    def __call__(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Any:
        """As WSGI has it."""
        if connection := environ.get("gunicorn.socket"):
            connection.settimeout(self.patience)
        answer = self.application(environ, start_response)
        left = 16 * MAX_BODY
        # A sender that stalls or goes away here gets its answer all the same.
        with suppress(OSError):
            while left > 0 and (read := environ["wsgi.input"].read(min(left, MAX_BODY))):
                left -= len(read)
        return answer


@dataclass
class RateLimit:
    """A token bucket a key; the least recently seen keys are forgotten first.

    Attributes:
        per_second: tokens gained.
        burst: tokens at most.
        clock: seconds, monotonic.
        most: keys remembered.
    """

    per_second: float
    burst: float
    clock: Callable[[], float] = time.monotonic
    most: int = 20_000
    _buckets: OrderedDict[str, tuple[float, float]] = field(default_factory=OrderedDict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def allows(self, key: str) -> bool:
        """Takes a token, if there is one."""
        now = self.clock()
        with self._lock:
            tokens, last = self._buckets.pop(key, (self.burst, now))
            tokens = min(self.burst, tokens + (now - last) * self.per_second)
            allowed = tokens >= 1
            self._buckets[key] = (tokens - allowed, now)
            if len(self._buckets) > self.most:
                self._buckets.popitem(last=False)
        return allowed


OWNER, SESSION = "participant", "researcher session"
"""What a cookie is good for."""
_FORM, _RESEARCHER = "form", "researcher"
"""Purposes of a form's token, and of the key that is typed in. Nothing is signed with the latter:
half of it is shown."""


@dataclass(frozen=True)
class Keys:
    """Cookies and form tokens that only this server can make, each good for one purpose.

    Attributes:
        secret: of the server; it never leaves it.
    """

    secret: bytes = field(repr=False)

    def cookie(self, who: str, purpose: str = OWNER) -> str:
        """What a browser holds: a participant's id or a researcher's session, signed."""
        return self._signer(purpose).sign(who).decode()

    def owner(self, cookie: str, purpose: str = OWNER) -> str | None:
        """Whose cookie it is; None if it is forged, or was made for another purpose."""
        try:
            return self._signer(purpose).unsign(_bytes(cookie)).decode()
        except BadSignature:
            return None

    def form(self, who: str) -> str:
        """The token in every form of a participant, visitor or researcher: a signature alone."""
        return self._signer(_FORM).get_signature(who).decode()

    def owns_form(self, who: str, token: str) -> bool:
        """Whether this token was made for that participant, visitor or researcher."""
        return self._signer(_FORM).verify_signature(_bytes(who), _bytes(token))

    @property
    def mark(self) -> str:
        """What this server's cookies and replies to answers are marked with."""
        return self._signer("mark").derive_key().hex()[:12]

    @property
    def researcher(self) -> str:
        """What the researcher types in to see who is where; the same at every start."""
        return self._signer(_RESEARCHER).derive_key().hex()[:32]

    def is_researcher(self, typed: str, configured: str = "") -> bool:
        """Whether this is the researcher's key, compared in constant time."""
        return hmac.compare_digest(_bytes(typed), _bytes(configured or self.researcher))

    def _signer(self, purpose: str) -> Signer:
        """HMAC-SHA256 with a key of this purpose's own, compared in constant time."""
        return Signer(
            self.secret, salt=purpose, key_derivation="hmac", digest_method=hashlib.sha256
        )


def _bytes(text: str) -> bytes:
    """What a browser sent may hold anything, half a surrogate pair too."""
    return text.encode(errors="replace")
