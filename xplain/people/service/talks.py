"""Talks with people, explanations and questionnaires, as the events of each in one SQLite file.

A row holds what came in and what was decided then, so a talk is taken up from its rows alone:
wherever the process was killed, and whatever was installed meanwhile.

    request ── Talks.begin / receive ── row on the disk ── reply
"""

from __future__ import annotations

import json
import secrets
import sqlite3
import threading
import time
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from xplain.errors import InputError
from xplain.explanation.asking import Question
from xplain.explanation.message_sets import names_of
from xplain.people.service.served import Served
from xplain.randomness import derived_seed

Json = dict[str, Any]
SCHEMA = """
CREATE TABLE IF NOT EXISTS talk (
  id TEXT PRIMARY KEY, kind TEXT NOT NULL, person TEXT NOT NULL, UNIQUE (kind, person)) STRICT;
CREATE TABLE IF NOT EXISTS event (
  position INTEGER PRIMARY KEY, talk TEXT NOT NULL REFERENCES talk, key TEXT NOT NULL,
  came TEXT NOT NULL, decided TEXT NOT NULL, wall REAL NOT NULL, UNIQUE (talk, key)) STRICT;
"""
"""``key`` of an event: "begin", "answer 7", or "trace 3" (after three transitions)."""
MOST_OPEN = 2000
"""Talks kept in memory; others are taken up from their rows."""


class Unknown(Exception):
    """There is no such talk."""


class Conflict(Exception):
    """Something else was received under this number, or the number was never given out."""


class Row(NamedTuple):
    """An event: its key, what came in, and what was decided then."""

    key: str
    came: Json
    decided: Json


class Talk(ABC):
    """An explanation or a questionnaire of one person.

    Attributes:
        decided: what is open now; empty before anything was decided.
    """

    decided: Json

    def __init__(self) -> None:
        self.decided, self.answered = {}, 0

    def take(self, row: Row) -> None:
        """Goes on with an event that is on the disk, without deciding anything anew."""
        self.receive(row.key, row.came)
        if row.decided != self.decided:
            self.repeat(row.decided)
        self.decided = row.decided

    def reply(self, key: str, came: Json) -> Json:
        """Receives something new, and decides what to do next.

        Raises:
            InputError: it is no answer to what is open.
        """
        waits = not self.decided or self.decided["kind"] in ("wait", "end")
        self.receive(key, came)
        if waits or key.startswith("answer"):
            self.decided = {"number": self.answered + 1, **self.decide()}
        return self.decided

    @abstractmethod
    def receive(self, key: str, came: Json) -> None:
        """What came in."""

    @abstractmethod
    def decide(self) -> Json:
        """What to do next."""

    @abstractmethod
    def repeat(self, decided: Json) -> None:
        """Does what was decided before."""

    @abstractmethod
    def state(self) -> Json:
        """What is believed of the person."""


class Explanation(Talk):
    """A trace explained to one person."""

    def __init__(self, task: Served, begun: Json) -> None:
        super().__init__()
        trace = [task.row(one) for one in begun["trace"]]
        self.task = task
        self.session = task.explainer.session(
            trace, begun["expected_steps"], task.candidates(trace)
        )

    def receive(self, key: str, came: Json) -> None:
        """Labels, the answer to a question, or more of the trace."""
        if key.startswith("trace"):
            self.session.extend([self.task.row(one) for one in came["transitions"]])
        elif key != "begin":
            if self.decided["kind"] == "ask":
                self.session.answer(came.get("answer", -1))
            else:
                self.session.observe(came.get("labels", ()))
            self.answered += 1

    def decide(self) -> Json:
        """The messages and how much to show, or a question."""
        session = self.session
        if session.finished:
            return {"kind": "wait", "step": session.shown}
        move = session.next()
        if isinstance(move, Question):
            words = {"text": move.text, "about": move.about, "replies": move.replies}
            return {"kind": "ask", "question": move.number, **words}
        said = session.messages()
        sentences = [self.task.sentences[name] for name in said]
        told = {"messages": said, "sentences": sentences, "again": session.again}
        return {"kind": "explain", **told, "step": session.shown}

    def repeat(self, decided: Json) -> None:
        """Says or asks the same."""
        if decided["kind"] == "ask":
            self.session.ask(decided["question"])
        elif decided["kind"] == "explain":
            self.session.tell(decided["messages"])

    def state(self) -> Json:
        """Belief, cost, and the values behind the last decision."""
        session = self.session
        found = {"belief": session.belief, "fit": session.fit, "cost": session.cost}
        why = str(session.why()) if self.decided.get("kind") != "wait" else ""
        return {
            **found,
            "said": session.said,
            "shown": session.shown,
            "known": len(session.trace),
            "why": why,
        }


class Asking(Talk):
    """A questionnaire put to one person."""

    def __init__(self, task: Served, begun: Json) -> None:
        super().__init__()
        self.task = task
        self.questionnaire = task.questionnaire.anew(None, begun["seed"])

    def receive(self, key: str, came: Json) -> None:
        """The answer to the last question."""
        if key != "begin":
            about = self.decided["transition"], self.decided["message_set"]
            self.questionnaire.answer(came.get("answer", ()), about)
            self.answered += 1

    def decide(self) -> Json:
        """The question that tells most, until enough is known or asked."""
        if self.questionnaire.done or self.answered >= self.task.questions:
            return {"kind": "end"}
        transition, given = self.questionnaire.next()
        assert isinstance(transition, int), "no clips of several transitions"
        said = names_of(given, self.questionnaire.hypotheses.messages)
        about = {"transition": transition, "text": self.task.text(transition)}
        sentences = [self.task.sentences.get(name, name) for name in said]
        told = {"message_set": given, "messages": said, "sentences": sentences}
        return {"kind": "ask", **about, **told}

    def repeat(self, decided: Json) -> None:
        """Nothing: a question changes nothing before its answer."""

    def state(self) -> Json:
        """The facts that they believe incorrectly, the likeliest, and how sure that is."""
        asking = self.questionnaire
        wrong = names_of(asking.best, asking.hypotheses.messages)
        sure = {"probability": float(asking.classes.max()), "no_hypothesis": asking.none}
        return {"believes_incorrectly": wrong, **sure}


KINDS: dict[str, type[Explanation] | type[Asking]] = {
    "session": Explanation,
    "questionnaire": Asking,
}


class Talks:
    """All talks of a service. Safe to call from several threads and processes."""

    def __init__(self, path: Path, task: Served) -> None:
        """Opens or creates the file.

        Raises:
            InputError: it is no database.
        """
        self.task = task
        self._open: OrderedDict[str, tuple[Talk, int]] = OrderedDict()
        self._lock = threading.RLock()
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._sql = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
            for pragma in ("journal_mode=WAL", "synchronous=FULL", "secure_delete=ON"):
                self._sql.execute(f"PRAGMA {pragma}")
            self._sql.executescript(SCHEMA)
        except sqlite3.Error as error:
            raise InputError("database", str(path), f"cannot be used ({error})") from None

    def close(self) -> None:
        """Lets go of the file."""
        self._sql.close()

    def begin(self, kind: str, person: str | None, request: Json) -> tuple[str, Json]:
        """A talk with somebody, by their name among the caller's; the same one when it is asked
        for again.

        Returns:
            Its id, and what to do first.

        Raises:
            Conflict: that person's talk began otherwise.
            InputError: it cannot begin so.
        """
        who = person or f"p{secrets.token_hex(8)}"
        seeded = {**request, "seed": derived_seed(self.task.seed, kind, who)}
        if (known := self._begun(kind, who, seeded)) is not None:
            return known
        talk, which = KINDS[kind](self.task, seeded), f"{kind[0]}{secrets.token_hex(12)}"
        decided = talk.reply("begin", seeded)  # outside the lock: planning takes a while
        with self._transaction():
            if (known := self._begun(kind, who, seeded)) is not None:
                return known
            self._sql.execute("INSERT INTO talk VALUES (?, ?, ?)", (which, kind, who))
            self._write(which, talk, Row("begin", seeded, decided), 0)
            return which, decided

    def _begun(self, kind: str, person: str, request: Json) -> tuple[str, Json] | None:
        """The id and the first decision of the talk that this person has, if any.

        Raises:
            Conflict: that talk began otherwise.
        """
        query = "SELECT id FROM talk WHERE kind = ? AND person = ?"
        with self._lock:
            found = self._sql.execute(query, (kind, person)).fetchone()
            if found is None:
                return None
            first = self._rows(found[0], kind)[0]
        if first.came != request:
            raise Conflict(f"person {person} began with other values")
        return found[0], first.decided

    def receive(self, kind: str, which: str, key: str, came: Json) -> Json:
        """Takes an answer (key "answer NUMBER") or more of a trace ("trace TRANSITIONS BEFORE"),
        once: what is received again is replied to as before.

        Raises:
            Unknown: no such talk.
            Conflict: something else came under this key, or nothing was to come under it.
            InputError: it is no answer to what is open.
        """
        with self._transaction():
            rows = self._rows(which, kind)
            before = next((row for row in rows if row.key == key), None)
            if before is not None:
                if before.came != came:
                    raise Conflict(f"{key}: something else was received before")
                return before.decided
            talk = self._talk(which, kind, rows)
            if key != self._due(talk, key):
                raise Conflict(f"{key}: due is {self._due(talk, key)}")
            try:
                decided = talk.reply(key, came)
            except BaseException:
                self._open.pop(which)  # half of it may be received
                raise
            self._write(which, talk, Row(key, came, decided), len(rows))
            return decided

    @staticmethod
    def _due(talk: Talk, key: str) -> str:
        if key.startswith("trace"):
            return f"trace {len(talk.session.trace)}" if isinstance(talk, Explanation) else ""
        waits = talk.decided["kind"] in ("wait", "end")
        return "more of the trace" if waits else f"answer {talk.decided['number']}"

    def read(self, kind: str, which: str) -> tuple[list[Row], Json]:
        """The events of a talk, and what is believed of the person. Nothing changes.

        Raises:
            Unknown: no such talk.
        """
        with self._lock:
            rows = self._rows(which, kind)
            return rows, self._talk(which, kind, rows).state()

    def labels(self, which: str | None = None) -> list[Json]:
        """A row for each answer of one questionnaire or of all: ``observer``, ``messages``,
        ``label``, the features of the transition, and whether the observer has finished.

        Raises:
            Unknown: no such questionnaire.
        """
        query = "SELECT id, person FROM talk WHERE kind = 'questionnaire' AND ? IN ('', id)"
        with self._lock:
            found = self._sql.execute(query, (which or "",)).fetchall()
            if which and not found:
                raise Unknown
            return [row for one, person in found for row in self._labels(one, person)]

    def _labels(self, which: str, person: str) -> list[Json]:
        rows, known = self._rows(which, "questionnaire"), self.task.questionnaire.hypotheses
        assert known.features is not None, "transitions that people are asked about have features"
        finished = int(rows[-1].decided["kind"] == "end")
        return [
            {
                "observer": person,
                "messages": ";".join(asked.decided["messages"]),
                "label": int(row.came["answer"]),
                **dict(
                    zip(
                        known.feature_names,
                        known.features[asked.decided["transition"]].tolist(),
                        strict=True,
                    )
                ),
                "finished": finished,
            }
            for asked, row in pairwise(rows)
        ]

    def erase(self, kind: str, which: str) -> None:
        """Forgets a talk and its person.

        Raises:
            Unknown: no such talk.
        """
        with self._transaction():
            self._rows(which, kind)
            self._open.pop(which, None)
            self._sql.execute("DELETE FROM event WHERE talk = ?", (which,))
            self._sql.execute("DELETE FROM talk WHERE id = ?", (which,))

    def _rows(self, which: str, kind: str) -> list[Row]:
        sql = (
            "SELECT key, came, decided FROM event JOIN talk ON id = talk "
            "WHERE talk = ? AND kind = ? ORDER BY position"
        )
        found = self._sql.execute(sql, (which, kind)).fetchall()
        if not found:
            raise Unknown
        return [Row(key, json.loads(came), json.loads(decided)) for key, came, decided in found]

    def _talk(self, which: str, kind: str, rows: list[Row]) -> Talk:
        """The talk as its rows have it."""
        talk, known = self._open.pop(which, (None, 0))
        if talk is None:
            talk = KINDS[kind](self.task, rows[0].came)
        for row in rows[known:]:
            talk.take(row)
        self._keep(which, talk, len(rows))
        return talk

    def _keep(self, which: str, talk: Talk, count: int) -> None:
        self._open[which] = talk, count
        if len(self._open) > MOST_OPEN:
            self._open.popitem(last=False)

    def _write(self, which: str, talk: Talk, row: Row, count: int) -> None:
        values = which, row.key, json.dumps(row.came), json.dumps(row.decided), time.time()
        self._sql.execute("INSERT INTO event VALUES (NULL, ?, ?, ?, ?, ?)", values)
        self._keep(which, talk, count + 1)

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """All or nothing; on the disk when it is left without an error."""
        with self._lock:
            self._sql.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._sql.execute("COMMIT")
            except BaseException as error:
                if isinstance(error, sqlite3.Error):
                    self._open.clear()  # what they received is not on the disk
                if self._sql.in_transaction:
                    self._sql.execute("ROLLBACK")
                raise
