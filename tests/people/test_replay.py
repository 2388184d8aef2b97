"""Replay: decisions are equal to the last bit, and different ones are noticed."""

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import get_args

import pytest

from tests.conftest import Run
from tests.people.kinds import KINDS, filled, flow_of
from tests.people.visitors import arrive
from xplain.errors import XplainError
from xplain.experiment.config import compose_config
from xplain.people.export import find_differences
from xplain.people.log import read
from xplain.people.store import Store
from xplain.people.web import TAB_KINDS

LATE = "WHERE kind = 'labels' AND number = (SELECT max(number) FROM event WHERE kind = 'labels')"
EVERYWHERE = {
    "an answer left out": "DELETE FROM event WHERE number = (SELECT min(number) FROM event "
    "WHERE kind = 'labels')",
    "events left out": "DELETE FROM event WHERE kind = 'read'",
    "a label": "UPDATE event SET payload = replace(payload, '\"labels\": [1', '\"labels\": [0')",
    "a state": "UPDATE event SET state = replace(state, '\"part\": 1', '\"part\": 0')",
    "where somebody is": f"UPDATE event SET state = json_set(state, '$.stage', 'done') {LATE}",
    "an answer put in": (
        "INSERT INTO event SELECT participant, 999, source, 999, kind, wall, monotonic, boot, "
        "browser, payload, state, (SELECT max(number) + 1 FROM event) FROM event "
        "WHERE kind = 'labels' LIMIT 1"
    ),
}
OF_A_STUDY = {
    "a belief": f"UPDATE event SET state = json_set(state, '$.belief[0]', 0.25) {LATE}",
    "what was given": f"UPDATE event SET state = json_set(state, '$.given', 77) {LATE}",
    "a decision": f"UPDATE event SET state = json_set(state, '$.new', 77) {LATE}",
    "why": f"UPDATE event SET state = json_set(state, '$.values', json('{{}}')) {LATE}",
    "a score": "UPDATE event SET state = json_set(state, '$.score', 3) WHERE kind = 'quiz'",
}
OF_A_COLLECTION = {
    "a belief": f"UPDATE event SET state = json_set(state, '$.belief.none', 0.25) {LATE}",
    "what a clip is for": "UPDATE event SET state = replace(state, 'question', 'repeat')",
    "what others believe incorrectly": "UPDATE event SET payload = json_set(payload, '$.others', "
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
    """Makes a database in which three people answered; returns also their ids."""
    path = tmp_path_factory.mktemp("answered") / "s.sqlite"
    people = filled(kind, path)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("VACUUM INTO ?", (str(path.with_name("copy")),))
    return path.with_name("copy").read_bytes(), people


@pytest.fixture
def snapshot(answered: tuple[bytes, list[str]], tmp_path: Path) -> Path:
    """Makes a separate copy of the snapshot."""
    path = tmp_path / "s.sqlite"
    path.write_bytes(answered[0])
    path.with_name("s.sqlite.key").write_bytes(b"k" * 32)
    return path


def changed(snapshot: Path, *statements: str) -> None:
    """Changes the database, which nobody may do, without its triggers."""
    with closing(sqlite3.connect(snapshot)) as connection, connection:
        for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'"):
            connection.execute(f"DROP TRIGGER {name}")
        for statement in statements:
            assert connection.execute(statement).rowcount > 0, statement


def differs(kind: str, snapshot: Path) -> list[str]:
    flow = flow_of(kind)
    return find_differences(flow, read(snapshot, flow.PLAN, flow.STATE)[1])


def test_a_replay_agrees_to_the_last_bit(kind: str, snapshot: Path, run: Run) -> None:
    said = run(f"{kind} replay", snapshot)[1]
    assert said.startswith("3 participants ")
    assert "all equal" in said


def test_a_replay_notices_every_change(
    kind: str, answered: tuple[bytes, list[str]], tmp_path: Path
) -> None:
    assert differs(kind, _copy(answered, tmp_path / "as it was")) == []
    for what, statement in CHANGES[kind].items():
        path = _copy(answered, tmp_path / what)
        changed(path, statement)
        assert differs(kind, path), what


def test_code_that_decides_otherwise_does_not_go_on_with_what_was_begun(
    kind: str, snapshot: Path, run: Run
) -> None:
    Store(snapshot, flow_of(kind)).close()
    changed(snapshot, "UPDATE event SET state = json_set(state, '$.part', 7) WHERE kind = 'labels'")
    with pytest.raises(XplainError, match="continue and replay with that version"):
        Store(snapshot, flow_of(kind))
    assert run(f"{kind} replay", snapshot)[0] == 1


def _copy(answered: tuple[bytes, list[str]], path: Path) -> Path:
    path.write_bytes(answered[0])
    return path


def test_of_whoever_was_erased_others_are_replayed(
    kind: str, snapshot: Path, answered: tuple[bytes, list[str]], run: Run
) -> None:
    """People whose questions depended on the erased answers are replayed, too."""
    with closing(Store(snapshot)) as database:
        reference = database.reference(answered[1][0])
    run(f"{kind} erase", snapshot, reference)
    assert run(f"{kind} replay", snapshot)[1] == "2 participants replayed: all equal\n"
    if kind == "collect":
        _, people = read(snapshot, flow_of(kind).PLAN, flow_of(kind).STATE)
        assert any(1 in one.first("consent")["after"] for one in people)


def test_what_a_page_reports_is_told_in_the_consent_and_exported(
    kind: str, tmp_path: Path, run: Run
) -> None:
    path = tmp_path / "s.sqlite"
    with closing(Store(path, flow_of(kind))) as store:
        visitor, page = arrive(store)
        kinds = [*get_args(TAB_KINDS)]
        items = [
            {"n": n, "kind": one, "ms": 1.0, "at": 1.0, "what": f"seen {one}"}
            for n, one in enumerate(kinds)
        ]
        report = {"token": page.hidden["token"], "tab": "a" * 16, "items": items}
        assert visitor.client.post("/events", json=report).status_code == 200
    run(f"{kind} export", path, "out")
    exported = (tmp_path / "out" / "events.csv").read_text()
    assert [one for one in kinds if f"seen {one}" not in exported] == []
    shipped = " ".join(compose_config(kind, []).wording.consent)
    for stored in ("click", "hides it", "look up", "recruiting platform", "reference", "erase"):
        assert stored in shipped, stored
