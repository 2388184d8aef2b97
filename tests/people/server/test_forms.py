"""Forms that are almost right, and forms that are completely wrong."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.people.client import Client
from tests.people.visitors import Visitor, enter, field, query
from xplain.people.store import Store


def test_forged_answers_are_turned_away_and_leave_no_trace(
    store: Store, client: Client, browser: Callable[[], Visitor]
) -> None:
    visitor = browser()
    html = enter(visitor, store.invite(1, "person")[0])
    token, text = field(html, "token"), field(html, "text")
    good = {"token": token, "sequence": "0", "kind": "consent", "agree": "1", "text": text}
    before = query(store, "SELECT * FROM event")
    forged: list[dict[str, str]] = [
        good | {"token": ""},
        good | {"token": "0" * 64},
        good | {"sequence": "1"},
        good | {"sequence": "-1"},
        good | {"sequence": "٣"},
        good | {"sequence": "9" * 4000},
        good | {"kind": "labels"},
        good | {"kind": "time_out"},
        good | {"kind": "<script>"},
        good | {"agree": "2"},
        good | {"agree": "true"},
        good | {"text": "0" * 64},
        {k: v for k, v in good.items() if k != "sequence"},
        # Values that only the server decides are ignored.
        good | {"agree": "", "user_type": "1", "condition": "conformant", "orders": "{}"},
    ]
    for fields in forged:
        status, _ = visitor.post("/study", list(fields.items()))
        assert 400 <= status < 500, fields
    assert client.post("/study", data=good).status_code == 403  # no cookie
    assert before == query(store, "SELECT * FROM event")


@pytest.mark.parametrize(
    "change",
    [
        {"tab": "short"},
        {"tab": 5},
        {"items": {}},
        {"items": [5]},
        {"items": [{"n": 0}] * 51},
        {"items": [{"n": -1, "kind": "visible", "ms": 1, "at": 1}]},
        {"items": [{"n": True, "kind": "visible", "ms": 1, "at": 1}]},
        {"items": [{"n": 0, "kind": "labels", "ms": 1, "at": 1}]},
        {"items": [{"n": 0, "kind": "visible", "ms": float("nan"), "at": 1}]},
        {"items": [{"n": 0, "kind": "visible", "ms": 1e300, "at": 1}]},
        {"items": [{"n": 0, "kind": "visible", "ms": 1, "at": "1"}]},
        {"items": [{"n": 0, "kind": "visible", "ms": 1, "at": 1, "what": "x" * 41}]},
        {"token": None},
        {"token": "0" * 64},
    ],
)
def test_reports_of_pages_are_checked(
    store: Store, browser: Callable[[], Visitor], change: dict[str, Any]
) -> None:
    visitor = browser()
    token = field(enter(visitor, store.invite(1, "person")[0]), "token")
    item = {"n": 0, "kind": "visible", "ms": 1.5, "at": 1e12, "what": "consent"}
    good = {"token": token, "tab": "0123456789abcdef", "items": [item]}
    assert visitor.client.post("/events", json=good).status_code == 200
    assert 400 <= visitor.client.post("/events", json=good | change).status_code < 500
    assert query(store, "SELECT count(*) AS n FROM event WHERE kind = 'visible'") == [{"n": 1}]
