"""What the columns mean that every export has, and what kind of values columns hold."""

from __future__ import annotations

from collections.abc import Mapping

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
