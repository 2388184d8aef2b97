"""Figures about questions: from the log to the tables, and in the comparison."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from tests.people.client import Client
from tests.people.study.analysis.completed import completed
from tests.people.study.stand_in import ASK, street_plan, street_study
from tests.people.visitors import GENEROUS, Visitor
from xplain.cli.main import main
from xplain.people.bots import visit
from xplain.people.store import Store
from xplain.people.study.analysis import MEASURES, analyse_all, document
from xplain.people.study.bot import Habits, StudyBot
from xplain.people.web import create_app


def test_costs_and_questions_are_those_of_the_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They are counted again from tables that do not use the states."""
    flow = street_study(ask=ASK | {"cost": 0.25}, **{"lambda": 1.5})
    path, out = tmp_path / "s.sqlite", tmp_path / "out"
    store = Store(path, flow)
    app = create_app(store, GENEROUS)
    for number, token in enumerate(store.invite(36, "bot")):
        habits = Habits(label_noise=0.1, leaving=0.02)
        visit(
            Visitor(Client(app)),
            StudyBot(flow.plan, habits, np.random.default_rng(number)),
            token,
        )
    store.close()
    main(["study", "replay", str(path)])
    assert "all equal" in capsys.readouterr().out
    main(["study", "export", str(path), str(out)])
    read = {n: pd.read_csv(out / f"{n}.csv") for n in ("participants", "labels", "steps", "pages")}
    events, questions = (pd.read_csv(out / f"{n}.csv") for n in ("events", "questions"))
    people = read["participants"].set_index("participant")
    answered = events[(events["kind"] == "clip") & (events["source"] == "protocol")]
    each = answered.groupby("participant").size().reindex(people.index, fill_value=0)
    done = people[people["stage"] == "done"]
    assert (done["questions_asked"] == each[done.index]).all()
    assert (
        done.groupby("condition")["questions_asked"].sum()[["conformant", "personalized"]].sum()
        == 0
    )
    assert done.loc[done["condition"] == "asking", "questions_asked"].sum() > 0
    wrong = (read["labels"]["label"] == 0).groupby(read["labels"]["participant"]).sum()
    said = (
        read["steps"]["messages"]
        .fillna("")
        .map(lambda names: len([n for n in names.split(";") if n]))
    )
    told = said.groupby(read["steps"]["participant"]).sum()
    cost = (1.5 * told + wrong + 0.25 * each)[done.index]
    assert done["cost"].to_numpy() == pytest.approx(cost.to_numpy())
    labels = [f'{{"label": {label:.0f}}}' for label in questions["label"].dropna()]
    in_order = questions.dropna(subset=["label"]).sort_values(["participant", "number"])
    logged = answered.sort_values(["participant", "source_sequence"])
    assert [f'{{"label": {x:.0f}}}' for x in in_order["label"]] == logged["payload"].tolist()
    assert len(labels) == len(answered)
    of_pages = read["pages"][read["pages"]["stage"] == "asking"]
    assert of_pages["seconds"].sum() == pytest.approx(questions["seconds"].sum(), rel=0.05)
    assert (
        in_order["k"].to_numpy()
        == of_pages[of_pages["seconds"].notna()]
        .merge(
            logged, left_on=["participant", "sequence"], right_on=["participant", "source_sequence"]
        )
        .sort_values(["participant", "sequence_x"])["step"]
        .to_numpy()
    ).all()
    main(["study", "analyse", str(out), "--stream", "bot"])
    shown = " ".join(capsys.readouterr().out.split())
    assert "Questions between steps" in shown
    assert {"table2.csv", "asking.csv", "measures.png", "asking.png"} <= {
        p.name for p in out.iterdir()
    }


def with_asking(n: int) -> pd.DataFrame:
    data = completed(n).assign(questions_asked=0, cost=3.0)
    third = data[data["condition"] == "personalized"].copy()
    third["participant"] = third["participant"].str.replace("personalized", "asking")
    rng = np.random.default_rng(5)
    third = third.assign(condition="asking", questions_asked=rng.integers(1, 4, len(third)))
    third["quiz_score"] = rng.integers(2, 5, len(third))
    return pd.concat([data, third], ignore_index=True)


def test_asking_is_compared_with_personalized_and_the_paper_s_table_stays() -> None:
    data = with_asking(20)
    found, before = analyse_all(data, "person", {}), analyse_all(completed(20), "person", {})
    assert [*found] == ["table2", "asking"]
    assert [*before] == ["table2"]
    as_before = found["table2"].measures.loc[before["table2"].measures.index]
    pd.testing.assert_frame_equal(as_before, before["table2"].measures)
    own = data[data["stream"] == "person"]
    rows = found["asking"].measures
    assert {*MEASURES, "questions_asked", "cost"} <= {*rows.index}
    assert not [column for column in rows if column.startswith("paper")]
    for measure in ("quiz_score", "questions_asked"):
        a, b = (own.loc[own["condition"] == c, measure] for c in ("personalized", "asking"))
        test = stats.ttest_ind(a, b)
        assert rows.loc[measure, "student_p"] == pytest.approx(test.pvalue)
        assert rows.loc[measure, "student_t"] == pytest.approx(test.statistic)
    assert found["asking"].flow.loc["completed"].to_dict() == {
        "all": 60,
        "conformant": 20,
        "personalized": 20,
        "asking": 20,
    }


def test_what_is_registered_says_that_some_are_asked() -> None:
    text = document(street_plan(ask=ASK | {"when": "first"}))
    for part in (
        "5. Participants who also answer questions have a higher score",
        "before the first step of the evaluation. A question costs 0.1 times as much",
        "`questions_asked`",
        "Personalized and asking are compared in the same way",
    ):
        assert part in text, part
    assert "asking" not in document(street_plan())
