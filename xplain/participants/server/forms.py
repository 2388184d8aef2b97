"""From what a browser sent to an event's payload. Nothing that was sent is trusted."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from xplain.errors import Refused

TAB_KINDS = ("visible", "hidden", "label", "recall", "retry")
MAX_ITEMS = 50
_TAB = re.compile(r"[a-z0-9]{8,32}\Z")


def small(text: object) -> int | None:
    """A whole number 0 … 999 in plain digits, else None."""
    if isinstance(text, str) and 0 < len(text) <= 3 and text.isascii() and text.isdigit():
        return int(text)
    return None


def sequence_of(form: Mapping[str, str]) -> int:
    """The page's sequence number.

    Raises:
        Refused: it is none.
    """
    text = form.get("sequence", "")
    if not (0 < len(text) <= 6 and text.isascii() and text.isdigit()):
        raise Refused("not_complete")
    return int(text)


def milliseconds(value: object) -> float | None:
    """The page's clock reading: a number of a credible size, else None."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return None
    return number if 0 <= number < 1e10 else None


def tab_items(value: object) -> tuple[str, list[tuple[int, str, float, dict[str, Any]]]]:
    """A page's own events: ``{"tab": …, "items": [{"n", "kind", "ms", "at", "what"}]}``.

    Raises:
        Refused: anything else.
    """
    if not isinstance(value, dict) or not isinstance(value.get("tab"), str):
        raise Refused("not_understood")
    tab, items = value["tab"], value.get("items")
    if not _TAB.match(tab) or not isinstance(items, list) or len(items) > MAX_ITEMS:
        raise Refused("not_understood")
    found = []
    for item in items:
        if not isinstance(item, dict):
            raise Refused("not_understood")
        number, kind, what = item.get("n"), item.get("kind"), item.get("what", "")
        ms, at = _clock(item.get("ms")), _clock(item.get("at"))
        if type(number) is not int or not 0 <= number < 100_000:
            raise Refused("not_understood")
        if kind not in TAB_KINDS or ms is None or at is None:
            raise Refused("not_understood")
        if not isinstance(what, str) or len(what) > 40:
            raise Refused("not_understood")
        found.append((number, kind, ms, {"at": at, "what": what}))
    return tab, found


def _clock(value: object) -> float | None:
    """Milliseconds as a JSON number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if 0 <= value < 1e14 else None
