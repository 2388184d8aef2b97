"""The settings of a server of pages, what it signs with, and how many requests it takes."""

from __future__ import annotations

import hashlib
import hmac
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

import jwt
import pydantic
from itsdangerous import BadSignature, Signer

from xplain.errors import InputError


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

    def allows(self, key: str) -> bool:
        """Takes a token, if there is one."""
        now = self.clock()
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
    """Encodes text from a browser, which may contain anything, such as half a surrogate pair."""
    return text.encode(errors="replace")


ENDINGS = ("declined", "screened_out", "ineligible", "withdrawn", "timed_out", "full")
"""What a code of its own can be set for, beside the end that all who finish come to."""
LEAST_KEY, LEAST_SECRET = 12, 32
"""Characters of a key that researchers type, bytes of a secret that signs links."""
LOOPBACK = ("127.0.0.1", "localhost", "::1", "0.0.0.0", "::")
"""Hosts whose links open on the server's own computer alone."""
GUESSES = 10
"""Wrong keys of researchers, a minute and an address, that are answered."""


def _need(right: bool, key: str, value: object, allowed: str) -> None:
    if not right:
        raise InputError(f"server.{key}", value, allowed)


@pydantic.dataclasses.dataclass(frozen=True, config={"strict": True, "extra": "forbid"})
class Server:
    """How the pages are served; no part of the study's plan.

    Attributes:
        entry: who may come in: "invitation"; "platform", with ids in the link, which can be made
            up; "signed", with ids that the platform or the lab has signed; "open", as pilots.
        id_names: of the parameters by which a platform's address tells a person's id, and, if it
            does, the study's and the session's.
        studies: of the platform, whose people may come in; none for any.
        ids: a file of persons' ids, one a line, read whenever somebody comes; nobody else may come
            in. "" for anybody of the studies.
        signed_by: with "signed": a file with the platform's public key (PEM, or its JSON Web Key
            Set), or with a secret of the lab's of 32 bytes or more.
        signed_name: parameter of the link that holds the signed token (a JSON Web Token).
        keep_ids: whether a platform's ids are stored in clear; else only keyed hashes.
        completion_url: where finished participants may go, "" for nowhere. ``{code}`` in it is
            replaced by the completion code, ``{id}`` by the person's id.
        completion_code: one for all who finish (platforms want that), "" for one a participant.
        codes: ``{how a part ended: code}``, as ``completion_code``, for the other endings.
        address: as the outside world types it, with its path, such as
            ``https://lab.example.org/robots``; "" takes it from each request.
        frames: addresses of pages that may show this one in a frame, such as a survey's.
        key: that researchers type in, of 12 characters or more; "" for one made by the server.
        demo: whether people may come in although the consent text is not edited: a pilot.
        blinded: whether the researcher's page keeps to itself who has which type and condition.
        https: whether the outside world sees https.
        proxies: how many proxies in front add X-Forwarded-For.
        requests_per_second, burst: limit of a participant.
        visitors_per_second, visitor_burst: limit of an address, for those without a cookie.
    """

    entry: tuple[Literal["invitation", "platform", "signed", "open"], ...] = ("invitation",)
    id_names: tuple[str, ...] = ("PROLIFIC_PID", "STUDY_ID", "SESSION_ID")
    studies: tuple[str, ...] = ()
    ids: str = ""
    signed_by: str = ""
    signed_name: str = "token"
    keep_ids: bool = False
    completion_url: str = ""
    completion_code: str = ""
    codes: Mapping[str, str] = field(default_factory=lambda: dict.fromkeys(ENDINGS, ""))
    address: str = ""
    frames: tuple[str, ...] = ()
    key: str = ""
    demo: bool = False
    blinded: bool = True
    https: bool = False
    proxies: int = 0
    requests_per_second: float = 5.0
    burst: float = 40.0
    visitors_per_second: float = 20.0
    visitor_burst: float = 300.0

    def __post_init__(self) -> None:
        """Raises InputError: keys that contradict each other, or a file that cannot be read."""
        entry, studies = set(self.entry), list(self.studies)
        names = "the names of a person's id, and if there are any of a study's and a session's"
        _need(1 <= len(self.id_names) <= 3, "id_names", list(self.id_names), names)
        _need(not studies or len(self.id_names) > 1, "studies", studies, "none: id_names has none")
        listed = "ids of the studies whose people may come in, or server.ids=FILE with theirs"
        _need("platform" not in entry or bool(studies or self.ids), "studies", [], listed)
        # Somebody paid whose link is incomplete would become a pilot, and lose their data.
        paid = "open" in entry and bool({"platform", "signed"} & entry)
        _need(not paid, "entry", list(self.entry), "open without platform and signed")
        signs = "with server.entry=[signed] a file with the key, else none"
        _need(("signed" in entry) == bool(self.signed_by), "signed_by", self.signed_by, signs)
        kept = self.keep_ids or "{id}" not in self.completion_url
        without = "an address without {id}, or server.keep_ids=true"
        _need(kept, "completion_url", self.completion_url, without)
        long = not self.key or len(self.key) >= LEAST_KEY
        _need(long, "key", "…", f"{LEAST_KEY} characters or more, or none")
        whole = "an address with https:// or http://, such as https://lab.example.org/robots"
        _need(
            not self.address or bool(urlsplit(self.address).netloc), "address", self.address, whole
        )
        if self.ids:
            self.listed()
        if self.signed_by:
            self.verify("")

    @property
    def path(self) -> str:
        """The path of the address: every route, link and cookie begins with it; "" for none."""
        return urlsplit(self.address).path.rstrip("/")

    @property
    def from_platform(self) -> bool:
        """Whether a platform's ids lead in, signed or not."""
        return bool({"platform", "signed"} & {*self.entry})

    def listed(self) -> set[str]:
        """The ids of people who may come in, of the file ``ids``.

        Raises:
            InputError: it cannot be read.
        """
        try:
            lines = Path(self.ids).read_text(encoding="utf-8-sig").splitlines()
            return {line.strip() for line in lines} - {""}
        except (OSError, UnicodeDecodeError) as error:
            raise InputError("server.ids", self.ids, f"a file of ids ({error})") from None

    def lets_in(self, ids: Sequence[str]) -> bool:
        """Whether somebody with these values of ``id_names`` may come in."""
        whole = bool(ids) and all(0 < len(one) <= 100 for one in ids)
        of_study = not self.studies or ids[1] in self.studies
        return whole and of_study and (not self.ids or ids[0] in self.listed())

    def verify(self, token: str) -> dict[str, str]:
        """The ids in a signed token that has not expired; none of a token that is not genuine.

        Raises:
            InputError: the file with the key cannot be used.
        """
        wanted = "a file with a public key (PEM or JWKS), or a secret of 32 bytes or more"
        try:
            text = Path(self.signed_by).read_text(encoding="utf-8").strip()
            keys: list[tuple[Any, list[str]]] = [(text, ["HS256"])]
            if text.startswith("{"):
                known = jwt.PyJWKSet.from_json(text).keys
                keys = [(one.key, [one.algorithm_name]) for one in known]
            elif text.startswith("-----BEGIN PUBLIC KEY"):
                keys = [(text, ["RS256", "ES256", "EdDSA"])]
            elif len(text.encode()) < LEAST_SECRET:
                raise ValueError("neither")
        except (OSError, ValueError, jwt.PyJWTError) as error:
            raise InputError("server.signed_by", self.signed_by, f"{wanted} ({error})") from None
        for key, algorithms in keys:
            with suppress(jwt.PyJWTError):
                options: Any = {"require": ["exp"], "verify_aud": False}
                claims = jwt.decode(token, key, algorithms=algorithms, options=options)
                audience = str(claims.get("aud", self.address))
                if urlsplit(audience).netloc == urlsplit(self.address).netloc:
                    ids = claims.get("prolific", claims)
                    return {name: str(ids.get(name, "")) for name in self.id_names}
        return {}
