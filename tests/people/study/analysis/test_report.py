"""The command that prints and draws the analysis."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from xplain.cli.main import main
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
