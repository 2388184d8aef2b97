"""How long an evaluation took, from a participant's events. One clock a figure.

Primary: the server's wall clock, from the first rendering of the first step to the last accepted
label. Beside it the server's monotonic clock, where both ends lie in one boot of the machine: the
two differ only if somebody set the clock. Secondary: the primary less the time in which no page of
the study was visible, by the browser's clock.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Interaction:
    """Seconds; None where they are not known. Beside them what else the events alone tell.

    Attributes:
        consent_hash: of the text that was agreed to, or declined.
        timed_out: how often they were silent for too long.
        width: of the window at the consent, in CSS pixels; None without scripts.
        answers: to the questions after the quiz, by name.
    """

    wall: float | None
    monotonic: float | None
    hidden: float | None
    consent_hash: str | None
    timed_out: int = 0
    width: int | None = None
    answers: Mapping[str, str] = field(default_factory=dict)

    @property
    def visible(self) -> float | None:
        """The secondary measure; None without the browser's events (no scripts)."""
        if self.wall is None or self.hidden is None:
            return None
        return max(0.0, self.wall - self.hidden)


def interaction(events: Sequence[dict[str, Any]]) -> Interaction:
    """Of one participant.

    Args:
        events: rows of the event table in order, payloads decoded.
    """
    first_of = {e["kind"]: e["payload"] for e in reversed(events) if e["source"] == "protocol"}
    agreed = first_of.get("consent", {})
    about: dict[str, Any] = {
        "consent_hash": agreed.get("text"),
        "timed_out": sum(e["kind"] == "time_out" for e in events),
        "width": agreed.get("width"),
        "answers": first_of.get("answers", {}),
    }
    first = next(
        (e for e in events if e["kind"] == "shown" and e["payload"]["stage"] == "evaluation"), None
    )
    labels = [e for e in events if e["kind"] == "labels" and e["source"] == "protocol"]
    if first is None or not labels:
        return Interaction(None, None, None, **about)
    last = labels[-1]
    monotonic = None
    if first["boot"] == last["boot"]:
        monotonic = last["monotonic"] - first["monotonic"]
    return Interaction(last["wall"] - first["wall"], monotonic, hidden(events), **about)


def pages(events: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Every page that was shown, in order, with the time until its answer was accepted.

    Args:
        events: of one participant, as for :func:`interaction`.
    """
    answered = {e["source_sequence"]: e for e in events if e["source"] == "protocol"}
    rows, step = [], 0
    for event in events:
        if event["kind"] != "shown":
            continue
        answer, stage = answered.get(event["source_sequence"]), event["payload"]["stage"]
        rows.append(
            {
                "participant": event["participant"],
                "sequence": event["source_sequence"],
                "stage": stage,
                "step": step if stage == "evaluation" else None,
                "shown": event["wall"],
                "seconds": answer["wall"] - event["wall"] if answer else None,
                "browser_ms": answer["browser"] if answer else None,
            }
        )
        step += stage == "evaluation" and answer is not None and answer["kind"] == "labels"
    return rows


def hidden(events: Sequence[dict[str, Any]]) -> float | None:
    """Seconds of the evaluation in which no page was visible, by the browser's clock.

    Pages report when they become visible and when they are hidden (another tab, another window,
    closed), but not when an answer leads on to the next. So the page that became visible last is
    the one looked at, and only its being hidden counts: with two tabs, going from one to the other
    does not.
    """
    reports = sorted(
        (e["payload"]["at"], e["source"], e["kind"], e["payload"]["what"])
        for e in events
        if e["source"].startswith("tab:") and e["kind"] in ("visible", "hidden")
    )
    total, began = 0.0, False
    looked_at = since = None
    for at, page, kind, what in reports:
        if kind == "hidden":
            if began and page == looked_at and since is None:
                since = at
            continue
        if since is not None:
            total, since = total + (at - since), None
        if began and what != "evaluation":
            break  # the quiz: the evaluation is over
        began = began or what == "evaluation"
        looked_at = page
    return total / 1000 if began else None
