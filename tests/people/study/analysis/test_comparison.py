"""The comparison of conditions: Table 2 as scipy computes it, figures about questions, and the
command that prints and draws both."""

import re
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from tests.conftest import Run
from tests.people.study.stand_in import ASK, CONFIG, street_plan, street_study
from tests.people.visitors import take_part
from xplain.errors import InputError
from xplain.people.store import Store
from xplain.people.study.analysis import (
    MEASURES,
    analyse,
    analyse_all,
    document,
    paper_table,
    read,
)
from xplain.people.study.bot import Habits, StudyBot
from xplain.people.study.flow import Study
from xplain.people.study.tables import export


def completed(n: int) -> pd.DataFrame:
    """Makes n completed participants in each condition, and a bot that would change all results."""
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
            "messages_given": i % 4,
        }
        for condition, shift in (("conformant", 30), ("personalized", 0))
        for i in range(n)
    ]
    bot = rows[0] | {"participant": "bot", "stream": "bot", "interaction_time_s": 1e9}
    return pd.DataFrame([*rows, bot])


def test_the_table_is_what_scipy_computes_from_people_alone() -> None:
    data = completed(20)
    found = analyse(data, "person", {"conformant3": "was interrupted"})
    assert found.flow.loc["excluded: was interrupted", "all"] == 1
    assert found.flow.loc["analysed", "all"] == len(found.data)
    own = data[(data["stream"] == "person") & (data["participant"] != "conformant3")]
    for measure, row in found.measures.iterrows():
        a, b = (own.loc[own["condition"] == c, measure] for c in ("conformant", "personalized"))
        student, welch = stats.ttest_ind(a, b), stats.ttest_ind(a, b, equal_var=False)
        assert row["student_p"] == pytest.approx(student.pvalue)
        assert row["student_df"] == 37
        assert row["welch_p"] == pytest.approx(welch.pvalue)
        assert (row["n_conformant"], row["n_personalized"]) == (19, 20)
        assert row["mean_conformant"] == pytest.approx(a.mean())
    assert list(found.measures.index)[:3] == list(paper_table())
    with pytest.raises(InputError, match="exclude"):
        analyse(data, "person", {"nobody": "x"})
    with pytest.raises(InputError, match="stream"):
        analyse(data, "people", {})


@pytest.mark.parametrize("n", [0, 1, 2])
def test_small_studies_are_analysed_or_refused(n: int, tmp_path: Path) -> None:
    data = completed(n + 1).iloc[: 2 * n] if n < 2 else completed(n)
    data.assign(interaction_time_s=5.0).to_csv(tmp_path / "participants.csv", index=False)
    if n < 2:
        with pytest.raises(InputError):
            analyse(read(tmp_path), "person", {})
    else:  # no spread in time: no t test, but no failure
        found = analyse(read(tmp_path), "person", {})
        time = found.measures.loc["interaction_time_s"]
        assert np.isnan(time["student_p"])
        assert time["permutation_p"] == 1


def test_who_has_no_possible_time_counts_in_every_other_measure() -> None:
    data = completed(6)
    whose = data.index[(data["condition"] == "conformant") & (data["stream"] == "person")][0]
    data.loc[whose, "interaction_time_s"] = np.nan
    found = analyse(data, "person", {})
    time, inexplicable = (found.measures.iloc[row] for row in (0, 1))
    assert (time["n_conformant"], inexplicable["n_conformant"]) == (5, 6)
    assert not np.isnan(time["student_p"])
    assert found.flow.loc["time left out: the clock was set back", "all"] == 1


def test_files_that_are_no_export_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"participants\.csv"):
        read(tmp_path)
    (tmp_path / "participants.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="lacks the column participant"):
        read(tmp_path)


def test_streams_are_never_mixed(snapshot: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "out"
    export(snapshot, out)
    said = run("study analyse", out, "--stream", "bot")[1]
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
    code, _, error = run("study analyse", out)  # one person is no study
    assert code == 2
    assert "at least 2 completed" in error


def test_costs_and_questions_are_those_of_the_log(
    tmp_path: Path, run: Run, no_pictures: None
) -> None:
    """They are counted again from tables that do not use the states."""
    flow = street_study(ask=ASK | {"cost": 0.25}, **{"lambda": 1.5})
    path, out = tmp_path / "s.sqlite", tmp_path / "out"
    rngs, habits = map(np.random.default_rng, range(18)), Habits(label_noise=0.1, leaving=0.02)
    with closing(Store(path, flow)) as store:
        take_part(store, (StudyBot(flow.plan, habits, rng) for rng in rngs), "bot")
    assert "all equal" in run("study replay", path)[1]
    run("study export", path, out)
    tables = {
        n: pd.read_csv(out / f"{n}.csv") for n in ("participants", "labels", "steps", "pages")
    }
    events, questions = (pd.read_csv(out / f"{n}.csv") for n in ("events", "questions"))
    people = tables["participants"].set_index("participant")
    answered = events[(events["kind"] == "clip") & (events["source"] == "protocol")]
    each = answered.groupby("participant").size().reindex(people.index, fill_value=0)
    done = people[people["stage"] == "done"]
    assert (done["questions_asked"] == each[done.index]).all()
    assert (
        done.groupby("condition")["questions_asked"].sum()[["conformant", "personalized"]].sum()
        == 0
    )
    assert done.loc[done["condition"] == "asking", "questions_asked"].sum() > 0
    wrong = (tables["labels"]["label"] == 0).groupby(tables["labels"]["participant"]).sum()
    said = (
        tables["steps"]["messages"]
        .fillna("")
        .map(lambda names: len([n for n in names.split(";") if n]))
    )
    told = said.groupby(tables["steps"]["participant"]).sum()
    cost = (1.5 * told + wrong + 0.25 * each)[done.index]
    assert done["cost"].to_numpy() == pytest.approx(cost.to_numpy())
    in_order = questions.dropna(subset=["label"]).sort_values(["participant", "number"])
    logged = answered.sort_values(["participant", "source_sequence"])
    assert [f'{{"label": {x:.0f}}}' for x in in_order["label"]] == logged["payload"].tolist()
    of_pages = tables["pages"][tables["pages"]["stage"] == "asking"]
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
    shown = run("study analyse", out, "--stream", "bot")[1]
    assert "Questions between steps" in " ".join(shown.split())
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


RULES = {"per_cell": 7, "max_attempts": 3, "timeout_minutes": 45, "recall": True, "min_width": 900}
CHECK = {"name": "blue", "label": "Choose blue", "kind": "choice", "choices": ["red", "blue"]}


def test_the_document_says_what_the_plan_does() -> None:
    belief = CONFIG["belief"] | {"accept": 0.8}
    plan = street_plan(rules=RULES, before=[CHECK | {"right": "blue"}], belief=belief)
    text = document(plan)
    for part in (
        plan.hash,
        "7 participants finish in each of 6 cells: 21 in each condition, 42 in total",
        "fail the check after the briefing 3 times",
        "45 minutes",
        "less than 900 pixels",
        "answer “Choose blue” before the briefing with anything except “blue”",
        "Before the briefing: “Choose blue” (choice, `blue`).",
        "After the quiz: “Your age” (number, `age`); “Anything else?” (text, `comment`).",
        "QMDP",
        "Conformant",
        "may say a message again",
        "(`messages_again`, secondary)",
        "Holm",
        *plan.trace,
        *(role.name for role in plan.roles),
    ):
        assert part in text, part
    asking = document(street_plan(ask=ASK | {"when": "first"}))
    for part in (
        "5. Participants who also answer questions have a higher score",
        "before the first step of the evaluation. A question costs 0.1 times as much",
        "`questions_asked`",
        "Personalized and asking are compared in the same way",
    ):
        assert part in asking, part
    # Without them nothing of them is promised.
    promised = "pixels|with anything except|message again|messages_again|asking"
    assert not re.search(promised, document(street_plan()))


def test_the_command_reads_a_study_that_was_started(study: Study, tmp_path: Path, run: Run) -> None:
    Store(tmp_path / "s.sqlite", study).close()
    run("study preregister", "s.sqlite", "--out", "p.md")
    assert (tmp_path / "p.md").read_text() == document(study.plan)
    assert "a study that was started" in run("study preregister", "none.sqlite")[2]
