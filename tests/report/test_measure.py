"""Whoever costs least on the same problems is shown first, whatever was swept."""

from __future__ import annotations

import itertools
import math
import random
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.report import handmade
from xplain.errors import InputError
from xplain.experiment.results import Figure, load_results, save_results
from xplain.interaction.statistics import Estimate
from xplain.report.comparison import answer, main_table, seeds_to_decide, undecided, verdicts
from xplain.report.comparison import table as comparison_table
from xplain.report.console import print_sweep
from xplain.report.run_summary import print_summary
from xplain.report.summary import Summary
from xplain.report.table import BEST, TIE
from xplain.runs.mlflow import view

LEARNERS = {"tree": (8.8, 0.9), "practice": (8.5, 1.9), "hypotheses": (2.2, 1.3)}
"""The oracle's cost and the regret: who learns badly has an oracle that does so as well."""


def product(**values):
    keys = [key.replace("__", ".").replace("trade_off", "lambda") for key in values]
    return [
        dict(zip(keys, combination, strict=True))
        for combination in itertools.product(*(own.split(",") for own in values.values()))
    ]


def made(folder, jobs, oracle, regret, floor=lambda values, trace: 1.0 + trace, measure=None):
    """A sweep whose costs lie above the traces' own difficulty."""
    handmade.sweep(
        folder,
        jobs,
        lambda values, trace: regret(values) + 0.01 * trace,
        lambda values, trace: oracle(values) + trace,
        floor=floor,
    )
    return Summary(folder, measure)


def learned(folder, measure=None, floor=lambda values, trace: 1.0 + trace):
    jobs = product(labeler="tree,practice,hypotheses", seed="0,1,2")
    return made(
        folder,
        jobs,
        lambda values: LEARNERS[values["labeler"]][0],
        lambda values: LEARNERS[values["labeler"]][1],
        floor,
        measure,
    )


def first(summary):
    return next(main_table(summary).body)


def test_solvers_share_an_oracle_and_are_compared_by_regret(tmp_path):
    regrets = {"qmdp": 1.0, "qhr": 2.0, "baseline": 0.5}
    jobs = product(solver="qmdp,qhr,baseline", seed="0,1,2")
    summary = made(tmp_path, jobs, lambda v: 3.0, lambda v: regrets[v["solver"]])
    assert (summary.measure.name, summary.measure.fair) == ("regret", True)
    assert [row[0].words for row in main_table(summary).rows] == ["Baseline", "QMDP", "QHR"]
    assert "oracle's cost" in main_table(summary).heads
    assert answer(summary).startswith("Baseline costs least, 0.50 less than QMDP. Decided")


def test_learners_have_oracles_of_their_own_and_the_least_cost_wins(tmp_path):
    summary = learned(tmp_path)
    assert summary.measure.name == "above_floor"
    rows = main_table(summary).rows
    assert [row[0].words for row in rows] == ["hypotheses", "tree", "practice"]
    assert [row[1].mark for row in rows] == [BEST, "", ""]
    # Its cost less the floor's: 2.2 + 1.3 − 1, and what the regret has of four traces.
    assert rows[0][1].estimate.mean == pytest.approx(2.5 + 0.01 * 1.5)
    assert "labeler" in summary.measure.why
    assert "regret" not in main_table(summary).heads
    assert answer(summary).startswith(
        "labeler = hypotheses costs least, 6.20 less than labeler = tree"
    )


def test_mlflow_opens_on_the_same_winner(tmp_path):
    found = view("parent", learned(tmp_path))
    assert found["orderByKey"] == found["columnOrder"][0] == "metrics.`regret_to_clairvoyant`"
    assert found["orderByAsc"]
    assert "params.`labeler`" in found["columnOrder"]
    assert "params.`lambda`" not in found["columnOrder"]  # it was not swept


def test_noise_is_compared_by_what_noise_costs_not_by_a_worse_oracle(tmp_path):
    """The regret falls with noise, for the oracle gets worse; the cost rises."""
    jobs = product(observers__label_noise="0,0.2", solver="qmdp,qhr", seed="0,1,2")

    def oracle(values):
        return 2.0 + 10 * float(values["observers.label_noise"])

    def regret(values):
        return 2.0 - 5 * float(values["observers.label_noise"]) + (values["solver"] == "qhr")

    summary = made(tmp_path, jobs, oracle, regret)
    table = main_table(summary)
    assert summary.measure.name == "above_floor"
    assert table.heads == ("observers.label_noise", "clairvoyant's cost", "QMDP", "QHR")
    quiet, noisy = (row[2] for row in table.rows)
    assert quiet.estimate.mean < noisy.estimate.mean
    assert quiet.note == "cost 5.51"  # 2 + 2, the traces' 1.5, and a hundredth of it


def test_trade_offs_and_domains_pose_problems_of_their_own(tmp_path):
    """λ and the domain change costs and oracles: regrets are compared inside each, and no figure
    across them is called the best."""
    jobs = product(domain="rescue,four_rooms", trade_off="0.5,2", solver="qmdp,qhr", seed="0,1,2")

    def oracle(values):
        return float(values["lambda"]) * (5 if values["domain"] == "rescue" else 1)

    def regret(values):
        better = "qmdp" if values["domain"] == "rescue" else "qhr"
        return 1.0 + (values["solver"] != better)

    summary = made(tmp_path, jobs, oracle, regret, lambda v, t: 0.1 * oracle(v) + 0.1 * t)
    assert summary.measure.name == "regret"
    assert len(verdicts(summary)) == 4
    assert "QMDP in 2 of 4 problems (2 decided)" in answer(summary)
    found = view("parent", summary)
    assert found["orderByKey"] == "params.`lambda`"


def test_simulated_users_pose_problems_of_their_own(tmp_path):
    """Who errs costs more, whatever the explainer: nobody is crowned for having easy users."""
    jobs = product(explainee="exact,slips", belief__error="0,learned", seed="0,1,2")

    def regret(values):
        users = 4.0 if values["explainee"] == "slips" else 0.0
        return 1.0 + users * (1.0 if values["belief.error"] == "0" else 0.5)

    summary = made(tmp_path, jobs, lambda v: 3.0, regret)
    assert len(verdicts(summary)) == 2
    assert "in 1 of 2 problems" in answer(summary)


def test_where_the_clairvoyant_differs_as_well_the_cost_decides(tmp_path):
    """As with discounts: plans that discount otherwise have other references."""
    jobs = product(discount="0.9,0.95", seed="0,1")

    def shift(values):
        return 10 * float(values["discount"])

    summary = made(tmp_path, jobs, shift, lambda v: 1.0, lambda values, trace: shift(values) - 2)
    assert (summary.measure.name, summary.measure.reference) == ("cost", None)
    assert [row[0].words for row in main_table(summary).rows] == ["0.9", "0.95"]


def test_a_measure_that_is_asked_for_is_taken_and_one_that_is_unfair_says_so(tmp_path):
    summary = learned(tmp_path, "regret")
    table = main_table(summary)
    assert [row[0].words for row in table.rows] == ["tree", "hypotheses", "practice"]
    assert "Not a fair comparison" in table.caption
    assert not any(cell.mark in (BEST, TIE) for row in table.rows for cell in row if cell.mark)
    assert answer(summary) == ""
    (tmp_path / "cost").mkdir()
    assert first(learned(tmp_path / "cost", "cost"))[0].words == "hypotheses"
    with pytest.raises(InputError, match="measure='price': one of regret, above_floor, cost"):
        _ = learned(tmp_path / "none", "price").measure


def test_labels_of_unknown_people_have_no_oracle_and_no_regret(tmp_path):
    summary = learned(tmp_path)
    summary.episodes["oracle"] = np.nan
    assert summary.measure.name == "above_floor"
    assert "Not every job has an oracle" in summary.measure.why


def test_negative_regrets_are_explained_where_they_are_shown(tmp_path):
    jobs = product(solver="qmdp,qhr", seed="0,1,2")
    regrets = {"qmdp": -2.0, "qhr": 0.5}
    summary = made(tmp_path, jobs, lambda v: 3.0, lambda v: regrets[v["solver"]])
    assert "A regret below 0 is no error" in main_table(summary).caption


@pytest.mark.parametrize(("share", "told"), [(0.979, True), (0.98, False)])
def test_an_oracle_whose_labels_are_wrong_is_no_reference(tmp_path, share, told, capsys):
    jobs = product(solver="qmdp,qhr", seed="0,1,2")
    made(tmp_path, jobs, lambda v: 3.0, lambda v: 1.0 + (v["solver"] == "qhr"))
    for path in (tmp_path / "results").iterdir():
        own = load_results(path)
        figures = {"regret": Figure(1.0, None, None)}
        own = replace(own, learning={"fresh_accuracy": share}, metrics=figures)
        save_results(path, replace(own, config={**own.config, "traces": 1}))
    assert ("The oracle is no reference" in main_table(Summary(tmp_path)).caption) == told
    print_summary(load_results(path))
    assert ("The oracle is no reference" in capsys.readouterr().out) == told


def test_where_jobs_are_missing_the_order_is_that_of_the_differences(tmp_path):
    """QHR costs less in each seed, but the easy seeds of QMDP alone have finished besides: its mean
    over what has finished is smaller."""
    costs = {"qmdp": lambda seed: 10.3 - seed, "qhr": lambda seed: 10.0 - seed}
    jobs = product(solver="qmdp,qhr", seed="0,1,2,8,9")
    handmade.sweep(
        tmp_path,
        jobs,
        lambda values, trace: costs[values["solver"]](int(values["seed"])) + 0.01 * trace,
    )
    for seed in (8, 9):
        (tmp_path / "results" / f"solver=qhr,seed={seed}" / "results.json").unlink()
    summary = Summary(tmp_path)
    assert answer(summary).startswith("QHR costs least, 0.30 less than QMDP. Decided")
    rows = main_table(summary).rows
    assert [(row[0].words, row[1].mark) for row in rows] == [("QHR", BEST), ("QMDP", "")]
    assert rows[1][1].estimate.mean - rows[0][1].estimate.mean == pytest.approx(0.3)
    assert "for which all of them have results" in main_table(summary).caption


def test_ways_that_share_no_problem_are_not_ranked(tmp_path):
    jobs = product(solver="qmdp,qhr", seed="0,1")
    summary = made(tmp_path, jobs, lambda v: 3.0, lambda v: 1.0 + (v["solver"] == "qhr"))
    for lost in ("solver=qmdp,seed=1", "solver=qhr,seed=0"):
        (tmp_path / "results" / lost / "results.json").unlink()
    summary = Summary(tmp_path)
    assert (answer(summary), verdicts(summary)) == ("", [])
    assert {cell.mark for row in main_table(summary).rows for cell in row} == {""}


@pytest.mark.parametrize("number", range(5))
def test_the_first_is_the_cheapest_on_the_same_problems_whatever_the_references(tmp_path, number):
    """Oracles at random, shared or not: the order is that of mean costs."""
    draw = random.Random(number)
    names = ("qmdp", "qhr", "pomcp")
    oracle = {name: draw.choice([2.0, draw.uniform(1, 9)]) for name in names}
    regret = {name: draw.uniform(-2, 4) for name in names}
    summary = made(
        tmp_path,
        product(solver=",".join(names), seed="0,1"),
        lambda v: oracle[v["solver"]],
        lambda v: regret[v["solver"]],
    )
    costs = {name: oracle[name] + regret[name] for name in names}
    (found,) = verdicts(summary)
    assert [one.way[0] for one in found.order] == sorted(costs, key=lambda name: costs[name])
    assert comparison_table(summary).rows[0][0].words


@given(
    mean=st.floats(0.05, 5),
    deviation=st.floats(0.1, 2),
    seeds=st.integers(2, 30),
)
@settings(max_examples=40, deadline=None)
def test_so_many_seeds_decide_and_fewer_do_not(mean: float, deviation: float, seeds: int) -> None:
    """Against the interval that so many seeds of the same spread have."""

    def half(count: int, level: float) -> float:
        return float(scipy.stats.t.ppf(level, count - 1)) * deviation / math.sqrt(count)

    own = half(seeds, 0.975)
    found = seeds_to_decide(Estimate(mean, mean - own, mean + own), seeds)
    assume(found is not None)
    assert found is not None
    assert half(found, 0.975) + half(found, 0.8) <= mean * (1 + 1e-9)
    if found > seeds:
        assert half(found - 1, 0.975) + half(found - 1, 0.8) > mean * (1 - 1e-9)
    assert seeds_to_decide(Estimate(-mean, -mean - own, -mean + own), seeds) == found


def test_what_these_seeds_cannot_say_is_not_said() -> None:
    assert seeds_to_decide(Estimate(0.0, -1.0, 1.0), 5) is None  # no difference
    assert seeds_to_decide(Estimate(1.0, math.nan, math.nan), 1) is None  # one seed
    assert seeds_to_decide(Estimate(0.001, -9.0, 9.0), 5) is None  # too many


def test_each_difference_that_is_not_decided_has_its_seeds_and_the_command(tmp_path, capsys):
    jobs = product(solver="qmdp,qhr,baseline", seed="0,1,2")
    own = {"qmdp": 1.0, "qhr": 1.1, "baseline": 9.0}
    noise = {"0": 0.5, "1": -0.4, "2": 0.1}

    def regret(values):
        return own[values["solver"]] + (values["solver"] == "qhr") * noise[values["seed"]]

    summary = made(tmp_path, jobs, lambda v: 3.0, regret)
    table = undecided(summary)
    (row,) = table.rows  # the baseline's difference is decided
    assert row[0].words == "QHR − QMDP"
    assert int(row[-2].words) > 3
    assert table.caption.endswith("python -m xplain 'seed=range(N)'")
    print_sweep(summary)
    assert "1 undecided difference: the report says" in capsys.readouterr().out
