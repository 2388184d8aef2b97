"""A log that shows whether it was changed: every event carries a hash of itself and of all before.

``content`` is SHA-256 of an event with its participant's salt, ``digest`` SHA-256 of the digest
before and this content; the first digest follows the hash of the plan. Who keeps one digest can
tell later that nothing up to it was changed, left out or put in. An erased participant loses data
and salt: their contents stay as links, and nothing can be guessed from them.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Sequence
from typing import Any

FIELDS = (
    *("participant", "sequence", "source", "source_sequence", "kind"),
    *("wall", "monotonic", "boot", "browser", "payload"),
)
"""The columns of an event that its content covers."""
ERASED = "erased"
"""Kind of an event whose data was erased; the event that says so is of the kind ``erase``."""


def content_of(event: Sequence[Any], salt: str) -> str:
    """SHA-256 of the values of FIELDS."""
    text = json.dumps([salt, *event], ensure_ascii=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def linked(before: str, content: str) -> str:
    """The digest of an event."""
    return hashlib.sha256(f"{before}{content}".encode()).hexdigest()


def head_of(connection: sqlite3.Connection) -> str:
    """The digest of the last event (the plan's hash where there is none)."""
    (head,) = connection.execute("SELECT value FROM meta WHERE key = 'head'").fetchone()
    return str(head)


def differences(connection: sqlite3.Connection, known: str = "") -> list[str]:
    """What is wrong with the log, a line each.

    Args:
        connection: to the database; its rows are mappings.
        known: a digest from an earlier export, or its first characters; "" for none.
    """
    found = []
    meta = dict(connection.execute("SELECT key, value FROM meta").fetchall())
    plan, digest = meta["plan"], meta["plan_hash"]
    if hashlib.sha256(plan.encode()).hexdigest() != digest:
        found.append("the stored plan is not the one that its hash names")
    salts = {row["id"]: row["salt"] for row in connection.execute("SELECT * FROM participant")}
    gone = {
        row["participant"]
        for row in connection.execute("SELECT participant FROM event WHERE kind = 'erase'")
    }
    met = known == "" or digest.startswith(known)
    for number, event in enumerate(connection.execute("SELECT * FROM event ORDER BY number"), 1):
        who = event["participant"]
        if event["number"] != number:
            found.append(f"event {number} of the log is missing")
            return found
        salt, erased = salts.get(who), who in gone and event["kind"] == ERASED
        content = None if salt is None else content_of([event[field] for field in FIELDS], salt)
        if not erased and event["content"] != content:
            found.append(f"{who}: event {event['sequence']} ({event['kind']}) was changed")
        digest = linked(digest, event["content"])
        if event["digest"] != digest:
            found.append(f"the log was changed before or at its event {number}")
            return found
        met = met or digest.startswith(known)
    if meta["head"] != digest:
        found.append("events are missing at the end of the log")
    if not met:
        found.append(f"the log never had the digest {known}")
    return found
