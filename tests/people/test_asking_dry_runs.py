"""The real server in a study that asks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.people.killing import survive
from tests.people.study.stand_in import ASK, FAULTLESS, street_study
from tests.people.test_dry_runs import everything_replays
from xplain.people.store import Store
from xplain.people.study.bot import StudyBot
from xplain.people.study.tables import export


@pytest.mark.parametrize(
    ("kills", "people", "least"), [(1, 8, 20), pytest.param(10, 8, 150, marks=pytest.mark.slow)]
)
def test_questions_survive_kill_9(
    kills: int, people: int, least: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Bots who err in all three conditions; the server dies while they are asked, too."""
    flow, path = street_study(ask=ASK), tmp_path / "s.sqlite"

    def erring(*seeds: int) -> StudyBot:
        habits = replace(FAULTLESS, label_noise=0.2)
        return StudyBot(flow.plan, habits, np.random.default_rng(seeds))

    Store(path, flow).close()
    acknowledged, stored = survive(path, flow, "study", erring, kills, people)
    with capsys.disabled():
        print(f"\n{kills} kills: {acknowledged} answers acknowledged, {stored} stored")
    assert least < acknowledged <= stored
    everything_replays("study", path, capsys)
    export(path, tmp_path / "out")
    told = pd.read_csv(tmp_path / "out" / "participants.csv")
    asked = told.groupby("condition")["questions_asked"].sum()
    assert asked["asking"] > 0 == asked["personalized"] == asked["conformant"]
