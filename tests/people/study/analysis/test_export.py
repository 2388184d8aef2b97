"""The exported tables and the codebook that describes them: no column without a meaning, no meaning
without a column, no formula."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from tests.conftest import Run
from xplain.people.export import codebook, defuse, order_columns
from xplain.people.store import Store
from xplain.people.study.flow import Study


def test_tables_say_what_their_codebook_says(
    snapshot: Path, collected: tuple[bytes, str], study: Study, tmp_path: Path, run: Run
) -> None:
    run("study export", snapshot, "out")
    others = ("table2", "asking", "flow", "questions")  # the last where some are asked
    book = pd.DataFrame(codebook("xplain.people.study")).groupby("table")["column"]
    exported = {str(name): [*columns] for name, columns in book if name not in others}
    for name, described in exported.items():
        columns = [one for one in described if not one.endswith("…")]
        csv = pd.read_csv(tmp_path / "out" / f"{name}.csv")
        parquet = pd.read_parquet(tmp_path / "out" / f"{name}.parquet")
        assert list(csv.columns) == list(parquet.columns) == columns
        assert pq.read_schema(tmp_path / "out" / f"{name}.parquet").names == columns
        assert len(csv) == len(parquet)
    out = tmp_path / "out"
    people = pd.read_csv(out / "participants.csv").set_index("participant")
    assert (people["stream"] == "bot").sum() == 24
    done = people[people["stage"] == "done"]
    assert len(done) > 3
    labels, quiz = pd.read_csv(out / "labels.csv"), pd.read_csv(out / "quiz.csv")
    events = pd.read_csv(out / "events.csv")
    last = labels[labels["k"] == study.plan.n_steps - 1]
    for who, row in done.iterrows():
        own = last[last["participant"] == who]
        assert row["inexplicable_transitions"] == (own["label"] == 0).sum()
        assert row["quiz_score"] == quiz.loc[quiz["participant"] == who, "correct"].sum()
        own = events[events["participant"] == who]
        shown = own[(own["kind"] == "shown") & own["payload"].str.contains("evaluation")]
        assert all(set(json.loads(one)) for one in own.loc[own["kind"] == "labels", "payload"])
        until = own.loc[own["kind"] == "labels", "wall"].max()
        assert row["interaction_time_s"] == pytest.approx(until - shown["wall"].min(), abs=1e-3)
    shown_for = done["interaction_time_s"] - done["hidden_s"]
    np.testing.assert_allclose(done["visible_time_s"], shown_for, atol=1e-3)
    assert json.loads((out / "plan.json").read_text())["seed"] == study.plan.seed
    pages, steps = pd.read_csv(out / "pages.csv"), pd.read_csv(out / "steps.csv")
    for who in done.index:
        own = pages[pages["participant"] == who]
        assert own["seconds"].iloc[:-1].notna().all()
        in_steps = steps.loc[steps["participant"] == who, "seconds"].sum()
        of_pages = own.loc[own["stage"] == "evaluation", "seconds"].sum()
        assert in_steps == pytest.approx(of_pages)
        # Pages follow one another: no more time passes on them than passed.
        assert own["seconds"].sum() <= events.loc[events["participant"] == who, "wall"].agg(
            lambda wall: wall.max() - wall.min()
        )
    known = pd.read_csv(out / "codebook.csv").set_index(["table", "column"])
    for name in exported:
        table = pd.read_csv(out / f"{name}.csv")
        for column in table:
            numeric = pd.api.types.is_numeric_dtype(table[column]) and table[column].notna().any()
            stated = known.loc[(name, column), "type"]
            assert not (numeric and stated == "text" and column != "answer"), (name, column)
    digest, name = (out / "SHA256SUMS").read_text().split()
    assert digest == hashlib.sha256((out / name).read_bytes()).hexdigest()
    everything = "".join(path.read_text() for path in out.glob("*.csv"))
    assert collected[1] not in everything


def test_a_database_in_use_is_not_read(store: Store, tmp_path: Path, run: Run) -> None:
    code, _, error = run("study export", store.path, "out")
    assert code == 2
    assert "a free file: another process" in error
    assert not (tmp_path / "out").exists()


CODEBOOK = ["who", "stated_…", "number"]


def test_columns_are_those_of_the_codebook_in_its_order_and_others_last() -> None:
    rows = [{"number": n, "stated_b": 1, "who": name, "stated_a": 0} for n, name in enumerate("xy")]
    table = order_columns("people", rows, CODEBOOK)
    assert list(table.columns) == ["who", "number", "stated_b", "stated_a"]
    assert table.to_dict("records") == rows


@pytest.mark.parametrize(
    ("row", "named"),
    [
        ({"who": "x", "number": 1, "age": 3}, "age"),  # nobody would know what it means
        ({"who": "x"}, "number"),  # it would be lost
        ({"who": "x", "number": 1, "stated": 1}, "stated"),
        ({"who": "x", "number": 1, "stated_…": 1}, "stated_…"),
    ],
)
def test_a_row_that_is_not_as_its_codebook_says_is_refused(
    row: dict[str, object], named: str
) -> None:
    with pytest.raises(ValueError, match=f"^people: .*'{named}'"):
        order_columns("people", [row], CODEBOOK)


def test_no_cell_is_a_formula() -> None:
    for text in (
        "=1+1",
        "+A1",
        "-A1",
        "@SUM(A1)",
        "\t=1",
        "\r=1",
        "\uff1d1+1",
        "\uff0b1",
        "\uff0d1",
        "\uff20A1",
    ):
        assert defuse(text) == f"'{text}"
    for harmless in ("1 + 1", "a=b", "", -1, -1.5, None, "[1, 0]"):
        assert defuse(harmless) == harmless
