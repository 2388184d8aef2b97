"""How the participants of a study listened and answered, from its log (``study habits``)."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from xplain.errors import InputError, one_of
from xplain.explanation.listening import Explained
from xplain.explanation.message_sets import names_of
from xplain.people.export import (
    STREAMS,
    ParticipantRow,
    Row,
    events_of,
    participants,
    plan_of,
    reading,
    seconds,
    write,
)
from xplain.people.flow import CANNOT_TELL
from xplain.people.study.flow import StudyState
from xplain.people.study.plan import StudyPlan

_COMPARISON = {
    "measure": "of participants.csv",
    "n_…": "participants, by condition",
    "mean_…": "by condition",
    "sd_…": "standard deviation, by condition",
    "student_…": "t, df, p of Student's test; p_holm corrected for the three measures",
    "welch_…": "t, df, p of Welch's test",
    "hedges_g": "standardized difference, the first condition less the second",
    "g_low": "lower end of its 95 % interval",
    "g_high": "upper end",
    "permutation_p": "of a permutation test within types",
}

CODEBOOK = {
    "participants": {
        "participant": "random id; the key of every table",
        "stream": "person, pilot or bot; decided by the invitation, never changed",
        "entry": "invitation, platform, open or preview",
        "stage": "where they are or how it ended: done, declined, ineligible, withdrawn, timed_out",
        "type": "user type whose knowledge they were given",
        "condition": "explanation technique",
        "eligibility_attempts": "eligibility tests taken",
        "eligible": "1 if the test was passed",
        "steps_labelled": "steps of the trace with a label",
        "messages_given": "messages that the robot gave (of the policy, until the last step), each "
        "counted once",
        "inexplicable_transitions": "labels 'makes no sense' at the last step, 0 … m; paper: "
        "measure 2",
        "cannot_tell": "transitions of which they could not tell, at the last step",
        "quiz_score": "statements judged correctly, 0 … 4; paper: measure 3",
        "interaction_time_s": "seconds, server's clock, first rendering of step 1, or of a "
        "question before it, to the last accepted label; paper: measure 1",
        "clock": "by which that is: monotonic, or wall where the machine was restarted in between; "
        "impossible where the wall clock was set back, and the time is left out",
        "hidden_s": "seconds of it in which no page of the study was visible (browser's clock); "
        "empty without JavaScript",
        "visible_time_s": "interaction_time_s less hidden_s",
        "entered": "server's wall clock, seconds since 1970-01-01 UTC",
        "last_seen": "server's wall clock, seconds since 1970-01-01 UTC",
        "consent_hash": "SHA-256 of the consent text agreed to (or declined)",
        "timed_out": "times that they were silent for too long, and came back or not",
        "window_width": "of the window at the consent, CSS pixels; empty without JavaScript",
        "attention_missed": "attention checks after the quiz that were answered wrongly",
        "messages_again…": "how often it said one of the messages again; only where it may",
        "questions_asked…": "steps that they were asked about in between; only where a condition "
        "asks",
        "cost…": "λ · messages + inexplicable labels of all steps + κ · questions, as the plan has "
        "these costs; what the policies plan for; only where a condition asks",
    },
    "steps": {
        "participant": "key",
        "k": "step of the evaluation, 0 … m − 1",
        "transition": "what the robot did, as shown",
        "given_before": "messages on the page before this step, joined by ;",
        "messages": "messages that were said at this step, for the first time or again, joined by "
        ";",
        "belief_before": "probability of each user type (JSON list), before the step",
        "belief_after": "the same after the labels of the step",
        "action_values": "the policy's value of each next message set (JSON, bitmask: value; "
        "0 = explain at once; larger is better)",
        "labels": "labels of transitions 0 … k (JSON list), as in the table of labels",
        "seconds": "from the first rendering of the step to its accepted labels, server's clock",
    },
    "pages": {
        "participant": "key",
        "sequence": "number of the answer that the page was for",
        "stage": "which page",
        "step": "k, of the evaluation's pages; of a question that of the step after it",
        "shown": "first rendering, server's wall clock, seconds since 1970-01-01 UTC",
        "seconds": "until its answer was accepted, server's clock; empty if it never was",
        "browser_ms": "the same by the page's performance.now when the answer was sent",
    },
    "labels": {
        "participant": "key",
        "k": "step at which the label was given",
        "i": "transition that was labelled, 0 … k",
        "transition": "what the robot did, as shown",
        "messages_shown": "all messages on the page, joined by ;",
        "label": "1 = makes sense, 0 = makes no sense, 2 = they cannot tell",
    },
    "questions": {
        "participant": "key",
        "number": "0, 1, … of the participant's questions",
        "k": "step of the evaluation that came next",
        "clip": "number of the step asked about, in the plan's list of clips",
        "transition": "what the robot does in it, as shown",
        "situation": "what is so before it, as shown; may be empty",
        "messages_shown": "all messages on the page, joined by ;",
        "worth": "by how much the policy expected the question to lower cost (discounted, the "
        "question's own cost taken off); empty where the policy does not tell",
        "belief_before": "probability of each user type (JSON list), before the answer",
        "belief_after": "the same after it; empty if it was not answered",
        "label": "as in the table of labels; empty if it was not answered",
        "seconds": "from the first rendering of the page to its accepted answer, server's clock",
    },
    "eligibility": {
        "participant": "key",
        "attempt": "1, 2, …",
        "fact": "parameter asked about",
        "question": "as shown",
        "answer": "as chosen",
        "correct": "1 if it is what the participant had been told",
    },
    "quiz": {
        "participant": "key",
        "fact": "parameter that the statement is about",
        "statement": "as shown",
        "true": "1 if it is true of the robot",
        "ticked": "1 if the participant ticked it",
        "correct": "1 if ticked = true",
    },
    "table2": _COMPARISON | {"paper_…": "what the paper has there"},
    "asking": _COMPARISON,
    "flow": {
        "stage": "reached, or how it ended; then reasons of leaving somebody out",
        "all": "participants",
        "conformant": "of that condition",
        "personalized": "of that condition",
        "asking…": "of that condition, where there is one",
    },
    "answers": {
        "participant": "key",
        "question": "name in the configuration",
        "answer": "as given; empty if left out",
    },
}

Participant = ParticipantRow[StudyState]
SLEEP = 2.0
"""Seconds by which a device's clock runs ahead of a page's own after a sleep."""
EVALUATING = ("evaluation", "asking")
"""Stages whose pages are the evaluation."""


def export(database: Path, folder: Path) -> str:
    """Writes all tables of a database (better: of a snapshot) into a folder; SHA-256 of the events.

    Raises:
        InputError: it is no study's database.
    """
    return write(database, folder, StudyPlan, StudyState, tables, CODEBOOK)[0]


def steps_of(one: Participant) -> list[Row]:
    """What was decided at each step of somebody's evaluation, and their labels of it."""
    steps: dict[int, Row] = {}
    for event in one.moves:
        state = StudyState.from_text(event["state"])
        if event["kind"] == "labels":
            k = len(event["payload"]["labels"]) - 1
            answer = (event["payload"]["labels"], state.after)
            steps[k] |= dict(zip(("labels", "belief_after"), map(json.dumps, answer), strict=True))
        if state.stage == "evaluation" and state.step not in steps:
            steps[state.step] = {
                "participant": one.id,
                "k": state.step,
                "belief_before": json.dumps(state.before),
                "given": state.previous or 0,
                "messages": state.new,
                "action_values": json.dumps(state.values),
                "labels": None,
                "belief_after": None,
            }
    return list(steps.values())


def tables(plan: StudyPlan, people: list[Participant]) -> dict[str, Iterable[Row]]:
    """Rows of every table by name. Answers of participants who withdrew are left out."""
    everybody, people = people, [one for one in people if one.state.stage != "withdrawn"]
    steps = [step for one in sorted(people, key=lambda one: one.id) for step in steps_of(one)]
    shown = [page for one in people for page in pages(one.events)]
    took = {
        (page["participant"], page["step"]): page["seconds"]
        for page in shown
        if page["stage"] == "evaluation"
    }
    asked = [row for one in people for row in _questions(plan, one, shown)]
    return ({"questions": asked} if plan.clips else {}) | {
        "participants": [_participant(plan, one) for one in everybody],
        "steps": [
            _step(plan, step) | {"seconds": took.get((step["participant"], step["k"]))}
            for step in steps
        ],
        "pages": shown,
        "labels": [row for step in steps for row in _labels(plan, step)],
        "eligibility": [row for one in people for row in _eligibility(plan, one)],
        "quiz": [row for one in people for row in _quiz(plan, one)],
        "answers": [
            {"participant": one.id, "question": name, "answer": value}
            for one in people
            for kind in ("screening", "answers")
            for event in one.answers(kind)
            for name, value in event["payload"].items()
        ],
        "events": events_of(people),
    }


def _participant(plan: StudyPlan, one: Participant) -> Row:
    person, state, consent = one.row, one.state, one.first("consent")
    finished = state.stage in ("quiz", "questions", "done")
    cost = _cost(plan, one) if finished else None
    return {
        "participant": one.id,
        "stream": person["stream"],
        "entry": person["entry"],
        "stage": state.stage,
        "type": None if state.user_type is None else plan.roles[state.user_type].name,
        "condition": state.condition,
        "eligibility_attempts": state.attempts,
        "eligible": int(bool(state.belief)),
        "steps_labelled": len(state.labels),
        "messages_given": state.given.bit_count(),
        "inexplicable_transitions": state.labels.count(0) if finished else None,
        "cannot_tell": state.labels.count(CANNOT_TELL) if finished else None,
        "quiz_score": state.score,
        **interaction(one.events if finished else ()),
        "entered": one.events[0]["wall"],
        "last_seen": one.events[-1]["wall"],
        "consent_hash": consent.get("text"),
        "timed_out": sum(event["kind"] == "time_out" for event in one.events),
        "window_width": consent.get("width"),
        "attention_missed": state.missed,
        **({"messages_again": state.again} if not plan.problem.messages_land else {}),
        **({"questions_asked": len(state.asked), "cost": cost} if plan.clips else {}),
    }


def _step(plan: StudyPlan, step: Row) -> Row:
    names = plan.problem.message_names
    same = ("participant", "k", "belief_before", "belief_after", "action_values", "labels")
    return {key: step[key] for key in same} | {
        "transition": plan.trace[step["k"]],
        "given_before": ";".join(names_of(step["given"], names)),
        "messages": ";".join(names_of(step["messages"], names)),
    }


def _labels(plan: StudyPlan, step: Row) -> Iterator[Row]:
    on_page = names_of(step["given"] | step["messages"], plan.problem.message_names)
    for i, label in enumerate(json.loads(step["labels"] or "[]")):
        yield {
            "participant": step["participant"],
            "k": step["k"],
            "i": i,
            "transition": plan.trace[i],
            "messages_shown": ";".join(on_page),
            "label": label,
        }


def _cost(plan: StudyPlan, one: Participant) -> float:
    """λ · messages + inexplicable labels of all steps + κ · questions."""
    problem, asked = plan.problem, len(one.state.asked)
    messages = problem.communication(1 << j for j in one.state.heard)
    wrong: int = sum(event["payload"]["labels"].count(0) for event in one.answers("labels"))
    cost = problem.trade_off * messages + problem.inexplicability_cost * wrong
    return cost + problem.questions.limits.cost * asked


def _questions(plan: StudyPlan, one: Participant, shown: Sequence[Row]) -> Iterator[Row]:
    names, state = plan.problem.message_names, one.state
    took = {page["sequence"]: page["seconds"] for page in shown if page["participant"] == one.id}
    answers = [event["source_sequence"] for event in one.answers("clip")]
    for number, asked in enumerate(state.asked):
        clip = plan.clips[asked.question]
        yield {
            "participant": one.id,
            "number": number,
            "k": asked.step,
            "clip": asked.question,
            "transition": clip.phrase,
            "situation": " ".join(clip.situation),
            "messages_shown": ";".join(names[j] for j in sorted({*state.heard[: asked.told]})),
            "worth": asked.worth,
            "belief_before": json.dumps(asked.before),
            "belief_after": json.dumps(asked.after) if asked.after else None,
            "label": asked.answer,
            "seconds": took.get(answers[number]) if number < len(answers) else None,
        }


def _eligibility(plan: StudyPlan, one: Participant) -> Iterator[Row]:
    for attempt, event in enumerate(one.answers("eligibility"), 1):
        questions = plan.roles[one.state.slot_type].eligibility
        answers = event["payload"]["answers"]
        for fact, question, answer in zip(plan.facts, questions, answers, strict=True):
            yield {
                "participant": one.id,
                "attempt": attempt,
                "fact": fact.name,
                "question": question.text,
                "answer": question.options[answer],
                "correct": int(answer == question.answer),
            }


def _quiz(plan: StudyPlan, one: Participant) -> Iterator[Row]:
    for event in one.answers("quiz"):
        for i, statement in enumerate(plan.roles[one.state.slot_type].quiz):
            ticked = i in event["payload"]["chosen"]
            yield {
                "participant": one.id,
                "fact": statement.fact,
                "statement": statement.text,
                "true": int(statement.true),
                "ticked": int(ticked),
                "correct": int(ticked == statement.true),
            }


# Time: one clock a figure ----------------------------------------------------------------------


def interaction(events: Sequence[Row]) -> Row:
    """How long the evaluation of one participant took: columns of their table.

    ``interaction_time_s`` is by the server's clock, from the first rendering of the first step to
    the last accepted label, by which ``clock`` (:func:`xplain.people.export.seconds`);
    None where it is not known, or cannot be. ``visible_time_s``, the secondary measure, is None
    without the browser's events (no scripts).

    Args:
        events: rows of the event table in order, payloads decoded; none for nothing known.
    """
    took = clock = away = None
    evaluated = [e for e in events if e["kind"] == "shown" and e["payload"]["stage"] in EVALUATING]
    labels = [e for e in events if e["kind"] == "labels" and e["source"] == "protocol"]
    if evaluated and labels:
        (took, clock), away = seconds(evaluated[0], labels[-1]), hidden(events)
    visible = None if took is None or away is None else max(0.0, took - away)
    return {
        "interaction_time_s": took,
        "clock": clock,
        "hidden_s": away,
        "visible_time_s": visible,
    }


def pages(events: Sequence[Row]) -> list[Row]:
    """Every page that was shown, in order, with the time until its answer was accepted.

    Args:
        events: of one participant, as for :func:`interaction`.
    """
    answered = {e["source_sequence"]: e for e in events if e["source"] == "protocol"}
    rows, step = [], 0
    for event in (one for one in events if one["kind"] == "shown"):
        answer, stage = answered.get(event["source_sequence"]), event["payload"]["stage"]
        rows.append(
            {
                "participant": event["participant"],
                "sequence": event["source_sequence"],
                "stage": stage,
                "step": step if stage in EVALUATING else None,
                "shown": event["wall"],
                "seconds": seconds(event, answer)[0] if answer else None,
                "browser_ms": answer["browser"] if answer else None,
            }
        )
        step += stage == "evaluation" and answer is not None and answer["kind"] == "labels"
    return rows


def hidden(events: Sequence[Row]) -> float | None:
    """Seconds of the evaluation in which no page was visible; None where no page reported.

    Pages report when they become visible and when they are hidden (another tab, another window,
    closed), but not when an answer leads on to the next. So the page that became visible last is
    the one looked at, and only its being hidden counts: with two tabs, going from one to the other
    does not.

    Clocks of two devices need not agree: pages are ordered by arrival, a duration on one page is by
    that page's own clock, and one from page to page by the server's. Where the wall clock of a
    visible page jumps ahead of the page's own, the device slept.
    """
    total, began = 0.0, False
    looked_at: str | None = None
    since: Row | None = None
    latest: dict[str, Row] = {}
    for event in (one for one in events if one["source"].startswith("tab:")):
        page, before = event["source"], latest.get(event["source"])
        latest[page] = event
        if before and began and page == looked_at and since is None:
            own, wall = _passed(before, event)
            total += wall - own if wall - own > SLEEP else 0.0
        if event["kind"] == "hidden" and began and page == looked_at and since is None:
            since = event
        if event["kind"] != "visible":
            continue
        if since is not None:
            same = since["source"] == page
            total += max(_passed(since, event)) if same else seconds(since, event)[0] or 0.0
            since = None
        if began and event["payload"]["what"] not in EVALUATING:
            break  # the quiz: the evaluation is over
        began = began or event["payload"]["what"] in EVALUATING
        looked_at = page
    return total if began else None


def _passed(first: Row, last: Row) -> tuple[float, float]:
    """Seconds between two reports of a page: by the page's own clock, and by the device's."""
    own = last["browser"] - first["browser"]
    return own / 1000, (last["payload"]["at"] - first["payload"]["at"]) / 1000


def listeners_in(database: Path, stream: str = "person") -> list[Explained]:
    """What was said to each participant of a stream, and what they answered; as far as they came.

    Args:
        database: of a study that no server has open, or a snapshot.
        stream: "person", "pilot" or "bot"; never mixed.

    Raises:
        InputError: it is no study's database, or there is no such stream.
    """
    one_of("stream", stream, STREAMS)
    with reading(database) as connection:
        plan = plan_of(connection, StudyPlan)
        everybody = participants(connection, StudyState)
    own = [steps_of(one) for one in everybody if one.row["stream"] == stream]
    labelled = [[step for step in steps if step["labels"]] for steps in own]
    if not any(labelled):
        raise InputError("database", str(database), f"one with answers (stream {stream})")
    return [
        Explained(
            plan.problem,
            [step["messages"] for step in steps],
            [np.array(json.loads(step["labels"]), np.uint8) for step in steps],
        )
        for steps in labelled
        if steps
    ]
