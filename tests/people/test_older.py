"""Databases that an older version began: read, or refused in a line that says what to do."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from tests.people.kinds import site_of
from tests.people.test_replay import answered as answered
from tests.people.test_replay import changed
from tests.people.test_replay import kind as kind
from tests.people.test_replay import snapshot as snapshot
from xplain.cli.commands import COMMANDS
from xplain.cli.main import main
from xplain.errors import InputError, XplainError
from xplain.people.export import read_plan
from xplain.people.store import Store


def planned(snapshot: Path, **changes: Any) -> None:
    """Lets the stored plan be another one; None takes a key away."""
    with sqlite3.connect(snapshot) as connection:
        ((text,),) = connection.execute("SELECT value FROM meta WHERE key = 'plan'").fetchall()
    connection.close()
    plan = {
        key: value for key, value in {**json.loads(text), **changes}.items() if value is not None
    }
    said = json.dumps(plan, sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    quoted = said.replace("'", "''")
    changed(snapshot, f"UPDATE meta SET value = '{quoted}' WHERE key = 'plan'")


def test_an_earlier_form_is_refused_with_what_to_do(kind: str, snapshot: Path) -> None:
    planned(snapshot, version="2 or before")
    for command in (["replay", str(snapshot)], ["export", str(snapshot), "out"]):
        with pytest.raises(InputError, match=r"exported and replayed with the version that began"):
            COMMANDS[f"{kind} {command[0]}"].main(command[1:], standalone_mode=False)
    with pytest.raises(InputError, match=r"goes on, .* with the version that began it"):
        read_plan(snapshot, site_of(kind).PLAN)


def test_code_that_decides_otherwise_does_not_go_on_with_what_was_begun(
    kind: str, snapshot: Path
) -> None:
    Store(snapshot, site_of(kind)).close()
    changed(snapshot, "UPDATE event SET state = json_set(state, '$.part', 7) WHERE kind = 'labels'")
    with pytest.raises(XplainError, match="go on and replay with that version"):
        Store(snapshot, site_of(kind))
    with pytest.raises(SystemExit):
        main([kind, "replay", str(snapshot)])
