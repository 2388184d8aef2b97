"""Export, replay, times and the analysis of what the server stored."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.study.conftest import Visitor
from xplain.errors import InputError
from xplain.participants.server.store import Store
from xplain.participants.simulation.http_client import visit
from xplain.study.analysis import export, replay
from xplain.study.analysis import main as analyse
from xplain.study.analysis.codebook import CODEBOOK
from xplain.study.analysis.table2 import analyse as analysis_of
from xplain.study.analysis.table2 import paper_table, read
from xplain.study.analysis.timing import hidden, interaction
from xplain.study.protocol.machine import State
from xplain.study.simulation.participant import Habits, Person


@pytest.fixture
def snapshot(
    store: Store,
    browser: Callable[[], Visitor],
    person: Callable[..., Person],
    tmp_path: Path,
) -> Path:
    """24 bots, some of whom leave, one person, one who only looked in."""
    for number, token in enumerate(store.invite(24, "bot")):
        habits = Habits(leaving=0.05, mistake=0.1)
        visit(browser(), person(number, habits), token)
    visit(browser(), person(), store.invite(1, "person")[0])
    store.enter_invited(store.invite(1, "person")[0])
    path = tmp_path / "snapshot.sqlite"
    store.snapshot(path)
    return path


def test_tables_say_what_their_codebook_says(snapshot: Path, store: Store, tmp_path: Path) -> None:
    export.main([str(snapshot), str(tmp_path / "out")])
    for name, columns in CODEBOOK.items():
        csv = pd.read_csv(tmp_path / "out" / f"{name}.csv")
        parquet = pd.read_parquet(tmp_path / "out" / f"{name}.parquet")
        assert list(csv.columns) == list(parquet.columns) == list(columns)
        assert len(csv) == len(parquet)
    out = tmp_path / "out"
    people = pd.read_csv(out / "participants.csv").set_index("participant")
    assert (people["stream"] == "bot").sum() == 24
    done = people[people["stage"] == "done"]
    assert len(done) > 3
    labels, quiz = pd.read_csv(out / "labels.csv"), pd.read_csv(out / "quiz.csv")
    last = labels[labels["k"] == store.study.plan.n_steps - 1]
    for who, row in done.iterrows():
        own = last[last["participant"] == who]
        assert row["inexplicable_transitions"] == (own["label"] == 0).sum()
        assert row["quiz_score"] == quiz.loc[quiz["participant"] == who, "correct"].sum()
        assert row["interaction_time_s"] > 0
    assert json.loads((out / "plan.json").read_text())["seed"] == store.study.plan.seed
    everything = "".join(path.read_text() for path in out.glob("*.csv"))
    assert store._key.hex() not in everything


def test_replay_agrees_to_the_last_bit_and_notices_any_change(
    snapshot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    replay.main([str(snapshot)])
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
            replay.main([str(snapshot)])
        assert ended.value.code == 1, change
    capsys.readouterr()


def test_a_database_in_use_is_not_read(
    store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        export.main([str(store.path), str(tmp_path / "out")])
    assert ended.value.code == 2
    assert "in use by a server" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        replay.main([str(tmp_path / "nothing.sqlite")])
    assert not (tmp_path / "out").exists()


def test_streams_are_never_mixed(
    snapshot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    export.export(snapshot, out)
    analyse.main([str(out), "--stream", "bot"])
    said = capsys.readouterr().out
    assert "SIMULATED PARTICIPANTS" in said
    for value in ("120.48", "100.85", "0.032", "3.45"):
        assert value in said  # the paper's, beside ours
    assert (out / "measures.png").stat().st_size > 10_000
    people = pd.read_csv(out / "participants.csv")
    flow = pd.read_csv(out / "flow.csv").set_index("stage")
    bots = people[people["stream"] == "bot"]
    assert flow.loc["entered", "all"] == 24
    assert flow.loc["completed", "all"] == (bots["stage"] == "done").sum()
    ends = ("completed", "declined", "ineligible", "withdrawn", "timed out", "still on their way")
    assert sum(flow.loc[end, "all"] for end in ends) == 24
    with pytest.raises(SystemExit):  # one person is no study
        analyse.main([str(out)])
    assert "at least 2 completed" in capsys.readouterr().err


def _data(n: int) -> pd.DataFrame:
    """n completed participants a condition, and a bot that would spoil everything."""
    rng = np.random.default_rng(0)
    rows = [
        {
            "participant": f"{condition}{i}",
            "stream": "person",
            "stage": "done",
            "type": "ABCDE"[i % 5],
            "condition": condition,
            "eligible": 1,
            "interaction_time_s": 100 + shift + rng.normal(0, 20),
            "inexplicable_transitions": int(rng.poisson(1)),
            "quiz_score": int(rng.integers(0, 5)),
            "visible_time_s": 90.0 + i,
        }
        for condition, shift in (("conformant", 30), ("personalized", 0))
        for i in range(n)
    ]
    bot = rows[0] | {"participant": "bot", "stream": "bot", "interaction_time_s": 1e9}
    return pd.DataFrame([*rows, bot])


def test_the_table_is_what_scipy_computes_from_people_alone() -> None:
    from scipy import stats

    data = _data(20)
    found = analysis_of(data, "person", {"conformant3": "was interrupted"})
    assert found.excluded == {"was interrupted": 1}
    own = data[(data["stream"] == "person") & (data["participant"] != "conformant3")]
    for row in found.rows:
        a, b = (own.loc[own["condition"] == c, row.measure] for c in ("conformant", "personalized"))
        student, welch = stats.ttest_ind(a, b), stats.ttest_ind(a, b, equal_var=False)
        assert row.ours.student.p == pytest.approx(student.pvalue)
        assert row.ours.student.df == 37
        assert row.ours.welch.p == pytest.approx(welch.pvalue)
        assert (row.ours.a.n, row.ours.b.n) == (19, 20)
        assert row.ours.a.mean == pytest.approx(a.mean())
    assert [row.measure for row in found.rows][:3] == list(paper_table())
    with pytest.raises(InputError, match="exclude"):
        analysis_of(data, "person", {"nobody": "x"})
    with pytest.raises(InputError, match="stream"):
        analysis_of(data, "people", {})


@pytest.mark.parametrize("n", [0, 1, 2])
def test_small_studies_are_analysed_or_refused(n: int, tmp_path: Path) -> None:
    data = _data(n + 1).iloc[: 2 * n] if n < 2 else _data(n)
    data.assign(interaction_time_s=5.0).to_csv(tmp_path / "participants.csv", index=False)
    if n < 2:
        with pytest.raises(InputError):
            analysis_of(read(tmp_path), "person", {})
    else:  # no spread in time: no t test, but no failure
        found = analysis_of(read(tmp_path), "person", {})
        assert np.isnan(found.rows[0].ours.student.p)
        assert found.rows[0].ours.permutation_p == 1


def test_files_that_are_no_export_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"participants\.csv"):
        read(tmp_path)
    (tmp_path / "participants.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="lacks the column participant"):
        read(tmp_path)
    with pytest.raises(InputError, match="participant, reason"):
        analyse.exclusions(tmp_path / "participants.csv")


# Times -----------------------------------------------------------------------------------------


def event(source: str, kind: str, at: float, **payload: Any) -> dict[str, Any]:
    """At ``at`` seconds, on every clock."""
    tab = source.startswith("tab:")
    return {
        "source": source,
        "kind": kind,
        "wall": 1e9 + at,
        "monotonic": 5.0 + at,
        "boot": "one",
        "payload": {"at": 1e12 + 1000 * at} | payload if tab else payload,
    }


def seen(at: float, tab: str = "a", stage: str = "evaluation") -> dict[str, Any]:
    return event(f"tab:{tab}", "visible", at, what=stage)


def gone(at: float, tab: str = "a") -> dict[str, Any]:
    return event(f"tab:{tab}", "hidden", at, what="evaluation")


LABELS = [
    event("shown", "shown", 0, stage="evaluation"),
    event("protocol", "labels", 40),
    event("shown", "shown", 41, stage="evaluation"),
    event("protocol", "labels", 100),
    event("shown", "shown", 101, stage="quiz"),
]


def test_time_runs_from_the_first_rendering_to_the_last_label() -> None:
    found = interaction(LABELS)
    assert (found.wall, found.monotonic, found.hidden, found.visible) == (100, 100, None, None)
    restarted = [*LABELS[:3], LABELS[3] | {"boot": "two", "monotonic": 0.5}]
    assert (interaction(restarted).wall, interaction(restarted).monotonic) == (100, None)
    assert interaction(LABELS[:1]).wall is None


@pytest.mark.parametrize(
    ("reports", "away"),
    [
        ([], None),
        ([seen(0), seen(41, "b"), seen(101, "c", "quiz")], 0),
        ([seen(0), gone(10), seen(30), seen(41, "b"), seen(101, "c", "quiz")], 20),
        # Two tabs: from one to the other and back is not away; both hidden is.
        ([seen(0), gone(10), seen(10, "b"), gone(20, "b"), seen(20), gone(50), seen(57, "b")], 7),
        # The page before stays "visible" for ever, since an answer led on from it.
        ([seen(0), seen(41, "b"), gone(50, "b"), seen(60, "b")], 10),
        # Hidden before and after the evaluation is not counted.
        ([seen(-9, "z", "briefing"), gone(-8, "z"), seen(-2, "z", "briefing"), seen(0)], 0),
        ([seen(0), seen(101, "c", "quiz"), gone(110, "c"), seen(150, "c", "quiz")], 0),
        # Closed, and opened again later.
        ([seen(0), gone(30), seen(90, "b"), seen(101, "c", "quiz")], 60),
    ],
)
def test_hidden_time_is_when_no_page_is_looked_at(
    reports: list[dict[str, Any]], away: float | None
) -> None:
    assert hidden(reports) == (None if away is None else pytest.approx(away))
    found = interaction([*LABELS, *reports])
    assert found.visible == (None if away is None else pytest.approx(100 - away))


def test_states_are_read_back_as_they_were() -> None:
    state = State(stage="evaluation", belief=(0.1 + 0.2, 1 / 3), labels=(1, 0), previous=0)
    assert State.from_text(state.text) == state
