"""The settings of a server of pages."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import field
from pathlib import Path
from typing import Any, Literal, get_args
from urllib.parse import urlsplit

import jwt
import pydantic

from xplain.errors import InputError

Ending = Literal["declined", "screened_out", "ineligible", "withdrawn", "timed_out", "full"]
"""Ends that can have their own completion code, besides the normal end."""
LEAST_KEY, LEAST_SECRET = 12, 32
"""Minimum characters of the researcher's key, and minimum bytes of a secret that signs links."""
LOOPBACK = ("127.0.0.1", "localhost", "::1", "0.0.0.0", "::")
"""Hosts whose links work only on the server's own computer."""


@pydantic.dataclasses.dataclass(frozen=True, config={"strict": True, "extra": "forbid"})
class Server:
    """Settings of the server of the pages; not part of the study's plan.

    Attributes:
        entry: ways to enter for people: "invitation"; "platform", with ids in the link (anybody can
            invent ids); "signed", with ids that the platform or the lab has signed; "open", as a
            pilot. Invitations for pilots and bots are always valid.
        id_names: names of the link's parameters with the person's id and, if present, the ids of
            study and session.
        studies: ids of the platform's studies whose people may take part; none allows all studies.
        ids: a file of persons' ids, one on each line, read at every arrival; only these people may
            take part. "" allows all people of the studies.
        signed_by: with "signed": a file with the platform's public key (PEM, or its JSON Web Key
            Set), or with a secret of the lab of 32 bytes or more.
        signed_name: the link's parameter with the signed token (a JSON Web Token).
        keep_ids: True stores a platform's ids themselves, False only their keyed hashes.
        completion_url: address for finished participants, "" for none. ``{code}`` in it is replaced
            by the completion code, ``{id}`` by the person's id.
        completion_code: one code for all participants who finish (platforms need that); "" makes a
            code for each participant.
        codes: ``{end: code}``, as ``completion_code``, for the other ends.
        address: the public address with its path, such as ``https://lab.example.org/robots``; ""
            takes it from each request.
        frames: addresses of pages, such as a survey, that may show the study in a frame.
        key: the researcher's key, of 12 characters or more; "" lets the server make a key.
        demo: True admits people as pilots although the consent text is not edited.
        blinded: True hides types and conditions on the researcher's page.
        https: True if the public address uses https.
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
    codes: Mapping[Ending, str] = field(default_factory=lambda: dict.fromkeys(get_args(Ending), ""))
    address: str = ""
    frames: tuple[str, ...] = ()
    key: str = ""
    demo: bool = False
    blinded: bool = True
    https: bool = False

    def __post_init__(self) -> None:
        """Raises InputError if keys contradict each other, or if a file cannot be read."""
        names, entry, studies = list(self.id_names), list(self.entry), list(self.studies)
        back, signed = self.completion_url, "signed" in entry
        # key: value, True if the value is not allowed, what is allowed
        rules: list[tuple[str, object, bool, str]] = [
            ("id_names", names, not 1 <= len(names) <= 3, "1 to 3 names: of a person's id, a "
             "study's id and a session's id"),
            ("studies", studies, bool(studies) and len(names) < 2, "none, because id_names has no "
             "study"),
            ("studies", [], "platform" in entry and not (studies or self.ids), "ids of the studies "
             "whose people may take part, or server.ids=FILE of people's ids"),
            # A paid person with an incomplete link would become a pilot without usable data.
            ("entry", entry, "open" in entry and self.from_platform, "open without platform and "
             "signed"),
            ("signed_by", self.signed_by, signed != bool(self.signed_by), "a file with the key if "
             "server.entry has signed, otherwise none"),
            ("completion_url", back, "{id}" in back and not self.keep_ids, "an address without "
             "{id}, or server.keep_ids=true"),
            ("key", "…", 0 < len(self.key) < LEAST_KEY, f"{LEAST_KEY} characters or more, or none"),
            ("address", self.address, bool(self.address) and not urlsplit(self.address).netloc,
             "an address with https:// or http://, such as https://lab.example.org/robots"),
        ]  # fmt: skip
        for key, value, wrong, allowed in rules:
            if wrong:
                raise InputError(f"server.{key}", value, allowed)
        if self.ids:
            self.read_ids()
        if self.signed_by:
            self.verify("")

    @property
    def path(self) -> str:
        """The path of the address, a prefix of every route, link and cookie; "" for none."""
        return urlsplit(self.address).path.rstrip("/")

    @property
    def from_platform(self) -> bool:
        """True if people enter with a platform's ids, signed or not."""
        return bool({"platform", "signed"} & {*self.entry})

    def read_ids(self) -> set[str]:
        """Reads the ids in the file ``ids``.

        Raises:
            InputError: the file cannot be read.
        """
        try:
            lines = Path(self.ids).read_text(encoding="utf-8-sig").splitlines()
            return {line.strip() for line in lines} - {""}
        except (OSError, UnicodeDecodeError) as error:
            raise InputError("server.ids", self.ids, f"a file of ids ({error})") from None

    def lets_in(self, ids: Sequence[str]) -> bool:
        """True if a person may take part; ``ids`` are the person's values of the parameters
        ``id_names``."""
        whole = bool(ids) and all(0 < len(one) <= 100 and one.isprintable() for one in ids)
        of_study = not self.studies or ids[1] in self.studies
        return whole and of_study and (not self.ids or ids[0] in self.read_ids())

    def verify(self, token: str) -> dict[str, str]:
        """Reads the ids in a signed token, by the names in ``id_names``; empty if the token has
        expired or is not genuine.

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
