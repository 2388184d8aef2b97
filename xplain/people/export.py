"""Would this plan decide all of it again? Every participant's events are taken once more, and each
state that they lead to is compared with the one that was stored."""

from __future__ import annotations

import hashlib
import json
import re
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from filelock import FileLock, Timeout

from xplain.errors import InputError, Refused, one_of
from xplain.people.flow import Flow, S
from xplain.people.plan import StoredPlan

if TYPE_CHECKING:
    import pandas as pd

Plan = TypeVar("Plan", bound=StoredPlan)
STREAMS = ("person", "pilot", "bot")
"""Whose data it is; fixed by the invitation, and never mixed in an analysis."""


@contextmanager
def opened(path: Path) -> Iterator[sqlite3.Connection]:
    """A read-only connection to a study's database.

    Raises:
        InputError: it is no study's database.
    """
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    connection.row_factory = sqlite3.Row
    try:
        connection.execute("SELECT 1 FROM meta")
        yield connection
    except sqlite3.DatabaseError as error:
        raise InputError("database", str(path), f"not a study's database ({error})") from None
    finally:
        connection.close()


@contextmanager
def reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A read-only connection to a study's database that no server has open.

    Raises:
        InputError: there is none, it is in use, or it is no study's database.
    """
    if not path.is_file():
        raise InputError("database", str(path), "a study's database or a snapshot of one")
    lock = Path(f"{path}.lock")
    try:
        with FileLock(lock, timeout=0) if lock.exists() else nullcontext(), opened(path) as read:
            yield read
    except Timeout:
        wanted = "in use by a server; take the snapshot that the researcher's page offers"
        raise InputError("database", str(path), wanted) from None


def copied(database: Path, file: Path) -> None:
    """Copies a database, which its server may have open, with the key beside it.

    Raises:
        InputError: it is no such database, its key is missing, or the file exists.
    """
    key = Path(f"{database}.key")
    if not database.is_file() or not key.is_file():
        raise InputError("database", str(database), f"a database with {key.name} beside it")
    if file.exists():
        raise InputError("file", str(file), "a new file")
    with opened(database) as source, closing(sqlite3.connect(file)) as copy:
        source.backup(copy)
    for path, mode in ((file, 0o600), (Path(f"{file}.key"), 0o600)):
        if path != file:
            path.write_bytes(key.read_bytes())
        path.chmod(mode)


def plan_of(connection: sqlite3.Connection, kind: type[Plan]) -> Plan:
    """The plan that the data was collected under.

    Raises:
        InputError: there is none yet, or it is one of another kind or version.
    """
    row = connection.execute("SELECT value FROM meta WHERE key = 'plan'").fetchone()
    (_, _, path) = connection.execute("PRAGMA database_list").fetchone()
    if row is None:
        raise InputError("database", path, f"a database in which {kind.OF} was started")
    try:
        return kind.from_text(row[0])
    except InputError as error:
        raise InputError("database", path, error.allowed) from None


def rows_of(
    path: Path, stream: str, kind: type[Plan], query: str
) -> tuple[Plan, list[sqlite3.Row]]:
    """The plan, and what a query finds of the people of a stream.

    Args:
        path: of a database that no server has open, or a snapshot.
        stream: "person", "pilot" or "bot"; never mixed.
        kind: class of the plan.
        query: with one place, for the stream.

    Raises:
        InputError: it is no such flow's database, or there is no such stream.
    """
    one_of("stream", stream, STREAMS)
    with reading(path) as connection:
        return plan_of(connection, kind), connection.execute(query, (stream,)).fetchall()


def read_plan(path: Path, kind: type[Plan]) -> Plan | None:
    """The plan in a database; None where there is none yet.

    Raises:
        InputError: the file is no such database.
    """
    if not path.exists() or not path.stat().st_size:
        return None
    with opened(path) as connection:
        started = connection.execute("SELECT 1 FROM meta WHERE key = 'plan'").fetchone()
        return plan_of(connection, kind) if started else None


CODEBOOK = {
    "events": {
        "participant": "key",
        "sequence": "order of arrival at the server, 0, 1, …",
        "source": "protocol (answers), server, shown (first renderings), tab:… (a page's reports)",
        "source_sequence": "order at the source",
        "kind": "of the event",
        "wall": "server's wall clock, seconds since 1970-01-01 UTC",
        "monotonic": "server's monotonic clock, seconds; comparable where boot is the same",
        "boot": "id of the machine's boot",
        "browser": "the page's performance.now, milliseconds since the page began to load",
        "number": "order of arrival of all participants' events",
        "state": "JSON: where the participant is after it, with what was decided; empty: as before",
        "payload": "JSON; of a tab: at = browser's wall clock in ms, what = detail",
    },
    "codebook": {
        "table": "name of the file",
        "column": "name of the column",
        "type": "text, whole number, number or JSON",
        "unit": "s, ms or px; empty where there is none",
        "meaning": "this text",
    },
}

_WHOLE = {
    *("eligibility_attempts", "eligible", "steps_labelled", "messages_given", "attempt", "true"),
    *("inexplicable_transitions", "quiz_score", "timed_out", "window_width", "attention_missed"),
    *("k", "i", "label", "step", "sequence", "source_sequence", "number", "correct", "ticked"),
    *("questions_asked", "clip"),
    *("in_labels", "observers.labels", "attentive", "practice_errors", "cannot_tell", "fast_pages"),
}
_JSON = {"belief_before", "belief_after", "action_values", "steps.labels", "payload"}
_JSON |= {"state"}
_NUMBERS = {"consistency", "posterior", "unlike", "bits", "cost", "worth"}
_UNITS = {
    "s": {"entered", "last_seen", "shown", "seconds", "wall", "monotonic"},
    "ms": {"browser", "browser_ms"},
    "px": {"window_width"},
}


def unit_of(column: str) -> str:
    """The unit of a column's numbers; "" where they have none."""
    own = [unit for unit, columns in _UNITS.items() if column in columns]
    return own[0] if own else "s" if column.endswith("_s") else ""


def kind_of(table: str, column: str) -> str:
    """What a column holds."""
    column = column.removesuffix("…")
    names = {column, f"{table}.{column}"}
    if names & _WHOLE:
        return "whole number"
    if names & _JSON:
        return "JSON"
    return "number" if names & _NUMBERS or unit_of(column) else "text"


def explained(codebook: Mapping[str, Mapping[str, str]]) -> list[dict[str, str]]:
    """Rows of the codebook as a table."""
    return [
        {
            "table": table,
            "column": column,
            "type": kind_of(table, column),
            "unit": unit_of(column),
            "meaning": meaning,
        }
        for table, columns in codebook.items()
        for column, meaning in columns.items()
    ]


Row = dict[str, Any]
Codebook = Mapping[str, Mapping[str, str]]
"""What every column of every table means."""
OTHERS = "…"
"""Ends an entry of a codebook that stands for every column beginning with what is before it."""
_NUMBER = re.compile(r"[+-]?\d+(\.\d*)?(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
_FORMULAS = ("=", "+", "-", "@", "\t", "\r", "＝", "＋", "－", "＠")


@dataclass(frozen=True)
class ParticipantRow(Generic[S]):
    """A row of the participant table, with its state and events in order, payloads decoded."""

    row: Row
    state: S
    events: tuple[Row, ...] = ()

    @property
    def id(self) -> str:
        """As in every table."""
        return str(self.row["id"])

    @property
    def moves(self) -> list[Row]:
        """The events that changed their state, in order."""
        return [event for event in self.events if event["state"] and event["kind"] != "enter"]

    def answers(self, kind: str) -> list[Row]:
        """The accepted answers of a kind, in order."""
        return [e for e in self.events if e["source"] == "protocol" and e["kind"] == kind]

    def first(self, kind: str) -> Row:
        """The payload of the first answer of a kind; empty where there is none."""
        return next((event["payload"] for event in self.answers(kind)), {})


def participants(connection: sqlite3.Connection, kind: type[S]) -> list[ParticipantRow[S]]:
    """Everybody who was not erased, in the order in which they came."""
    rows = connection.execute("SELECT * FROM seen WHERE NOT erased ORDER BY number").fetchall()
    events: dict[str, list[Row]] = {row["id"]: [] for row in rows}
    for event in connection.execute("SELECT * FROM event ORDER BY participant, sequence"):
        if event["participant"] in events:
            read = dict(event) | {"payload": json.loads(event["payload"])}
            events[event["participant"]].append(read)
    return [
        ParticipantRow(dict(row), kind.from_text(row["state"]), tuple(events[row["id"]]))
        for row in rows
    ]


def described(name: str, rows: Iterable[Row], codebook: Mapping[str, Any]) -> pd.DataFrame:
    """A table of rows with the columns of its codebook, in that order; those that one entry stands
    for (:data:`OTHERS`) come last, in their own.

    Raises:
        ValueError: a row has a column that the codebook does not describe, or lacks one that it
            does: an export would lose it, or leave it unexplained.
    """
    import pandas as pd

    rows = list(rows)
    fixed = [column for column in codebook if not column.endswith(OTHERS)]
    beginnings = tuple(column[: -len(OTHERS)] for column in codebook if column.endswith(OTHERS))
    others = [column for column in (rows[0] if rows else {}) if column not in codebook]
    unknown = [column for column in others if not column.startswith(beginnings)]
    missing = {column for row in rows for column in {*fixed, *others} ^ row.keys()}
    if unknown or missing:
        raise ValueError(f"{name}: not as its codebook says: {sorted({*unknown, *missing})}")
    return pd.DataFrame(rows, columns=[*fixed, *others])


def defused(cell: Any) -> Any:
    """A text that a spreadsheet would run as a formula, with an apostrophe before it; numbers
    stay as they are."""
    if not isinstance(cell, str) or cell[:1] not in _FORMULAS or _NUMBER.fullmatch(cell):
        return cell
    return f"'{cell}"


def seconds(first: Row, last: Row) -> tuple[float | None, str]:
    """From an event to a later one, and by which of the server's clocks: the monotonic one, or the
    wall clock where the machine was restarted in between. None where it cannot be, because the
    wall clock was set back."""
    clock = "monotonic" if first["boot"] == last["boot"] else "wall"
    took = last[clock] - first[clock]
    return (took, clock) if took >= 0 else (None, "impossible")


def write(
    database: Path,
    folder: Path,
    plan: type[Plan],
    state: type[S],
    tables: Callable[[Plan, list[ParticipantRow[S]]], Mapping[str, Iterable[Row]]],
    codebook: Codebook,
) -> tuple[str, Plan, list[ParticipantRow[S]]]:
    """Writes the tables of a database (better: of a snapshot) into a folder, with the events of
    everybody who is in them, the codebook and the plan; and SHA-256 of the file of events, to be
    published with a preregistration.

    Args:
        database: of a flow.
        folder: to write into.
        plan, state: classes of its plan and of its states.
        tables: rows of every table by name, of the plan, the participants and the steps.
            codebook: of these tables.

    Returns:
        The hash, the plan, and the participants.

    Raises:
        InputError: it is no such flow's database.
    """
    book = {**codebook, **CODEBOOK}
    with reading(database) as connection:
        own, people = plan_of(connection, plan), participants(connection, state)
        rows = dict(tables(own, people))
        (stored,) = connection.execute("SELECT value FROM meta WHERE key = 'plan'").fetchone()
    rows["codebook"] = explained(book)
    folder.mkdir(parents=True, exist_ok=True)
    for name in rows:
        table = described(name, rows[name], book[name])
        table.map(defused).to_csv(folder / f"{name}.csv", index=False)
        table.to_parquet(folder / f"{name}.parquet", index=False)
    text = json.dumps(json.loads(stored), indent=1, ensure_ascii=False)
    (folder / "plan.json").write_text(f"{text}\n", encoding="utf-8")
    digest = hashlib.sha256((folder / "events.csv").read_bytes()).hexdigest()
    (folder / "SHA256SUMS").write_text(f"{digest}  events.csv\n", encoding="ascii")
    return digest, own, people


def write_identifiers(database: Path, file: Path) -> None:
    """Writes who is who, for paying people, apart from the tables that may be published: a row a
    participant with the completion code and, where the server keeps them, the platform's ids.

    Raises:
        InputError: it is no database of a study or a collection.
    """
    import pandas as pd

    query = (
        "SELECT id AS participant, code AS completion_code, kept FROM participant WHERE NOT erased"
    )
    with reading(database) as connection:
        rows = [dict(row) for row in connection.execute(f"{query} ORDER BY number")]
    table = pd.DataFrame([row | json.loads(row.pop("kept")) for row in rows])
    table.map(defused).to_csv(file, index=False)


def events_of(people: Iterable[ParticipantRow[Any]]) -> list[Row]:
    """Rows of the table of events."""
    return [
        event | {"payload": json.dumps(event["payload"], sort_keys=True)}
        for one in people
        for event in one.events
    ]


@dataclass
class Findings:
    """How many people and events were compared, how many people were erased, and what differs."""

    participants: int = 0
    events: int = 0
    erased: int = 0
    differences: list[str] = field(default_factory=list)


def replayed(
    connection: sqlite3.Connection, flow: Flow[Any, S], latest: int | None = None
) -> tuple[Findings, list[ParticipantRow[S]]]:
    """What differs, and everybody who was not erased.

    Args:
        connection: to the database; its rows are mappings.
        flow: at work.
        latest: how many participants, those who came last; None takes all.
    """
    people = participants(connection, flow.STATE)[-(latest or 0) :]
    (erased,) = connection.execute("SELECT sum(erased) FROM participant").fetchone()
    found = Findings(len(people), erased=erased or 0)
    for one in people:
        state = flow.STATE()
        for event in one.moves:
            found.events += 1
            try:
                state = flow.advance(state, event["kind"], event["payload"])
            except (Refused, KeyError) as error:
                found.differences.append(f"{one.id}: event {event['sequence']}: {error}")
                break
            stored, again = json.loads(event["state"]), json.loads(state.text)
            for key in again:
                if stored.get(key) != again[key]:
                    what = f"{key} is {stored.get(key)}, decided again {again[key]}"
                    found.differences.append(f"{one.id}: event {event['sequence']}: {what}")
    return found, people
