"""The comparison of conditions: Table 2 as scipy computes it, figures about questions, and the
command that prints and draws both; statistics as published, and as other programs compute them."""

import io
import re
from contextlib import closing
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from rich.console import Console
from scipy import stats

from tests.conftest import Run
from tests.people.street import ASK, CONFIG, street_plan, street_study
from tests.people.visitors import take_part
from xplain.errors import InputError
from xplain.people.store import Store
from xplain.people.study.analysis import (
    MEASURES,
    TESTS,
    TITLES,
    analyse,
    analyse_all,
    compare,
    document,
    draw,
    hedges,
    holm,
    paper_table,
    read,
    show,
    stratified_permutation,
)
from xplain.people.study.bot import Habits, StudyBot
from xplain.people.study.flow import Study


def test_holm_by_hand() -> None:
    # Holm (1979): 4 tests, α multiplied by 4, 3, 2, 1 from the smallest p on.
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.9]) == pytest.approx([1.0, 1.0])
    assert holm([0.01, np.nan, 0.04]) == pytest.approx([0.02, np.nan, 0.04], nan_ok=True)
    # None of the paper's p values survives the correction.
    assert holm(paper_table()["p_value"]) == pytest.approx([0.072, 0.072, 0.072])


def test_hedges_interval_holds_the_truth_as_often_as_it_says() -> None:
    rng, delta, hits, rounds = np.random.default_rng(1), 0.7, 0, 600
    for _ in range(rounds):
        a, b = rng.normal(delta, 1, 15), rng.normal(0, 1, 12)
        # The small-sample factor scales both ends; it belongs to the estimate, not to the truth.
        _, low, high = hedges(float(stats.ttest_ind(a, b).statistic), 15, 12)
        factor = 1 - 3 / (4 * 25 - 1)
        hits += low <= delta * factor <= high
    assert 0.93 <= hits / rounds <= 0.97


def test_hedges_is_unbiased_and_mirrors() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.normal(1, 1, (4000, 6)), rng.normal(0, 1, (4000, 6))
    t = stats.ttest_ind(a, b, axis=1).statistic
    correction = hedges(1.0, 6, 6)[0]  # g is proportional to t
    assert abs((t * correction).mean() - 1.0) < 0.04
    g, low, high = hedges(2.5, 20, 18)
    assert hedges(-2.5, 20, 18) == pytest.approx((-g, -high, -low))
    # Zero lies on the interval's edge exactly if the test's p is 0.05.
    critical = float(stats.t.isf(0.025, 36))
    assert hedges(critical, 19, 19)[1] == pytest.approx(0, abs=1e-9)


def test_permutation_test_is_the_share_of_all_arrangements() -> None:
    x, y = np.array([3.0, 5.0, 9.0, 1.0]), np.array([2.0, 4.0, 4.0, 0.0])
    strata_x, strata_y = np.array(["a", "a", "b", "b"]), np.array(["a", "a", "b", "b"])
    a, b = np.array([3.0, 5, 2, 4]), np.array([9.0, 1, 4, 0])
    total, observed = a.sum() + b.sum(), abs(x.mean() - y.mean())
    extreme = [
        abs(
            (a[list(i)].sum() + b[list(j)].sum()) / 4
            - (total - a[list(i)].sum() - b[list(j)].sum()) / 4
        )
        >= observed - 1e-9
        for i in combinations(range(4), 2)
        for j in combinations(range(4), 2)
    ]
    exact = np.mean(extreme)
    found = stratified_permutation(x, y, strata_x, strata_y, seed=0, permutations=40_000)
    assert found == pytest.approx(exact, abs=0.012)


def test_permutation_test_does_not_take_a_type_for_an_effect() -> None:
    # Both conditions are alike within each type; only the types differ.
    values = np.array([10.0] * 8 + [0.0] * 2)
    other = np.array([10.0] * 2 + [0.0] * 8)
    strata = np.array(["a"] * 8 + ["b"] * 2), np.array(["a"] * 2 + ["b"] * 8)
    assert stratified_permutation(values, other, *strata, seed=0) == 1.0
    assert compare(values, other, list(strata[0]), list(strata[1]), 0)["student_p"] < 0.01


def test_a_group_without_spread_is_compared_without_a_warning() -> None:
    """By hand: means 6 and 3, pooled variance 1 / 2, error √(1 / 2 (1 / 3 + 1 / 3)) = √(1 / 3)."""
    found = compare([6, 6, 6], [2, 3, 4], ["a"] * 3, ["a"] * 3, 0)
    assert found["student_t"] == pytest.approx(3 * np.sqrt(3))
    assert found["student_df"] == 4


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
    bot["condition"] = "asking"
    return pd.DataFrame([*rows, bot])


def test_the_table_and_the_picture_are_what_scipy_computes_from_people_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    data, drawn, lines = completed(20), list[Figure](), io.StringIO()
    found = analyse(data, "person", {"conformant3": "was interrupted"})
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    draw(found, tmp_path / "measures.png")
    show(found, Console(file=lines, width=400))
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
        (line,) = (
            one for one in lines.getvalue().splitlines() if f" {TITLES[str(measure)]} " in one
        )
        cells = [f"{one.mean():.2f} ({one.std():.2f}), {len(one)}" for one in (a, b)]
        for p in (float(row[test]) for test in TESTS.values()):
            cells += ["–" if np.isnan(p) else "< 0.001" if p < 0.001 else f"{p:.3f}"]
        assert [cell.strip() for cell in re.split("[│┃]", line)[2:8]] == cells
    for axis, measure in zip(drawn[0].axes, MEASURES, strict=True):
        for name, (mean, _, (bar,)) in zip(paper_table(), axis.containers, strict=False):
            one = own.loc[own["condition"] == name, measure]
            ends = stats.t.interval(0.95, len(one) - 1, one.mean(), stats.sem(one))
            low, high = bar.get_segments()[0][:, 1]
            assert (*mean.get_ydata(), low, high) == pytest.approx((one.mean(), *ends))
            stars = [y for star in axis.lines for y in star.get_ydata()]
            assert paper_table().loc[measure, name] in stars
    assert list(found.measures.index)[:3] == list(paper_table().index)
    with pytest.raises(InputError, match="exclude"):
        analyse(data, "person", {"nobody": "x"})
    with pytest.raises(InputError, match="stream"):
        analyse(data, "people", {})


NO_STUDY = {
    "no file": (None, r"participants\.csv"),
    "no export": (pd.DataFrame({"a": [1], "b": [2]}), "lacks the column participant"),
    "nobody": (completed(1).iloc[:0], "stream"),
    "nobody in one condition": (completed(2).iloc[:2], "at least 2 completed"),
}


@pytest.mark.parametrize("found", NO_STUDY)
def test_what_is_no_study_is_refused(tmp_path: Path, found: str) -> None:
    data, said = NO_STUDY[found]
    if data is not None:
        data.to_csv(tmp_path / "participants.csv", index=False)
    with pytest.raises(InputError, match=said):
        analyse(read(tmp_path), "person", {})


def test_without_spread_in_time_there_is_no_t_test_but_no_failure(tmp_path: Path) -> None:
    completed(2).assign(interaction_time_s=5.0).to_csv(tmp_path / "participants.csv", index=False)
    time = analyse(read(tmp_path), "person", {}).measures.loc["interaction_time_s"]
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


def test_costs_and_questions_are_those_of_the_log(
    tmp_path: Path, run: Run, no_pictures: None
) -> None:
    """They are counted again from tables that do not use the states."""
    flow = street_study(ask=ASK | {"cost": 0.25}, **{"lambda": 1.5})
    path, out = tmp_path / "s.sqlite", tmp_path / "out"
    rngs, habits = map(np.random.default_rng, range(18)), Habits(label_noise=0.1, leaving=0.02)
    with closing(Store(path, flow)) as store:
        take_part(store, (StudyBot(flow.plan, habits, rng) for rng in rngs), "bot")
    run("study export", path, out)
    tables = {path.stem: pd.read_csv(path) for path in out.glob("*.csv")}
    events, questions = tables["events"], tables["questions"]
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
    said = tables["steps"]["messages"].str.count(r"[^;]+").fillna(0)
    told = said.groupby(tables["steps"]["participant"]).sum()
    cost = (1.5 * told + wrong + 0.25 * each)[done.index]
    assert done["cost"].to_numpy() == pytest.approx(cost.to_numpy())
    in_order = questions.dropna(subset=["label"]).sort_values(["participant", "number"])
    logged = answered.sort_values(["participant", "source_sequence"])
    assert [f'{{"label": {x:.0f}}}' for x in in_order["label"]] == logged["payload"].tolist()
    of_pages = tables["pages"][tables["pages"]["stage"] == "asking"]
    assert of_pages["seconds"].sum() == pytest.approx(questions["seconds"].sum(), rel=0.05)
    at = {"left_on": ["participant", "sequence"], "right_on": ["participant", "source_sequence"]}
    merged = of_pages[of_pages["seconds"].notna()].merge(logged, **at)
    steps = merged.sort_values(["participant", "sequence_x"])["step"]
    assert in_order["k"].tolist() == steps.tolist()
    shown = run("study analyse", out, "--stream", "bot")[1]
    assert "Questions between steps" in " ".join(shown.split())
    named = {*shown.splitlines()[-1].removesuffix(f" in {out}").split(", ")}
    made = {"table2.csv", "asking.csv", "measures.png", "asking.png"}
    assert made <= named <= {path.name for path in out.iterdir()}


def test_asking_is_compared_with_personalized_and_the_paper_s_table_stays() -> None:
    two, rng = completed(20).assign(questions_asked=0, cost=3.0), np.random.default_rng(5)
    third = two[two["condition"] == "personalized"].assign(
        condition="asking",
        participant=[f"asking{i}" for i in range(20)],
        questions_asked=rng.integers(1, 4, 20),
        quiz_score=rng.integers(2, 5, 20),
    )
    data = pd.concat([two, third], ignore_index=True)
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


RULES = {"per_cell": 7, "max_attempts": 3, "timeout_minutes": 45}
CHECK = {"name": "blue", "label": "Choose blue", "kind": "choice", "choices": ["red", "blue"]}


def test_the_document_says_what_the_plan_does(study: Study, tmp_path: Path, run: Run) -> None:
    belief = CONFIG["belief"] | {"accept": 0.8}
    plan = street_plan(rules=RULES, before=[CHECK | {"right": "blue"}], belief=belief)
    text = document(plan)
    for part in (
        plan.hash,
        "7 participants finish in each of 6 cells: 21 in each condition, 42 in total",
        "fail the check after the briefing 3 times",
        "45 minutes",
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
    promised = "with anything except|message again|messages_again|asking"
    assert not re.search(promised, document(street_plan()))
    # The command reads a study that was started.
    Store(tmp_path / "s.sqlite", study).close()
    assert run("study preregister", "s.sqlite", "--out", "p.md")[1] == "preregistration in p.md\n"
    written = (tmp_path / "p.md").read_text()
    assert run("study preregister", "s.sqlite")[1] == written == document(study.plan)
    assert "a study that was started" in run("study preregister", "none.sqlite")[2]
