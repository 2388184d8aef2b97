"""Databases that an older version began: read, or refused in a line that says what to do."""

from __future__ import annotations

import json
import sqlite3
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.people.kinds import bot_of, site_of
from tests.people.study.stand_in import street_study
from tests.people.test_replay import answered as answered
from tests.people.test_replay import changed
from tests.people.test_replay import kind as kind
from tests.people.test_replay import snapshot as snapshot
from tests.people.visitors import GENEROUS, Visitor
from xplain.cli import people
from xplain.cli.main import main
from xplain.errors import InputError, XplainError
from xplain.people.analysis.stored import read_plan
from xplain.people.server.app import create_app
from xplain.people.server.store import Store
from xplain.people.simulation.browser import visit
from xplain.people.study.plan import StudyPlan
from xplain.people.study.site import StudySite


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
            getattr(people, command[0])(kind, command[1:])
    with pytest.raises(InputError, match=r"goes on, .* with the version that began it"):
        read_plan(snapshot, site_of(kind).PLAN)


def test_a_plan_without_what_came_later_is_exported_but_does_not_go_on(
    kind: str, snapshot: Path, tmp_path: Path
) -> None:
    planned(snapshot, ahead=None, pictures=None)
    plan = read_plan(snapshot, site_of(kind).PLAN)
    assert plan is not None
    assert (plan.ahead, plan.pictures) == (None, ())
    assert "ahead" not in [one.name for one in site_of(kind).flow.STAGES if one.wanted(plan)]
    main([kind, "export", str(snapshot), str(tmp_path / "data")])
    assert (tmp_path / "data" / "codebook.csv").is_file()
    with pytest.raises(InputError, match=r"begun by an earlier version: go on with that one"):
        Store(snapshot, site_of(kind).as_planned(plan))


def test_rounding_is_no_difference_and_is_told(
    kind: str, snapshot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with sqlite3.connect(snapshot) as connection:
        sql = "SELECT participant, belief_after FROM step WHERE k = 1"
        who, text = connection.execute(sql).fetchone()
    connection.close()
    belief = json.loads(text)
    name = next(key for key in (belief if kind == "collect" else range(len(belief))) if belief[key])
    for more, verdict in ((1e-13, "all equal, 1 values but for rounding"), (1e-7, "1 differences")):
        belief[name] += more
        said = json.dumps(belief)
        where = f"k = 1 AND participant = '{who}'"
        changed(snapshot, f"UPDATE step SET belief_after = '{said}' WHERE {where}")
        with pytest.raises(SystemExit) if more > 1e-9 else nullcontext():
            main([kind, "replay", str(snapshot)])
        assert verdict in capsys.readouterr().out


def test_where_another_version_decided_otherwise_a_replay_says_so(
    kind: str, snapshot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = site_of(kind)
    other = {"study": {}, "collect": ()}[kind]
    plan = replace(own.plan, probes=other)
    with pytest.raises(XplainError, match="go on and replay with that version"):
        own.of(plan)
    monkeypatch.setattr(type(own).PLAN, "from_text", lambda text: plan)
    main([kind, "replay", str(snapshot)])  # nothing differs: no reason to refuse
    changed(snapshot, "UPDATE step SET given = given + 1 WHERE k = 1")
    with pytest.raises(XplainError, match="go on and replay with that version"):
        people.replay(kind, [str(snapshot)])


def test_a_study_from_before_there_were_questions_is_exported_and_replays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Plans and states without anything of questions, as they were stored then."""
    site = StudySite(street_study())
    plan = json.loads(site.plan.text)
    del plan["clips"], plan["clip_labels"], plan["problem"]["questions"]
    said = json.dumps(plan, sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    site.plan.__dict__["text"] = said
    path = tmp_path / "s.sqlite"
    store = Store(path, site)
    for number, token in enumerate(store.invite(3, "person")):
        visitor = Visitor(create_app(store, GENEROUS).test_client())
        assert visit(visitor, bot_of(site, number), token) == "done"
    states = store.query("SELECT state FROM participant")
    assert not any("asked" in json.loads(row["state"]) for row in states)
    store.close()
    main(["study", "replay", str(path)])
    assert "all equal" in capsys.readouterr().out
    main(["study", "export", str(path), str(tmp_path / "data")])
    assert not (tmp_path / "data" / "questions.csv").exists()
    old = read_plan(path, StudyPlan)
    assert old is not None
    with pytest.raises(InputError, match="go on with that one"):
        Store(path, StudySite.as_planned(old))
