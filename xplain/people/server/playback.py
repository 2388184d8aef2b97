"""Somebody's session page by page, as the log has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import lxml.html

from xplain.people.analysis.export import Row, seconds
from xplain.people.analysis.replay import outcomes
from xplain.people.flow import Fields, Flow, State


@dataclass(frozen=True)
class Seen:
    """A page that somebody saw, and what they did on it.

    Attributes:
        state: that it shows.
        fields: what was filled in when it was answered; none before that.
        answer: kind of the event that it was answered by; "" where it was not.
        since: seconds from their coming to its first rendering; None where it cannot be told.
        took: … and from there to the answer.
        done: (seconds since the page began to load, what) of the page's own events.
    """

    state: State
    fields: Fields
    answer: str
    since: float | None
    took: float | None
    done: tuple[tuple[float, str], ...]


def played(flow: Flow[Any, Any], events: Sequence[Row]) -> list[Seen]:
    """The pages of a session, the one that they are on last.

    Args:
        flow: at work.
        events: of one participant in order, payloads decoded.

    Raises:
        Refused: an answer does not follow from those before.
    """
    answers = [event for event in events if event["source"] == "protocol"]
    states = [flow.STATE(), *(outcome.state for outcome in outcomes(flow, answers))]
    shown = {e["source_sequence"]: e for e in events if e["source"] == "shown"}
    done = _of_pages(events)
    found = []
    for number, (state, answer) in enumerate(zip(states, [*answers, None], strict=True)):
        first, here = shown.get(state.accepted), flow.stage(state.stage)
        fields: Fields = []
        if answer and here and answer["kind"] == here.kind:
            fields = here.fields(answer["payload"])
        found.append(
            Seen(
                state,
                fields,
                answer["kind"] if answer else "",
                seconds(events[0], first)[0] if first else None,
                seconds(first, answer)[0] if first and answer else None,
                tuple(done.get(number, ())),
            )
        )
    return found


def _of_pages(events: Sequence[Row]) -> dict[int, list[tuple[float, str]]]:
    """The pages' own events by the number of answers before them. Those of one rendering share a
    source, whose first event arrives at once; later ones may come after the answer."""
    page, of, found = 0, dict[str, int](), dict[int, list[tuple[float, str]]]()
    for event in events:
        page += event["source"] == "protocol"
        if event["source"].startswith("tab:"):
            number = of.setdefault(event["source"], page)
            said = f"{event['kind']} {event['payload']['what']}".strip()
            found.setdefault(number, []).append((event["browser"] / 1000, said))
    return found


def filled_in(html: str, fields: Fields) -> str:
    """A page with what somebody filled in, on which nothing else can be."""
    tree = lxml.html.document_fromstring(html)
    for box in tree.xpath("//main//input | //main//textarea | //main//button | //footer//button"):
        box.set("disabled", "")
        name, kind = box.get("name"), box.get("type")
        if kind in ("radio", "checkbox") and name in dict(fields):
            box.attrib.pop("checked", None)
            if (name, box.get("value")) in fields:
                box.set("checked", "")
        elif box.tag == "textarea":
            box.text = dict(fields).get(name, "")
        elif kind != "hidden" and name in dict(fields):
            box.set("value", dict(fields)[name])
    return f"<!doctype html>\n{lxml.html.tostring(tree, encoding='unicode')}"
