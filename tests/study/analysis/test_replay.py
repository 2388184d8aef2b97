"""Replay: equal to the last bit, and any change is noticed."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from xplain.cli.main import main

TRIGGERS = (
    *("event_fixed", "event_kept", "step_fixed", "step_kept", "slot_fixed", "slot_kept"),
    *("participant_kept", "once_a_bot", "meta_fixed", "meta_kept", "invitation_fixed"),
)
SOMEBODY = "(SELECT participant FROM event WHERE kind = 'quiz' LIMIT 1)"
LAST = f"(SELECT max(number) FROM event WHERE kind = 'labels' AND participant = {SOMEBODY})"
CHANGES = {
    "a belief": "UPDATE step SET belief_after = replace(belief_after, '1', '2') WHERE k = 2",
    "a decision": "UPDATE step SET messages = messages + 1 WHERE k = 1",
    "a label": "UPDATE event SET payload = replace(payload, '\"labels\": [1', '\"labels\": [0')",
    "a step left out": "DELETE FROM step WHERE k = 3",
    "a slot": "UPDATE slot SET used = 1 - used WHERE holder IS NOT NULL",
    "events left out": "DELETE FROM event WHERE kind = 'read'",
    "a score": """UPDATE participant SET state = replace(state, '"score": 4', '"score": 3')""",
    "the last label's time": f"UPDATE event SET wall = wall + 60 WHERE number = {LAST}",
    "a page's report": "UPDATE event SET payload = '{}' WHERE kind = 'shown'",
    "the quiz's order of answers": (
        "UPDATE event SET payload = replace(payload, '\"chosen\": [', '\"chosen\": [ ') "
        "WHERE kind = 'quiz'"
    ),
    "who is a bot": "UPDATE participant SET stream = 'person' WHERE stream = 'bot'",
    "the plan": "UPDATE meta SET value = replace(value, 'A street', 'A road') WHERE key = 'plan'",
    "an event put in": (
        "INSERT INTO event SELECT (SELECT max(number) + 1 FROM event), participant, 999, source, "
        "999, kind, wall, monotonic, boot, browser, payload, content, digest FROM event "
        "WHERE kind = 'shown' LIMIT 1"
    ),
}


def changed(snapshot: Path, *statements: str) -> None:
    """Does what nobody may, with every trigger out of the way."""
    with sqlite3.connect(snapshot) as connection:
        for trigger in TRIGGERS:
            connection.execute(f"DROP TRIGGER {trigger}")
        for statement in statements:
            assert connection.execute(statement).rowcount > 0, statement
    connection.close()


def refused(snapshot: Path, *arguments: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["study", "replay", str(snapshot), *arguments])
    assert ended.value.code == 1


def test_replay_agrees_to_the_last_bit(snapshot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["study", "replay", str(snapshot)])
    said = capsys.readouterr().out
    assert "26 participants" in said
    assert "all equal" in said
    head = said.split()[-1]
    assert len(head) == 64
    main(["study", "replay", str(snapshot), "--head", head])


@pytest.mark.parametrize("what", CHANGES)
def test_replay_notices_a_change(snapshot: Path, what: str) -> None:
    changed(snapshot, CHANGES[what])
    refused(snapshot)


def test_replay_notices_that_a_participant_is_gone(snapshot: Path) -> None:
    """Everything of them, from every table."""
    with sqlite3.connect(snapshot) as connection:
        (who,) = connection.execute(f"SELECT {SOMEBODY}").fetchone()
    connection.close()
    changed(
        snapshot,
        f"UPDATE invitation SET participant = NULL WHERE participant = '{who}'",
        f"DELETE FROM event WHERE participant = '{who}'",
        f"DELETE FROM step WHERE participant = '{who}'",
        f"UPDATE slot SET holder = NULL, used = 0 WHERE holder = '{who}'",
        f"DELETE FROM participant WHERE id = '{who}'",
    )
    refused(snapshot)


def test_an_end_that_was_cut_off_is_noticed_by_who_kept_the_head(
    snapshot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Somebody who cuts off the last events and sets the head back leaves a log that is right in
    itself; the head that an export printed is not in it."""
    main(["study", "replay", str(snapshot)])
    head = capsys.readouterr().out.split()[-1]
    last = "(SELECT max(number) FROM event)"
    changed(
        snapshot,
        f"DELETE FROM participant WHERE id = (SELECT participant FROM event WHERE number = {last})",
        f"UPDATE invitation SET participant = NULL WHERE participant = "
        f"(SELECT participant FROM event WHERE number = {last})",
        f"DELETE FROM event WHERE number = {last}",
        f"UPDATE meta SET value = (SELECT digest FROM event WHERE number = {last}) "
        "WHERE key = 'head'",
    )
    main(["study", "replay", str(snapshot)])
    refused(snapshot, "--head", head)
