"""Replay: equal to the last bit, and any change is noticed."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from xplain.cli.main import main


def test_replay_agrees_to_the_last_bit_and_notices_any_change(
    snapshot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["study", "replay", str(snapshot)])
    assert "26 participants" in (said := capsys.readouterr().out)
    assert "all equal" in said
    changes = (
        "UPDATE step SET belief_after = replace(belief_after, '1', '2') WHERE k = 2",
        "UPDATE step SET messages = messages + 1 WHERE k = 1",
        "UPDATE event SET payload = replace(payload, '\"labels\": [1', '\"labels\": [0')",
        "DELETE FROM step WHERE k = 3",
        "UPDATE slot SET used = 1 - used WHERE holder IS NOT NULL",
        "DELETE FROM event WHERE kind = 'read'",
        """UPDATE participant SET state = replace(state, '"score": 4', '"score": 3')""",
    )
    content = snapshot.read_bytes()
    for change in changes:
        snapshot.write_bytes(content)
        with sqlite3.connect(snapshot) as connection:
            for trigger in ("event_fixed", "event_kept", "step_fixed"):
                connection.execute(f"DROP TRIGGER {trigger}")
            assert connection.execute(change).rowcount > 0
        connection.close()
        with pytest.raises(SystemExit) as ended:
            main(["study", "replay", str(snapshot)])
        assert ended.value.code == 1, change
    capsys.readouterr()
