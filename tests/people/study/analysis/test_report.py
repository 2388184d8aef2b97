"""The command that prints and draws the analysis."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rich.console import Console
from scipy import stats

from tests.people.study.analysis.completed import completed
from xplain.cli.main import main
from xplain.errors import InputError
from xplain.people.export import codebook, described
from xplain.people.study.analysis import (
    CONDITIONS,
    Analysis,
    analyse,
    exclusions,
    paper_table,
    save,
    show,
)
from xplain.people.study.tables import export


def test_streams_are_never_mixed(
    snapshot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    export(snapshot, out)
    main(["study", "analyse", str(out), "--stream", "bot"])
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
    with pytest.raises(SystemExit) as ended:  # one person is no study
        main(["study", "analyse", str(out)])
    assert ended.value.code == 2
    assert "at least 2 completed" in capsys.readouterr().err


def test_a_file_that_lists_nobody_to_exclude_is_named(tmp_path: Path) -> None:
    (tmp_path / "participants.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="participant, reason"):
        exclusions(tmp_path / "participants.csv")


@pytest.fixture(scope="module")
def analysis() -> Analysis:
    return analyse(completed(20), "person", {})


def _both(analysis: Analysis, measure: str) -> list[pd.Series[float]]:
    return [
        analysis.data.loc[analysis.data["condition"] == c, measure].astype(float)
        for c in CONDITIONS
    ]


def test_the_file_has_each_measure_with_its_figures(analysis: Analysis, tmp_path: Path) -> None:
    save(analysis, tmp_path / "new" / "folder")
    table = pd.read_csv(tmp_path / "new" / "folder" / "table2.csv", index_col="measure")
    assert list(table.index) == list(analysis.measures.index)
    for name in ("table2", "flow"):
        written = pd.read_csv(tmp_path / "new" / "folder" / f"{name}.csv")
        columns = [row["column"] for row in codebook("xplain.people.study") if row["table"] == name]
        described(name, written.to_dict("records"), columns)  # refuses others
    for measure in table.index:
        of, (a, b) = table.loc[measure], _both(analysis, measure)
        assert (of["n_conformant"], of["n_personalized"]) == (len(a), len(b))
        assert of["mean_conformant"] == pytest.approx(a.mean())
        assert of["mean_personalized"] == pytest.approx(b.mean())
        assert of["sd_personalized"] == pytest.approx(b.std())
        assert of["student_p"] == pytest.approx(stats.ttest_ind(a, b).pvalue)
        assert of["welch_p"] == pytest.approx(stats.ttest_ind(a, b, equal_var=False).pvalue)
        pooled = np.sqrt((a.var() + b.var()) / 2)  # as many in both
        correction = 1 - 3 / (4 * (len(a) + len(b) - 2) - 1)
        g = (a.mean() - b.mean()) / pooled * correction
        assert of["hedges_g"] == pytest.approx(g, rel=1e-3)
        assert of["g_low"] < of["hedges_g"] < of["g_high"]
        assert 0 < of["permutation_p"] <= 1
    for measure, paper in paper_table().items():
        assert table.loc[measure, "paper_p_value"] == paper["p_value"]
        assert table.loc[measure, "student_p_holm"] >= table.loc[measure, "student_p"]


def test_the_terminal_tells_where_everybody_went(analysis: Analysis) -> None:
    console = Console(width=260, record=True, file=io.StringIO())
    show(analysis, console)
    _, _, flow = console.export_text().partition("Flow of participants")
    rows = {
        line.split("│")[1].strip(): line.split("│")[2:-1]
        for line in flow.splitlines()
        if "│" in line
    }
    for stage, counts in analysis.flow.iterrows():
        told = [int(cell) for cell in rows[stage]]
        assert told == [counts[key] for key in ("all", *CONDITIONS)]
    assert int(rows["analysed"][0]) == len(analysis.data)
