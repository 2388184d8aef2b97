"""Talks with people: explanations and questionnaires, each stored as events.

A talk is a session of an explanation, or a questionnaire. An event has a request and the decision
about this request. So a talk can be restored from its events alone, after a crash or an upgrade.

    request ── Talks.begin / receive ── event on the disk ── reply
"""

import json
import secrets
from collections import OrderedDict
from itertools import pairwise
from pathlib import Path
from typing import Any

from xplain.explanation.asking import Question
from xplain.explanation.message_sets import names_of
from xplain.learning.data.label_file import columns_of
from xplain.people.flow import Conflict, Event, State
from xplain.people.log import Log, Unknown
from xplain.people.service.served import ServedTask
from xplain.randomness import derive_seed

Json = dict[str, Any]
MOST_OPEN = 2000
"""Maximum number of talks in memory; others are restored from their events."""
OWN = "participant = ? AND source = 'protocol'"


class ExplanationTalk:
    """The explanation of a trace to one person.

    Attributes:
        decided: the latest action; empty before the first decision.
    """

    def __init__(self, task: ServedTask, begun: Json) -> None:
        trace = [task.row(one) for one in begun["trace"]]
        self.decided: Json = {}
        self.task = task
        self.session = task.session(trace, begun["expected_steps"])

    def receive(self, key: str, came: Json) -> None:
        """Receives labels, the answer to a question, or more of the trace.

        Raises:
            InputError: the request is no answer to the latest action.
        """
        if key.startswith("trace"):
            self.session.extend([self.task.row(one) for one in came["transitions"]])
        elif self.decided["kind"] == "ask":
            self.session.answer(came.get("answer", -1))
        else:
            self.session.observe(came.get("labels", ()))

    def decide(self) -> Json:
        """Returns the next action: to give messages and show the first steps, to ask a question,
        or to wait for more of the trace."""
        session = self.session
        if session.finished:
            return {"kind": "wait", "step": session.shown}
        move = session.next()
        if isinstance(move, Question):
            words = {"text": move.text, "about": move.about, "replies": move.replies}
            return {"kind": "ask", "question": move.number, **words}
        said = self.task.say(move.messages)
        told = {"messages": move.messages, "sentences": said, "again": session.again}
        return {"kind": "explain", **told, "step": move.steps}

    def repeat(self, decided: Json) -> None:
        """Applies an action that was decided earlier to a restored explanation."""
        if decided["kind"] == "ask":
            self.session.ask(decided["question"])
        elif decided["kind"] == "explain":
            self.session.tell(decided["messages"])

    def state(self) -> Json:
        """Returns the belief about the person, the cost so far, the progress, and the reason of
        the latest action."""
        session = self.session
        return {
            "belief": session.belief,
            "fit": session.fit,
            "cost": session.cost,
            "said": session.said,
            "shown": session.shown,
            "known": len(session.trace),
            "why": str(session.why()) if self.decided["kind"] != "wait" else "",
        }


class QuestionnaireTalk:
    """A questionnaire for one person.

    Attributes:
        decided: the latest action; empty before the first decision.
    """

    def __init__(self, task: ServedTask, begun: Json) -> None:
        self.decided: Json = {}
        self.task = task
        self.questionnaire = task.questionnaire.restart(None, begun["seed"])

    def receive(self, key: str, came: Json) -> None:
        """Receives the answer to the last question."""
        about = self.decided["transition"], self.decided["message_set"]
        self.questionnaire.answer(came.get("answer", ()), about)

    def decide(self) -> Json:
        """Chooses the most informative question, until the answers suffice or no questions are
        left."""
        if self.questionnaire.done or len(self.questionnaire.asked) >= self.task.questions:
            return {"kind": "end"}
        transition, given = self.questionnaire.next()
        assert isinstance(transition, int), "no clips of several transitions"
        said = names_of(given, self.questionnaire.hypotheses.messages)
        about = {"transition": transition, "text": self.task.text(transition)}
        told = {"message_set": given, "messages": said, "sentences": self.task.say(said)}
        return {"kind": "ask", **about, **told}

    def repeat(self, decided: Json) -> None:
        """Does nothing: a question changes nothing before its answer."""

    def state(self) -> Json:
        """Returns the most likely set of facts that the person believes incorrectly, and the
        probability of this set."""
        asking = self.questionnaire
        wrong = names_of(asking.best, asking.hypotheses.messages)
        sure = {"probability": float(asking.classes.max()), "no_hypothesis": asking.none}
        return {"believes_incorrectly": wrong, **sure}


Talk = ExplanationTalk | QuestionnaireTalk
KINDS: dict[str, type[ExplanationTalk] | type[QuestionnaireTalk]] = {
    "session": ExplanationTalk,
    "questionnaire": QuestionnaireTalk,
}


class Talks(Log[State]):
    """All talks of a service. Safe to call from several threads."""

    def __init__(self, path: Path, task: ServedTask) -> None:
        """Opens or creates the file.

        Raises:
            InputError: the file is no database of a service, or another process has the file open.
        """
        super().__init__(path, State)
        self.task = task
        self._open: OrderedDict[str, Talk] = OrderedDict()

    def begin(self, kind: str, person: str | None, request: Json) -> tuple[str, Json]:
        """Begins a talk with a person; the caller's name for the person identifies the talk. A
        repeated request returns the same talk.

        Returns:
            The talk's id and the first action.

        Raises:
            Conflict: this person's talk began with other settings.
            InputError: a talk cannot begin with these settings.
        """
        who = person or f"p{secrets.token_hex(8)}"
        begun = {**request, "person": who, "seed": derive_seed(self.task.seed, kind, who)}
        with self.changes():
            which = self.find_owner(f"{kind} {who}") or f"{kind[0]}{secrets.token_hex(12)}"
            return which, self.receive(kind, which, "begin", begun)

    def receive(self, kind: str, which: str, key: str, came: Json) -> Json:
        """Receives the request that begins a talk, the answer to the latest action, or more of a
        trace. Returns the next action. A repeated request gets the same reply.

        Args:
            kind: kind of the talk.
            which: the talk's id.
            key: "begin"; "answer NUMBER" with the number of the answered action; or "trace COUNT"
                with the number of transitions received earlier.
            came: content of the request.

        Raises:
            Unknown: the talk does not exist.
            Conflict: the key was used earlier with another content, or the next request must have
                another key.
            InputError: the request is no answer to the latest action.
        """
        begins = key == "begin"
        try:
            with self.changes():  # talks share plans, so only one talk decides at a time
                talk = KINDS[kind](self.task, came) if begins else self._find_talk(kind, which)
                for before in self.events(f"{OWN} AND kind = ?", which, key):
                    if before.payload != came:
                        raise Conflict(f"{key}: another content was received before")
                    found: Json = json.loads(str(before.state))
                    return found
                decided = talk.decided or {"number": 0, "kind": "begin"}
                number, waits = decided["number"], decided["kind"] in ("wait", "end")
                due = key if begins else "more of the trace" if waits else f"answer {number}"
                if key.startswith("trace") and isinstance(talk, ExplanationTalk):
                    due = f"trace {len(talk.session.trace)}"
                if key != due:
                    raise Conflict(f"{key}: the next request must be {due}")
                if not begins:
                    talk.receive(key, came)
                if waits or not key.startswith("trace"):
                    answers = number + (not key.startswith("trace"))
                    talk.decided = {"number": answers, **talk.decide()}
                self.append(which, "protocol", key, came, state=json.dumps(talk.decided))
                if begins:
                    self.append(which, "identity", "identity", {"key": f"{kind} {came['person']}"})
                    self._keep_open(which, talk)
                return talk.decided
        except BaseException:
            self._open.pop(which, None)  # the talk may be half changed, and nothing was stored
            raise

    def read(self, kind: str, which: str) -> tuple[list[Event], Json]:
        """Returns the events of a talk, and the belief about the person. Changes nothing.

        Raises:
            Unknown: the talk does not exist.
        """
        with self._lock:
            return [*self.events(OWN, which)], self._find_talk(kind, which).state()

    def labels(self, which: str | None = None) -> list[Json]:
        """Lists a row for each answer of one questionnaire, or of all questionnaires: ``observer``,
        ``messages``, ``label``, the features of the transition, and ``finished``.

        Raises:
            Unknown: the questionnaire does not exist.
        """
        with self._lock:
            every = self.group_events("source = 'protocol' AND substr(participant, 1, 1) = 'q'")
            if which and which not in every:
                raise Unknown
            own = [every[which]] if which else every.values()
            return [row for events in own for row in self._list_labels(events)]

    def _list_labels(self, events: list[Event]) -> list[Json]:
        known = self.task.questionnaire.hypotheses
        assert known.features is not None, "transitions that people are asked about have features"
        columns = columns_of(known.features, known.feature_names)
        decided = [json.loads(str(event.state)) for event in events]
        return [
            {
                "observer": events[0].payload["person"],
                "messages": ";".join(asked["messages"]),
                "label": int(event.payload["answer"]),
                **{name: own[asked["transition"]].item() for name, own in columns.items()},
                "finished": int(decided[-1]["kind"] == "end"),
            }
            for (asked, _), event in zip(pairwise(decided), events[1:], strict=True)
        ]

    def forget(self, kind: str, which: str) -> None:
        """Erases a talk and the person's name.

        Raises:
            Unknown: the talk does not exist.
        """
        self._find_talk(kind, which)
        self._open.pop(which, None)
        self.erase(which, keep_key=False)

    def _find_talk(self, kind: str, which: str) -> Talk:
        """Finds a talk, and restores it from its events if needed.

        Raises:
            Unknown: the talk does not exist.
        """
        talk = self._open.pop(which, None) if which[0] == kind[0] else None
        if talk is None:
            events = [*self.events(f"{OWN} AND substr(participant, 1, 1) = ?", which, kind[0])]
            if not events:
                raise Unknown
            talk = KINDS[kind](self.task, events[0].payload)
            for event in events:
                if event is not events[0]:
                    talk.receive(event.kind, event.payload)
                decided = json.loads(str(event.state))
                if decided != talk.decided:
                    talk.repeat(decided)
                talk.decided = decided
        self._keep_open(which, talk)
        return talk

    def _keep_open(self, which: str, talk: Talk) -> None:
        self._open[which] = talk
        if len(self._open) > MOST_OPEN:
            self._open.popitem(last=False)
