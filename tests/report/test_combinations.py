"""What was swept is what is shown: tables, plots and CSV of sweeps whose numbers are known."""

from __future__ import annotations

import csv
import io
import itertools
import re

import numpy as np
import pytest
from scipy import stats

from tests.report import handmade
from xplain.report import comparison, console, sweep_plots
from xplain.report.combinations import differences_csv, regret_csv
from xplain.report.comparison import table as comparison_table
from xplain.report.layout import plot_layout, shown_keys, table_layout
from xplain.report.summary import Summary, is_number
from xplain.report.table import BEST, TIE
from xplain.report.write import write_report

MEASURES = (
    "regret",
    "above_floor",
    "cost",
    "messages",
    "inexplicable_labels",
    "oracle",
    "clairvoyant",
)


def product(**values):
    """Jobs of all combinations; ``users__count`` stands for ``users.count``."""
    keys = [key.replace("__", ".").replace("trade_off", "lambda") for key in values]
    return [
        dict(zip(keys, combination, strict=True))
        for combination in itertools.product(*(own.split(",") for own in values.values()))
    ]


def regret(values, trace):
    """Differs in every combination."""
    base = {"qmdp": 1.0, "qhr": 2.0, "baseline": 8.0}[values.get("solver", "qmdp")]
    more = 10 * float(values.get("users.count", 0)) + 100 * float(values.get("lambda", 0))
    noise = 3 * float(values.get("observers.label_noise", 0))
    method = {"kmeans": 0.0, "em": 0.25, "dirichlet": 0.5}[values.get("clusterer", "kmeans")]
    return base + more + noise + method + 0.125 * trace + 0.5 * int(values.get("seed", 0))


def rows(text):
    return list(csv.DictReader(io.StringIO(text)))


def summary_of(folder, jobs, **about):
    return Summary(handmade.sweep(folder, jobs, regret, **about))


def test_regret_csv_has_a_row_a_combination_and_the_columns_named(tmp_path):
    jobs = product(users__count="2,3,4", solver="qmdp,qhr", trade_off="0.5,1", seed="0,1,2")
    found = rows(regret_csv(summary_of(tmp_path, jobs)))
    assert list(found[0]) == [
        "solver",
        "lambda",
        "users.count",
        *(f"{name}_{end}" for name in MEASURES for end in ("mean", "low", "high", "n")),
    ]
    keys = [(row["solver"], row["lambda"], row["users.count"]) for row in found]
    assert sorted(keys) == sorted(itertools.product(("qmdp", "qhr"), ("0.5", "1"), "234"))
    for row in found:
        values = {key: row[key] for key in ("solver", "lambda", "users.count")}
        # By hand: seeds 0, 1, 2 shift the mean over traces 0 … 3 by 0, .5, 1.
        by_seed = [np.mean([regret(values, t) for t in range(4)]) + 0.5 * s for s in range(3)]
        half = stats.t.ppf(0.975, 2) * np.std(by_seed, ddof=1) / 3**0.5
        assert float(row["regret_mean"]) == pytest.approx(np.mean(by_seed), abs=1e-6)
        assert float(row["regret_high"]) == pytest.approx(np.mean(by_seed) + half, abs=1e-6)
        assert float(row["regret_low"]) == pytest.approx(np.mean(by_seed) - half, abs=1e-6)
        assert row["regret_n"] == row["cost_n"] == row["oracle_n"] == "3"
        assert float(row["cost_mean"]) == pytest.approx(
            float(row["regret_mean"]) + float(row["oracle_mean"]), abs=1e-6
        )
        assert (row["clairvoyant_mean"], row["clairvoyant_n"]) == ("", "0")


def test_with_one_seed_traces_are_the_replicates(tmp_path):
    (row,) = rows(regret_csv(summary_of(tmp_path, product(solver="qmdp"))))
    assert row["regret_n"] == "4"
    assert row["lambda"] == "1"


THREE = {
    "types and solvers": (
        product(users__count="2,3,4", solver="qmdp,qhr,baseline"),
        ("users.count",),
        [2.0, 3.0, 4.0],
        ("users.count", ("solver",)),
    ),
    "noise": (
        product(observers__label_noise="0,.02,.05"),
        ("observers.label_noise",),
        [0.0, 0.02, 0.05],
        ("observers.label_noise", ()),
    ),
    "clusterers": (
        product(clusterer="kmeans,em,dirichlet"),
        ("clusterer",),
        ["kmeans", "em", "dirichlet"],
        ("clusterer", ()),
    ),
}


@pytest.mark.parametrize("name", THREE)
def test_sweeps_of_one_or_two_keys_are_shown_by_these_keys(tmp_path, name):
    jobs, down, values, (x, lines) = THREE[name]
    summary = summary_of(tmp_path, jobs)
    table = comparison_table(summary)
    assert table.heads[: table.left] == down
    named = [cell.words for row in table.rows for cell in row[: table.left]]
    assert [float(word) if is_number(word) else word for word in named] == values
    shown = plot_layout(summary)
    assert (shown.x, shown.lines, shown.panels) == (x, lines, ())
    means = {round(cell.estimate.mean, 4) for row in table.rows for cell in row if cell.estimate}
    for job in jobs:
        assert round(np.mean([regret(job, t) for t in range(4)]), 4) in means
    figure = sweep_plots.against_main_key(summary, "regret", "regret")
    assert figure is not None
    ticks = {text.get_text() for text in figure.axes[0].get_xticklabels()}
    assert ticks == {f"{float(v):g}" if is_number(v) else v for v in {job[x] for job in jobs}}
    assert len(figure.axes[0].containers) == max(1, len({job.get("solver") for job in jobs}))


def test_a_third_key_makes_rows_and_panels_of_its_own(tmp_path):
    jobs = product(users__count="2,3,4", solver="qmdp,qhr", trade_off="0.5,1,2,3")
    summary = summary_of(tmp_path, jobs)
    table = comparison_table(summary)
    assert table.left == 2
    assert len(table.rows) == 12
    assert table.heads == ("users.count", "λ", "oracle's cost", "QMDP", "QHR")
    assert [row[0].words for row in table.body] == ["2", *[""] * 3, "3", *[""] * 3, "4", *[""] * 3]
    figure = sweep_plots.against_main_key(summary, "regret", "regret")
    assert [panel.get_title(loc="left") for panel in figure.axes] == [
        f"users.count = {count}" for count in (2, 3, 4)
    ]
    assert {len(panel.containers) for panel in figure.axes} == {2}
    limits = {panel.get_ylim() for panel in figure.axes}
    assert len(limits) == 1  # comparable


def test_two_ways_to_solve_go_across_and_a_third_goes_down(tmp_path):
    jobs = product(solver="qmdp,qhr", clusterer="kmeans,em", labeler="tree,pruned", trade_off="1,2")
    layout = table_layout(summary_of(tmp_path, jobs))
    assert len(layout.across) == 2
    assert layout.across[0] == "solver"
    assert layout.down[-1] == "lambda"


def test_a_key_that_another_decides_is_no_dimension_but_is_in_the_csv(tmp_path):
    jobs = [
        setting | {"solver": solver}
        for setting in ({"domain": "rescue"}, {"domain": "four_rooms", "users.count": "2"})
        for solver in ("qmdp", "qhr")
    ]
    summary = summary_of(tmp_path, jobs)
    assert shown_keys(summary) == ("domain", "solver")
    found = rows(regret_csv(summary))
    assert {(row["domain"], row["users.count"]) for row in found} == {
        ("rescue", ""),
        ("four_rooms", "2"),
    }


def test_only_what_the_sweep_file_names_is_pooled(tmp_path):
    jobs = product(users__count="2,4", solver="qmdp,qhr", trade_off="1,2")
    summary = summary_of(tmp_path, jobs, pool=["users.count"])
    table = comparison_table(summary)
    assert table.heads[: table.left] == ("λ",)
    # Between 2 and 4 types lie 20: their mean is that of 3 types.
    middle = np.mean([regret({"users.count": "3", "lambda": "1"}, t) for t in range(4)])
    assert table.rows[0][2].estimate.mean == pytest.approx(middle)
    assert "users.count" in table.caption
    assert len(rows(regret_csv(summary))) == 8


def test_the_best_of_a_row_and_what_cannot_be_told_from_it_are_marked(tmp_path):
    """Traces differ much, and the second solver is worse on all alike: told apart in pairs, where
    two intervals beside each other would overlap. The third is better on half of them."""
    lead = {"qmdp": lambda t: 0.0, "qhr": lambda t: 0.5, "baseline": lambda t: 0.5 - t % 2 * 0.9}
    folder = handmade.sweep(
        tmp_path,
        product(solver="qmdp,qhr,baseline", trade_off="1,2"),
        lambda values, trace: 10.0 * trace + lead[values["solver"]](trace),
    )
    summary = Summary(folder)
    for row in comparison_table(summary).rows:
        assert [cell.mark for cell in row[1:]] == ["", BEST, "", TIE]
    pairs = {(r["method"], r["minus"]): r for r in rows(differences_csv(summary))}
    assert float(pairs["qhr", "qmdp"]["low"]) == pytest.approx(0.5)
    assert float(pairs["baseline", "qmdp"]["low"]) < 0 < float(pairs["baseline", "qmdp"]["high"])


def test_one_trace_and_one_seed_have_no_intervals_and_say_so(tmp_path, capsys):
    folder = handmade.sweep(tmp_path, product(solver="qmdp,qhr"), regret, traces=1)
    console.print_sweep(Summary(folder))
    out = capsys.readouterr().out
    assert "±" not in out
    assert "no intervals" in out


def test_the_console_shows_every_number_of_the_table_with_its_headings(tmp_path, capsys):
    jobs = product(users__count="2,3", solver="qmdp,qhr", trade_off="0.5,1")
    summary = summary_of(tmp_path, jobs)
    console.print_sweep(summary)
    out = capsys.readouterr().out
    for job in jobs:
        assert f"{np.mean([regret(job, t) for t in range(4)]):.2f} ±" in out
    assert re.search(r"users\.count +λ +oracle's cost +QMDP +QHR", out)
    assert "paper" not in out.lower()


def test_only_a_reproduction_of_table_1_says_it_is_one(tmp_path):
    jobs = product(solver="qmdp,qhr", trade_off="0.5,1")
    for name, about in (("own", {}), ("table", {"report": "table1"})):
        folder = tmp_path / name
        handmade.sweep(folder, jobs, regret, **about)
        _, report = write_report(folder)
        page = (report / "index.html").read_text()
        assert ("Reproduction of Table 1" in page) == (name == "table")
        assert (report / "table1.md").exists() == (name == "table")
        assert (report / "regret.csv").exists()


def test_what_table_1_has_no_row_for_is_not_pooled_into_it(tmp_path):
    jobs = product(observers__label_noise="0,.02", solver="qmdp,qhr")
    summary = summary_of(tmp_path, jobs, report="table1", pool=["users.count"])
    assert summary.report is None
    assert comparison_table(summary).heads[0] == "observers.label_noise"


def test_a_way_that_sets_nothing_has_a_name(tmp_path):
    """One way of several has the defaults of all that the others set: it stands in heads, and in
    what costs least."""
    ways = [{}, {"belief.error": "learned"}, {"belief.accept": "learned"}]
    jobs = [way | {"domain": name} for name in ("rescue", "four_rooms") for way in ways]
    summary = summary_of(tmp_path, jobs)
    assert all(head.strip() for head in comparison_table(summary).heads)
    assert "defaults" in comparison_table(summary).heads
    parts = comparison.answer(summary).removeprefix("Least cost: ").split(";")
    assert all(not part.strip().startswith("in ") for part in parts)
