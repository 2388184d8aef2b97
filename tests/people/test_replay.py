"""Replay: equal to the last bit, and any change is noticed; in a study and in a collection."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import get_args

import pytest

from tests.people.kinds import KINDS, filled, site_of
from tests.people.visitors import GENEROUS, Visitor, enter
from xplain.cli.main import main
from xplain.experiment.config import composed
from xplain.people.analysis.stored import opened
from xplain.people.server.app import create_app
from xplain.people.server.database import Database
from xplain.people.server.participant_pages import TAB_KINDS
from xplain.people.server.store import Store
from xplain.people.simulation.browser import Page

LAST = "(SELECT max(number) FROM event WHERE kind = 'labels')"
EVERYWHERE = {
    "a belief": "UPDATE step SET belief_after = replace(belief_after, '0.', '0.1') WHERE k = 2",
    "what was given": "UPDATE step SET given = given + 1 WHERE k = 1",
    "a step left out": "DELETE FROM step WHERE k = 3",
    "an answer left out": "DELETE FROM event WHERE number = (SELECT min(number) FROM event "
    "WHERE kind = 'labels')",
    "events left out": "DELETE FROM event WHERE kind = 'read'",
    "a label": "UPDATE event SET payload = replace(payload, '\"labels\": [1', '\"labels\": [0')",
    "the last label's time": f"UPDATE event SET wall = wall + 60 WHERE number = {LAST}",
    "a page's report": "UPDATE event SET payload = '{}' WHERE kind = 'shown'",
    "a state": "UPDATE participant SET state = replace(state, '\"part\": 1', '\"part\": 0')",
    "who is a person": "UPDATE participant SET stream = 'bot'",
    "the plan": "UPDATE meta SET value = replace(value, 'street', 'road') WHERE key = 'plan'",
    "an event put in": (
        "INSERT INTO event SELECT (SELECT max(number) + 1 FROM event), participant, 999, source, "
        "999, kind, wall, monotonic, boot, browser, payload, content, digest FROM event "
        "WHERE kind = 'shown' LIMIT 1"
    ),
}
EVERYWHERE |= {
    "that somebody was erased": "UPDATE participant SET erased = 1 WHERE number = 2",
    "when somebody came": "UPDATE event SET wall = wall + 1 WHERE kind = 'enter'",
    "whom a platform sent": """UPDATE participant SET kept = '{"PROLIFIC_PID": "x"}'""",
    "a step of nobody": "INSERT INTO step SELECT 'nobody', k, belief_before, given, messages, "
    "action_values, labels, belief_after FROM step WHERE k = 1 LIMIT 1",
}
OF_A_STUDY = {
    "a decision": "UPDATE step SET messages = messages + 1 WHERE k = 1",
    "a slot": "UPDATE slot SET used = 1 - used WHERE holder IS NOT NULL",
    "a score": """UPDATE participant SET state = replace(state, '"score": 4', '"score": 3')""",
    "the quiz's order of answers": (
        "UPDATE event SET payload = replace(payload, '\"chosen\": [', '\"chosen\": [ ') "
        "WHERE kind = 'quiz'"
    ),
}
OF_A_COLLECTION = {
    "what a clip is for": "UPDATE step SET action_values = "
    "replace(action_values, 'question', 'repeat') WHERE k = 0",
    "what others hold wrong": "UPDATE event SET payload = json_set(payload, '$.others', "
    "json('{}')) WHERE kind = 'consent' AND json_extract(payload, '$.after') <> '[]'",
    "a number": "UPDATE event SET payload = json_set(payload, '$.number', 77) "
    "WHERE kind = 'consent'",
}
CHANGES = {"study": EVERYWHERE | OF_A_STUDY, "collect": EVERYWHERE | OF_A_COLLECTION}


@pytest.fixture(scope="module", params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def answered(kind: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[str]]:
    """A database in which three people answered, and their ids."""
    path = tmp_path_factory.mktemp("answered") / "s.sqlite"
    people = filled(kind, path)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("VACUUM INTO ?", (str(path.with_name("copy")),))
    return path.with_name("copy").read_bytes(), people


@pytest.fixture
def snapshot(answered: tuple[bytes, list[str]], tmp_path: Path) -> Path:
    """A copy of one's own."""
    path = tmp_path / "s.sqlite"
    path.write_bytes(answered[0])
    return path


def changed(snapshot: Path, *statements: str) -> None:
    """Does what nobody may, with every trigger out of the way."""
    with closing(sqlite3.connect(snapshot)) as connection, connection:
        for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'"):
            connection.execute(f"DROP TRIGGER {name}")
        for statement in statements:
            assert connection.execute(statement).rowcount > 0, statement


def differences(kind: str, snapshot: Path, head: str = "") -> list[str]:
    with opened(snapshot) as connection:
        return site_of(kind).replay(connection, head).differences


def gone(kind: str, who: str) -> list[str]:
    """Statements after which nothing of a participant is in any table."""
    slots = [f"UPDATE slot SET holder = NULL, used = 0 WHERE holder = '{who}'"]
    return [
        *(slots if kind == "study" else []),
        f"UPDATE invitation SET participant = NULL WHERE participant = '{who}'",
        f"DELETE FROM event WHERE participant = '{who}'",
        f"DELETE FROM step WHERE participant = '{who}'",
        f"DELETE FROM participant WHERE id = '{who}'",
    ]


def test_a_replay_agrees_to_the_last_bit(
    kind: str, snapshot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main([kind, "replay", str(snapshot)])
    said = capsys.readouterr().out
    assert said.startswith("3 participants, ")
    assert "all equal" in said
    head = said.split()[-1]
    assert len(head) == 64
    main([kind, "replay", str(snapshot), "--head", head])
    with pytest.raises(SystemExit) as ended:
        main([kind, "replay", str(snapshot), "--head", "0" * 64])
    assert ended.value.code == 1


def test_a_replay_notices_every_change(
    kind: str, answered: tuple[bytes, list[str]], tmp_path: Path
) -> None:
    assert differences(kind, _copy(answered, tmp_path / "as it was")) == []
    for what, statement in CHANGES[kind].items():
        path = _copy(answered, tmp_path / what)
        changed(path, statement)
        assert differences(kind, path), what


def _copy(answered: tuple[bytes, list[str]], path: Path) -> Path:
    path.write_bytes(answered[0])
    return path


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_participant_who_is_gone_from_every_table_is_missed(
    kind: str, snapshot: Path, answered: tuple[bytes, list[str]], place: int
) -> None:
    changed(snapshot, *gone(kind, answered[1][place]))
    assert differences(kind, snapshot)


def test_whoever_was_erased_cannot_be_brought_back(
    kind: str, snapshot: Path, answered: tuple[bytes, list[str]]
) -> None:
    who = answered[1][0]
    with closing(Database(snapshot)) as database:
        database.erase(database.reference(who))
    assert differences(kind, snapshot) == []
    changed(snapshot, f"UPDATE participant SET erased = 0 WHERE id = '{who}'")
    assert differences(kind, snapshot)


def test_of_whoever_was_erased_others_are_replayed(
    kind: str, snapshot: Path, answered: tuple[bytes, list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    """Also of those whose questions followed from the answers that are gone."""
    with closing(Database(snapshot)) as database:
        reference = database.reference(answered[1][0])
    main([kind, "erase", str(snapshot), reference])
    capsys.readouterr()
    main([kind, "replay", str(snapshot)])
    said = capsys.readouterr().out
    assert said.startswith("2 participants, ")
    assert "1 erased: all equal" in said
    if kind == "collect":
        with opened(snapshot) as connection:
            others = "SELECT json_extract(payload, '$.after') FROM event WHERE kind = 'consent'"
            assert any("1" in (row[0] or "") for row in connection.execute(others))


def test_an_export_has_nothing_that_the_log_does_not_cover(
    kind: str, snapshot: Path, tmp_path: Path
) -> None:
    """Every column of the participant table is changed; whatever a table says then, a replay of it
    notices."""
    table = "participants" if kind == "study" else "observers"
    with opened(snapshot) as connection:
        columns = [row["name"] for row in connection.execute("PRAGMA table_info(participant)")]
    main([kind, "export", str(snapshot), str(tmp_path / "before")])
    kept = (tmp_path / "before" / f"{table}.csv").read_text()
    whole = snapshot.read_bytes()
    for column in columns:
        snapshot.write_bytes(whole)
        other = "2 - 1" if column in ("over", "erased") else f"'{{}}' || {column} || ' '"
        try:
            changed(snapshot, f"UPDATE participant SET {column} = {other} WHERE number = 2")
            main([kind, "export", str(snapshot), str(tmp_path / "after")])
        except (sqlite3.Error, SystemExit, ValueError, LookupError):
            continue  # the database or the export refuses it
        if (tmp_path / "after" / f"{table}.csv").read_text() != kept:
            assert differences(kind, snapshot), column


def test_what_a_page_reports_is_told_in_the_consent_and_exported(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "s.sqlite"
    with closing(Store(path, site_of(kind))) as store:
        client = create_app(store, GENEROUS).test_client()
        (token,) = store.invite(1, "person")
        page = Page.of_html(enter(Visitor(client), token))
        kinds = [*get_args(TAB_KINDS)]
        items = [
            {"n": n, "kind": one, "ms": 1.0, "at": 1.0, "what": f"seen {one}"}
            for n, one in enumerate(kinds)
        ]
        report = {"token": page.hidden["token"], "tab": "a" * 16, "items": items}
        assert client.post("/events", json=report).status_code == 200
    main([kind, "export", str(path), str(tmp_path / "out")])
    exported = (tmp_path / "out" / "events.csv").read_text()
    assert [one for one in kinds if f"seen {one}" not in exported] == []
    shipped = " ".join(composed(kind, []).wording.consent)
    for stored in ("click", "hidden", "look up", "recruiting platform", "reference", "erase"):
        assert stored in shipped, stored


def test_a_note_at_the_end_says_which_sentences_were_not_true(kind: str) -> None:
    """Of those that the participant was told, at every end that nothing follows."""
    flow, facts = site_of(kind).flow, site_of(kind).plan.facts
    for stage in ("done", "withdrawn", "timed_out"):
        state = flow.STATE(stage=stage, **({"user_type": 1} if kind == "study" else {}))
        told = flow.view(state).get("untrue")
        if kind == "collect" or stage == "timed_out":
            assert told is None
        else:
            wrong = flow.plan.roles[1].wrong
            assert told == [(facts[j].belief, facts[j].message) for j in wrong]


def test_an_end_that_was_cut_off_is_noticed_by_who_kept_the_head(
    kind: str, snapshot: Path, answered: tuple[bytes, list[str]]
) -> None:
    """Somebody who cuts off the last participant and sets the head back leaves a log that is right
    in itself; the head that an export printed is not in it."""
    with opened(snapshot) as connection:
        (head,) = connection.execute("SELECT value FROM meta WHERE key = 'head'").fetchone()
    end = "SELECT digest FROM event ORDER BY number DESC LIMIT 1"
    close = f"UPDATE meta SET value = ({end}) WHERE key = 'head'"
    changed(snapshot, *gone(kind, answered[1][-1]), close)
    assert differences(kind, snapshot) == []
    assert differences(kind, snapshot, head)
