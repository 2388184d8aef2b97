"""How long an evaluation took, from a participant's events. One clock a figure.

Primary: the server's wall clock, from the first rendering of the first step to the last accepted
label. Beside it the server's monotonic clock, where both ends lie in one boot of the machine: the
two differ only if somebody set the clock. Secondary: the primary less the time in which no page of
the study was visible, by the browser's clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Interaction:
    """Seconds; None where they are not known."""

    wall: float | None
    monotonic: float | None
    hidden: float | None
    consent_hash: str | None

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
    consent = next((e["payload"].get("text") for e in events if e["kind"] == "consent"), None)
    first = next(
        (e for e in events if e["kind"] == "shown" and e["payload"]["stage"] == "evaluation"), None
    )
    labels = [e for e in events if e["kind"] == "labels" and e["source"] == "protocol"]
    if first is None or not labels:
        return Interaction(None, None, None, consent)
    last = labels[-1]
    monotonic = None
    if first["boot"] == last["boot"]:
        monotonic = last["monotonic"] - first["monotonic"]
    return Interaction(last["wall"] - first["wall"], monotonic, hidden(events), consent)


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
