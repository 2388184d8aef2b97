"""Databases of older versions are read, or refused with a line that says what to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.people.kinds import flow_of
from tests.people.test_replay import answered as answered
from tests.people.test_replay import changed
from tests.people.test_replay import kind as kind
from tests.people.test_replay import snapshot as snapshot
from xplain.cli.main import main
from xplain.errors import XplainError
from xplain.people.store import Store


def test_code_that_decides_otherwise_does_not_go_on_with_what_was_begun(
    kind: str, snapshot: Path
) -> None:
    Store(snapshot, flow_of(kind)).close()
    changed(snapshot, "UPDATE event SET state = json_set(state, '$.part', 7) WHERE kind = 'labels'")
    with pytest.raises(XplainError, match="go on and replay with that version"):
        Store(snapshot, flow_of(kind))
    with pytest.raises(SystemExit):
        main([kind, "replay", str(snapshot)])
