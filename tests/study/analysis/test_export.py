"""The exported tables and the codebook that describes them."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from xplain.participants.server.store import Store
from xplain.study.analysis import export, replay
from xplain.study.analysis.codebook import CODEBOOK


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
    assert store.secret.hex() not in everything


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
