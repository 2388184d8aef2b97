"""The tables of a study (``study export``)."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from xplain.explanation.belief import NO_FIT
from xplain.explanation.message_sets import names_of
from xplain.people.export import Row, measure_seconds, write
from xplain.people.flow import CANNOT_TELL, Event, Participant, People
from xplain.people.log import read
from xplain.people.study.evaluation import EVALUATING
from xplain.people.study.flow import Study, StudyState
from xplain.people.study.plan import StudyPlan

Person = Participant[StudyState]
SLEEP = 2.0
"""Minimum seconds by which a device's clock is ahead of a page's own clock after a sleep."""


def export(database: Path, folder: Path) -> str:
    """Writes all tables of a database into a folder; while a server runs, of a snapshot. Returns
    the SHA-256 of the events.

    Raises:
        InputError: the file is not a study's database.
    """
    plan, people = read(database, StudyPlan, StudyState)
    return write(folder, Study.PACKAGE, plan, people, tables)


def glance(study: Study, people: People) -> dict[str, Any]:
    """Returns the numbers on the researcher's page: the completed, taken and free places of each
    type and condition; of the people who completed the study, how many have a fit, and how many fit
    none of the found types."""
    held, plan, rows = study.holders(people), study.plan, []
    for own in sorted({"person", *(name for name, _ in held)}):
        for user_type, condition in plan.cells:
            inside = [
                one.stage == "done"
                for (name, _), one in held.items()
                if (name, one.user_type, one.condition) == (own, user_type, condition)
            ]
            free = plan.rules.per_cell - len(inside) if own == "person" else None
            rows.append(
                {"stream": own, "user_type": user_type, "condition": condition}
                | {"completed": sum(inside), "held": inside.count(False), "free": free}
            )
    done = [one.state for one in people if one.stream == "person" and one.state.stage == "done"]
    fits = [fit for state in done if (fit := fit_of(plan, state)) is not None]
    unfit = sum(fit < NO_FIT for fit in fits)
    return {"slots": rows, "roles": plan.roles, "fits": len(fits), "unfit": unfit}


def fit_of(plan: StudyPlan, state: StudyState) -> float | None:
    """Computes P(the participant has one of the found types and the assumed habits). Returns
    None before the evaluation, or if the belief allows only found types."""
    if not state.belief or plan.problem.as_found.all():
        return None
    return plan.problem.fit(np.array(state.belief))


@dataclass(frozen=True)
class Step:
    """A step of a participant's evaluation.

    Attributes:
        page: the participant's state when the step's page was shown.
        labels: labels of the transitions up to this step; empty before the answer.
        after: [M] belief over M user types after the labels; empty before the answer.
    """

    page: StudyState
    labels: tuple[int, ...] = ()
    after: tuple[float, ...] = ()


def steps_of(one: Person) -> list[Step]:
    """Lists the steps of a participant's evaluation so far."""
    states = [(e, StudyState.from_text(str(e.state))) for e in one.events if e.state]
    shown = {state.step: state for _, state in states if state.stage == "evaluation"}
    answers: list[Any] = [
        (tuple(e.payload["labels"]), s.after) for e, s in states if e.kind == "labels"
    ]
    # The last step may have no answer yet.
    return [Step(page, *one) for page, one in zip(shown.values(), [*answers, ()], strict=False)]


def tables(plan: StudyPlan, people: list[Person]) -> Mapping[str, Iterable[Row]]:
    """Makes the rows of every table, by name. Answers of participants who withdrew are left out."""
    stayed = [one for one in people if one.state.stage != "withdrawn"]
    shown = {one.id: pages(one.events) for one in stayed}
    steps = [
        (one, step) for one in sorted(stayed, key=lambda one: one.id) for step in steps_of(one)
    ]
    asked = [row for one in stayed for row in _list_questions(plan, one, shown[one.id])]
    return ({"questions": asked} if plan.clips else {}) | {
        "participants": [_describe_participant(plan, one) for one in people],
        "steps": [_describe_step(plan, one, step, shown[one.id]) for one, step in steps],
        "pages": [page for own in shown.values() for page in own],
        "labels": [row for one, step in steps for row in _list_labels(plan, one, step)],
        "eligibility": [row for one in stayed for row in _list_eligibility(plan, one)],
        "quiz": [row for one in stayed for row in _list_quiz(plan, one)],
        "answers": [
            {"participant": one.id, "question": name, "answer": value}
            for one in stayed
            for kind in ("screening", "answers")
            for event in one.answers(kind)
            for name, value in event.payload.items()
        ],
    }


def _describe_participant(plan: StudyPlan, one: Person) -> Row:
    state, consent = one.state, one.first("consent")
    finished = state.stage in ("quiz", "questions", "done")
    cost = _compute_cost(plan, one) if finished else None
    return {
        "participant": one.id,
        "stream": one.stream,
        "entry": one.about["entry"],
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
        "entered": one.events[0].wall,
        "last_seen": one.events[-1].wall,
        "consent_hash": consent.get("text"),
        "timed_out": sum(event.kind == "time_out" for event in one.events),
        "window_width": consent.get("width"),
        "attention_missed": state.missed,
        **({"messages_again": state.again} if not plan.problem.messages_land else {}),
        **({} if plan.problem.as_found.all() else {"fit": fit_of(plan, state)}),
        **({"questions_asked": len(state.asked), "cost": cost} if plan.clips else {}),
    }


def _describe_step(plan: StudyPlan, one: Person, step: Step, shown: Sequence[Row]) -> Row:
    names, page = plan.problem.message_names, step.page
    here = ("evaluation", page.step)
    took = [row["seconds"] for row in shown if (row["stage"], row["step"]) == here]
    return {
        "participant": one.id,
        "k": page.step,
        "transition": plan.trace[page.step],
        "given_before": ";".join(names_of(page.previous or 0, names)),
        "messages": ";".join(names_of(page.new, names)),
        "belief_before": json.dumps(page.before),
        "belief_after": json.dumps(step.after) if step.labels else None,
        "action_values": json.dumps(dict(page.values)),
        "labels": json.dumps(step.labels) if step.labels else None,
        "seconds": took[-1] if took else None,
    }


def _list_labels(plan: StudyPlan, one: Person, step: Step) -> Iterator[Row]:
    told = (step.page.previous or 0) | step.page.new
    on_page = ";".join(names_of(told, plan.problem.message_names))
    for i, label in enumerate(step.labels):
        yield {
            "participant": one.id,
            "k": step.page.step,
            "i": i,
            "transition": plan.trace[i],
            "messages_shown": on_page,
            "label": label,
        }


def _compute_cost(plan: StudyPlan, one: Person) -> float:
    """Computes λ · messages + inexplicable labels of all steps + κ · questions."""
    problem, asked = plan.problem, len(one.state.asked)
    messages = problem.communication(1 << j for j in one.state.heard)
    wrong: int = sum(event.payload["labels"].count(0) for event in one.answers("labels"))
    cost = problem.trade_off * messages + problem.inexplicability_cost * wrong
    return cost + problem.questions.limits.cost * asked


def _list_questions(plan: StudyPlan, one: Person, shown: Sequence[Row]) -> Iterator[Row]:
    names, state = plan.problem.message_names, one.state
    took = {page["sequence"]: page["seconds"] for page in shown}
    answers = [event.source_sequence for event in one.answers("clip")]
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


def _list_eligibility(plan: StudyPlan, one: Person) -> Iterator[Row]:
    for attempt, event in enumerate(one.answers("eligibility"), 1):
        questions = plan.roles[one.state.slot_type].eligibility
        answers = event.payload["answers"]
        for fact, question, answer in zip(plan.facts, questions, answers, strict=True):
            yield {
                "participant": one.id,
                "attempt": attempt,
                "fact": fact.name,
                "question": question.text,
                "answer": question.options[answer],
                "correct": int(answer == question.answer),
            }


def _list_quiz(plan: StudyPlan, one: Person) -> Iterator[Row]:
    for event in one.answers("quiz"):
        for i, statement in enumerate(plan.roles[one.state.slot_type].quiz):
            ticked = i in event.payload["chosen"]
            yield {
                "participant": one.id,
                "fact": statement.fact,
                "statement": statement.text,
                "true": int(statement.true),
                "ticked": int(ticked),
                "correct": int(ticked == statement.true),
            }


# Time: each figure has one clock ----------------------------------------------------------------


def interaction(events: Sequence[Event]) -> Row:
    """Measures the duration of one participant's evaluation.

    Args:
        events: the participant's events, in order; may be empty.

    Returns:
        Columns of the participants' table. Each is None if it is unknown.
        * ``interaction_time_s``: seconds from the first rendering of the first step to the last
          accepted label, measured by the server.
        * ``clock``: the server's clock that measured this time
          (:func:`xplain.people.export.measure_seconds`).
        * ``hidden_s``: seconds in which no page was visible; unknown if the browser runs no
          scripts.
        * ``visible_time_s``: the difference of these times, a secondary measure.
    """
    took = clock = away = None
    evaluated = [e for e in events if e.kind == "shown" and e.payload["stage"] in EVALUATING]
    labels = [e for e in events if e.kind == "labels" and e.source == "protocol"]
    if evaluated and labels:
        (took, clock), away = measure_seconds(evaluated[0], labels[-1]), measure_hidden(events)
    visible = None if took is None or away is None else max(0.0, took - away)
    return {
        "interaction_time_s": took,
        "clock": clock,
        "hidden_s": away,
        "visible_time_s": visible,
    }


def pages(events: Sequence[Event]) -> list[Row]:
    """Lists every page that one participant saw, in order, with the time until its answer was
    accepted."""
    answered = {e.source_sequence: e for e in events if e.source == "protocol"}
    rows, step = [], 0
    for event in (one for one in events if one.kind == "shown"):
        answer, stage = answered.get(event.source_sequence), event.payload["stage"]
        rows.append(
            {
                "participant": event.participant,
                "sequence": event.source_sequence,
                "stage": stage,
                "step": step if stage in EVALUATING else None,
                "shown": event.wall,
                "seconds": measure_seconds(event, answer)[0] if answer else None,
                "browser_ms": answer.browser if answer else None,
            }
        )
        step += stage == "evaluation" and answer is not None and answer.kind == "labels"
    return rows


def measure_hidden(events: Sequence[Event]) -> float | None:
    """Measures the seconds of the evaluation in which no page was visible; None if no page
    reported.

    Pages report when they become visible and when they are hidden (by another tab or window, or
    closed), but not when an answer opens the next page. So the page that became visible last is the
    current page, and only its hidden time counts. Switching between two tabs of the study does not
    count as hidden time.

    Clocks of two devices may differ. So pages are ordered by arrival. A duration on one page uses
    that page's clock, a duration between pages uses the server's clock. If the wall clock of a
    visible page advances more than the page's own clock, the device slept.
    """
    total, began, looked_at = 0.0, False, ""
    since: Event | None = None
    latest: dict[str, Event] = {}
    for event in (one for one in events if one.source.startswith("tab:")):
        page, before = event.source, latest.get(event.source)
        latest[page] = event
        visible = began and page == looked_at and since is None
        if visible and before:
            own, wall = _measure_passed(before, event)
            total += wall - own if wall - own > SLEEP else 0.0
        if visible and event.kind == "hidden":
            since = event
        if event.kind != "visible":
            continue
        if since is not None:
            same = since.source == page
            total += (
                max(_measure_passed(since, event))
                if same
                else measure_seconds(since, event)[0] or 0.0
            )
            since = None
        if began and event.payload["what"] not in EVALUATING:
            break  # the quiz: the evaluation is over
        began = began or event.payload["what"] in EVALUATING
        looked_at = page
    return total if began else None


def _measure_passed(first: Event, last: Event) -> tuple[float, float]:
    """Returns the seconds between two reports of one page, first by the page's own clock, then
    by the device's wall clock."""
    own = (last.browser or 0.0) - (first.browser or 0.0)
    return own / 1000, (last.payload["at"] - first.payload["at"]) / 1000
