"""Tables show the swept values, and the solver with the lowest cost on the same problems is
first."""

import csv
import io
import itertools
import math
import random
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import scipy.stats
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.report import handmade
from xplain.errors import InputError
from xplain.experiment.results import Figure, load_results, save_results
from xplain.interaction.statistics import Estimate
from xplain.report import plots
from xplain.report.claims import answer, list_undecided
from xplain.report.compare import (
    differences_csv,
    effort,
    regret_csv,
    seeds_to_decide,
    table,
    verdicts,
)
from xplain.report.frame import TITLES, Summary
from xplain.report.table import BEST, TIE
from xplain.report.terminal import print_summary, print_sweep
from xplain.runs.mlflow import view

LEARNERS = {"tree": (8.8, 0.9), "practice": (8.5, 1.9), "hypotheses": (2.2, 1.3)}
"""The oracle's cost and the regret: bad learning also gives a bad oracle."""


def product(**values):
    """Lists jobs of all combinations; ``users__count`` means ``users.count``."""
    keys = [key.replace("__", ".").replace("trade_off", "lambda") for key in values]
    return [
        dict(zip(keys, combination, strict=True))
        for combination in itertools.product(*(own.split(",") for own in values.values()))
    ]


def made(folder, jobs, oracle, regret, floor=lambda values, trace: 1.0 + trace, measure=None):
    """Makes a sweep with costs above the traces' own difficulty."""
    handmade.sweep(
        folder,
        jobs,
        lambda values, trace: regret(values) + 0.01 * trace,
        lambda values, trace: oracle(values) + trace,
        floor=floor,
    )
    return Summary(folder, measure)


def learned(folder, measure=None):
    jobs = product(labeler="tree,practice,hypotheses", seed="0,1,2")
    oracle, regret = (lambda values, i=i: LEARNERS[values["labeler"]][i] for i in (0, 1))
    return made(folder, jobs, oracle, regret, measure=measure)


def distinct(values, trace):
    """Computes a regret that differs in every combination."""
    base = {"qmdp": 1.0, "qhr": 2.0, "baseline": 8.0}[values.get("solver", "qmdp")]
    more = 10 * float(values.get("users.count", 0)) + 100 * float(values.get("lambda", 0))
    noise = 3 * float(values.get("observers.label_noise", 0))
    method = {"kmeans": 0.0, "em": 0.25, "dirichlet": 0.5}[values.get("clusterer", "kmeans")]
    return base + more + noise + method + 0.125 * trace + 0.5 * int(values.get("seed", 0))


def summary_of(folder, jobs, **about):
    return Summary(handmade.sweep(folder, jobs, distinct, **about))


def rows(text):
    return list(csv.DictReader(io.StringIO(text)))


def order(summary):
    """Returns the names of the ways of the only problem, the lowest cost first."""
    ((_, ways),) = verdicts(summary)
    return [way.name.rpartition(" = ")[2] for way in ways]


def test_learners_have_oracles_of_their_own_and_the_least_cost_wins(tmp_path):
    summary = learned(tmp_path)
    assert summary.measure.name == "above_floor"
    assert order(summary) == ["hypotheses", "tree", "practice"]
    ((_, _, *cells),) = table(summary).frame.to_numpy()
    assert [BEST in own for own in cells] == [False, False, True]
    # Its cost less the floor's: 2.2 + 1.3 − 1, and what the regret has of four traces.
    assert cells[2].startswith(f"{2.5 + 0.01 * 1.5:.2f}")
    why = summary.measure.why
    assert ("Regrets are not" in why, "clairvoyant's costs differ" in why) == (True, False)
    best = "labeler = hypotheses costs least, 6.20 less than labeler = tree"
    assert answer(summary).startswith(best)
    found = view("parent", summary)  # MLflow opens on the same winner
    assert found["orderByKey"] == found["columnOrder"][0] == "metrics.`regret_to_clairvoyant`"
    assert "params.`labeler`" in found["columnOrder"]
    assert "params.`lambda`" not in found["columnOrder"]  # it was not swept


def test_noise_is_compared_by_what_noise_costs_not_by_a_worse_oracle(tmp_path):
    """The regret falls with noise, because the oracle gets worse; the cost rises."""
    jobs = product(observers__label_noise="0,0.2", solver="qmdp,qhr", seed="0,1,2")
    summary = made(
        tmp_path,
        jobs,
        lambda v: 2.0 + 10 * float(v["observers.label_noise"]),
        lambda v: 2.0 - 5 * float(v["observers.label_noise"]) + (v["solver"] == "qhr"),
    )
    assert summary.measure.name == "above_floor"
    heads = ["observers.label_noise", "clairvoyant's cost", "QMDP", "QHR"]
    assert list(table(summary).frame) == heads
    quiet, noisy = table(summary).frame["QMDP"]
    assert float(quiet.split()[0]) < float(noisy.split()[0])
    assert quiet.endswith("\ncost 5.51")  # 2 + 2, the traces' 1.5, and a hundredth of it


def test_trade_offs_and_domains_pose_problems_of_their_own(tmp_path):
    """λ and the domain change costs and oracles: regrets are compared only for equal values, and no
    figure across them is marked as the best."""
    jobs = product(domain="rescue,four_rooms", trade_off="0.5,2", solver="qmdp,qhr", seed="0,1,2")

    def oracle(values):
        return float(values["lambda"]) * (5 if values["domain"] == "rescue" else 1)

    summary = made(
        tmp_path,
        jobs,
        oracle,
        lambda v: 1.0 + ((v["solver"] == "qmdp") != (v["domain"] == "rescue")),
        lambda v, t: 0.1 * oracle(v) + 0.1 * t,
    )
    assert summary.measure.name == "regret"
    assert len(verdicts(summary)) == 4
    assert "QMDP in 2 of 4 problems (2 decided)" in answer(summary)
    assert view("parent", summary)["orderByKey"] == "params.`lambda`"


def test_where_the_clairvoyant_differs_as_well_the_cost_decides(tmp_path):
    """Discounts are an example: plans with another discount have other references."""

    def shift(values):
        return 10 * float(values["discount"])

    jobs = product(discount="0.9,0.95", seed="0,1")
    summary = made(tmp_path, jobs, shift, lambda v: 1.0, lambda values, trace: shift(values) - 2)
    assert summary.measure.name == "cost"
    assert order(summary) == ["0.9", "0.95"]


def test_a_measure_that_is_asked_for_is_taken_and_one_that_is_unfair_says_so(tmp_path):
    summary = learned(tmp_path, "regret")
    assert table(summary).about.startswith("Regret: ")
    assert "Not a fair comparison" in table(summary).caption
    assert not re.search(f"[{BEST}{TIE}]", str(table(summary).frame))
    assert answer(summary) == ""
    assert order(Summary(tmp_path, "cost"))[0] == "hypotheses"
    with pytest.raises(InputError, match="measure='price': one of regret, above_floor, cost"):
        Summary(tmp_path, "price")


@pytest.mark.parametrize(("share", "told"), [(0.979, True), (0.98, False)])
def test_an_oracle_whose_labels_are_wrong_is_no_reference(tmp_path, share, told, capsys):
    jobs = product(solver="qmdp,qhr", seed="0,1,2")
    made(tmp_path, jobs, lambda v: 3.0, lambda v: (v["solver"] == "qhr") - 0.25)
    for path in (tmp_path / "results").iterdir():
        own = load_results(path)
        figures = {"regret": Figure(-0.25, None, None)}
        own = replace(own, learning={"fresh_accuracy": share}, metrics=figures)
        save_results(path, replace(own, config={**own.config, "traces": 1}))
    print_sweep(Summary(tmp_path))
    print_summary(load_results(path))
    sweep, run = (" ".join(own.split()) for own in capsys.readouterr().out.split("rescue · "))
    for text in (sweep, run):
        assert ("The oracle is no reference" in text) == ("†" in text) == told
        assert "A regret below 0 is no error" in text  # wherever one is


def test_where_jobs_are_missing_the_order_is_that_of_the_differences(tmp_path):
    """QHR costs less for each seed, but only QMDP has finished the easy seeds, so QMDP's mean over
    finished jobs is smaller."""
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
    said = "QHR costs least, 0.30 less than QMDP. Decided: 95 % interval of the difference 0.30 …"
    assert answer(summary) == f"{said} 0.30."
    assert order(summary) == ["QHR", "QMDP"]
    cells = table(summary).frame.iloc[0]
    assert float(cells["QMDP"].split()[0]) - float(cells["QHR"].split()[0]) == pytest.approx(0.3)
    assert "on traces and users that all of them have" in table(summary).caption


def test_equal_costs_are_both_the_best_and_names_are_no_markup(tmp_path, capsys):
    jobs = product(solver="qmdp,[b]mine", seed="0,1")
    summary = made(tmp_path, jobs, lambda v: 3.0, lambda v: 1.0)
    said = "QMDP costs least, as does [b]mine."
    assert answer(summary) == said
    assert all(BEST in own for own in table(summary).frame.iloc[0, -2:])
    print_sweep(summary)
    assert said in capsys.readouterr().out


def test_ways_that_share_no_problem_are_not_ranked(tmp_path):
    jobs = product(solver="qmdp,qhr", seed="0,1")
    made(tmp_path, jobs, lambda v: 3.0, lambda v: 1.0 + (v["solver"] == "qhr"))
    for lost in ("solver=qmdp,seed=1", "solver=qhr,seed=0"):
        (tmp_path / "results" / lost / "results.json").unlink()
    summary = Summary(tmp_path)
    assert (answer(summary), verdicts(summary)) == ("", [])
    assert not re.search(f"[{BEST}{TIE}]", str(table(summary).frame))


@pytest.mark.parametrize("number", range(5))
def test_the_first_is_the_cheapest_on_the_same_problems_whatever_the_references(tmp_path, number):
    """Oracles are random, shared or not; solvers are in the order of mean costs."""
    draw = random.Random(number)
    names = ("qmdp", "qhr", "pomcp")
    oracle = {name: draw.choice([2.0, draw.uniform(1, 9)]) for name in names}
    regret = {name: draw.uniform(-2, 4) for name in names}
    jobs = product(solver=",".join(names), seed="0,1")
    summary = made(tmp_path, jobs, lambda v: oracle[v["solver"]], lambda v: regret[v["solver"]])
    ((_, order),) = verdicts(summary)
    costs = {name: oracle[name] + regret[name] for name in names}
    assert [one.values["solver"] for one in order] == sorted(costs, key=lambda name: costs[name])


def test_the_best_of_a_row_and_what_cannot_be_told_from_it_are_marked(tmp_path):
    """Traces differ much, and the second solver is equally worse on all of them: paired differences
    show this, although the two intervals overlap. The third solver is better on half of the
    traces."""
    lead = {"qmdp": lambda t: 0.0, "qhr": lambda t: 0.5, "baseline": lambda t: 0.5 - t % 2 * 0.9}
    folder = handmade.sweep(
        tmp_path,
        product(solver="qmdp,qhr,baseline", trade_off="1,2"),
        lambda values, trace: 10.0 * trace + lead[values["solver"]](trace),
    )
    summary = Summary(folder)
    for mark, head in (("", "QHR"), (BEST, "QMDP"), (TIE, "Baseline")):
        for own in table(summary).frame[head]:
            assert own.splitlines()[0].lstrip("0123456789.± ") == mark
    pairs = {(r["method"], r["minus"]): r for r in rows(differences_csv(summary))}
    assert float(pairs["qhr", "qmdp"]["low"]) == pytest.approx(0.5)
    assert float(pairs["baseline", "qmdp"]["low"]) < 0 < float(pairs["baseline", "qmdp"]["high"])


def half(count: int, level: float, deviation: float) -> float:
    return float(scipy.stats.t.ppf(level, count - 1)) * deviation / math.sqrt(count)


@given(mean=st.floats(0.05, 5), deviation=st.floats(0.1, 2), seeds=st.integers(2, 30))
@settings(max_examples=40, deadline=None)
def test_so_many_seeds_decide_and_fewer_do_not(mean: float, deviation: float, seeds: int) -> None:
    """The number is compared with the interval of this number of seeds with the same variance."""
    own = half(seeds, 0.975, deviation)
    found = seeds_to_decide(Estimate(mean, mean - own, mean + own), seeds)
    assert (found is None) == (half(1000, 0.975, deviation) + half(1000, 0.8, deviation) > mean)
    assume(found is not None)
    assert half(found, 0.975, deviation) + half(found, 0.8, deviation) <= mean * (1 + 1e-9)
    if found > seeds:
        fewer = half(found - 1, 0.975, deviation) + half(found - 1, 0.8, deviation)
        assert fewer > mean * (1 - 1e-9)
    assert seeds_to_decide(Estimate(-mean, -mean - own, -mean + own), seeds) == found


@pytest.mark.parametrize(
    ("gap", "seeds", "needed"),
    [
        ((0.0, -1.0, 1.0), 5, ("more than 1000", "")),
        ((1.0, math.nan, math.nan), 1, ("seed='range(5)'", "4.0")),
        ((0.001, -9.0, 9.0), 5, ("more than 1000", "")),
    ],
    ids=["no difference", "one seed", "too many"],
)
def test_what_these_seeds_cannot_say_is_not_said(
    gap: tuple[float, ...], seeds: int, needed: tuple[str, str]
) -> None:
    assert seeds_to_decide(Estimate(*gap), seeds) is None
    jobs = [("", SimpleNamespace(seconds={"learn": 20.0, "explain": 40.0}))] * seeds
    assert effort(cast(Any, SimpleNamespace(seeds=seeds, results=jobs)), Estimate(*gap)) == needed


def test_each_difference_that_is_not_decided_has_its_seeds_and_minutes(tmp_path, capsys):
    jobs = product(solver="qmdp,qhr,baseline", seed="0,1,2")
    own = {"qmdp": 1.0, "qhr": 1.1, "baseline": 9.0}
    noise = {"0": 0.5, "1": -0.4, "2": 0.1}
    made(
        tmp_path,
        jobs,
        lambda v: 3.0,
        lambda v: own[v["solver"]] + (v["solver"] == "qhr") * noise[v["seed"]],
    )
    for path in (tmp_path / "results").iterdir():  # 9 jobs of 20 s: a minute each seed
        save_results(path, replace(load_results(path), seconds={"explain": 20.0}))
    summary = Summary(tmp_path)
    shown = list_undecided(summary)
    ((way, _, seeds, minutes),) = shown.frame.to_numpy()  # the baseline's difference is decided
    assert (way, shown.left) == ("QHR − QMDP", 1)
    assert answer(summary).endswith("With only 3 seeds, only large differences can be decided.")
    (count,) = re.fullmatch(r"seed='range\((\d+)\)'", seeds).groups()
    assert float(minutes) == int(count) - 3 > 0
    assert shown.caption.endswith("python -m xplain SEEDS")
    print_sweep(summary)
    assert "1 undecided difference: the report says" in capsys.readouterr().out


def test_regret_csv_has_a_row_a_combination_and_the_columns_named(tmp_path):
    jobs = product(users__count="2,3,4", solver="qmdp,qhr", trade_off="0.5,1", seed="0,1,2")
    found = rows(regret_csv(summary_of(tmp_path, jobs)))
    measures = [name for name in TITLES if name != "questions"]  # none were asked
    ends = [f"{name}_{end}" for name in measures for end in ("mean", "low", "high", "n")]
    assert list(found[0]) == ["solver", "lambda", "users.count", *ends]
    keys = [(row["solver"], row["lambda"], row["users.count"]) for row in found]
    assert sorted(keys) == sorted(itertools.product(("qmdp", "qhr"), ("0.5", "1"), "234"))
    for row in found:
        values = {key: row[key] for key in ("solver", "lambda", "users.count")}
        # By hand: seeds 0, 1, 2 shift the mean over traces 0 … 3 by 0, 0.5, 1.
        by_seed = [np.mean([distinct(values, t) for t in range(4)]) + 0.5 * s for s in range(3)]
        width = half(3, 0.975, np.std(by_seed, ddof=1))
        assert float(row["regret_mean"]) == pytest.approx(np.mean(by_seed), abs=1e-6)
        assert float(row["regret_high"]) - np.mean(by_seed) == pytest.approx(width, abs=1e-6)
        assert (row["regret_n"], row["clairvoyant_mean"], row["clairvoyant_n"]) == ("3", "", "0")


THREE = {
    "types and solvers": (
        product(users__count="2,3,4", solver="qmdp,qhr,baseline"),
        ["2", "3", "4"],
        ("users.count", ["solver"]),
    ),
    "noise": (
        product(observers__label_noise="0,.02,.05"),
        ["0", "0.02", "0.05"],
        ("observers.label_noise", []),
    ),
    "clusterers": (
        product(clusterer="kmeans,em,dirichlet"),
        ["kmeans", "em", "dirichlet"],
        ("clusterer", []),
    ),
}


@pytest.mark.parametrize("name", THREE)
def test_sweeps_of_one_or_two_keys_are_shown_by_these_keys(tmp_path, name):
    jobs, values, (x, lines) = THREE[name]
    summary = summary_of(tmp_path, jobs)
    shown = table(summary).frame
    heads = shown[x].tolist() if x in shown else [*shown][2:]
    assert [head.rpartition(" = ")[2] for head in heads] == values
    assert plots.plot_keys(summary) == (x, lines, [])
    assert (BEST in table(summary).caption) == (name != "noise")  # it is no way to solve a problem
    assert "that all of them have" not in table(summary).caption
    means = " ".join(shown.to_numpy().ravel())
    for job in jobs:
        assert f"{np.mean([distinct(job, t) for t in range(4)]):.2f}" in means
    (axes,) = plots.against_main_key(summary, "regret").axes
    ticks = [text.get_text() for text in axes.get_xticklabels() if not text.get_rotation()]
    places = range(3) if x == "clusterer" else map(float, values)  # numbers are at their places
    assert [*zip(ticks, axes.get_xticks(), strict=True)] == [*zip(values, places, strict=True)]
    assert len(axes.containers) == max(1, len({job.get("solver") for job in jobs}))


@pytest.mark.parametrize(
    ("key", "values", "shown", "number"),
    [
        ("users__count", "1,2,3,4,5", "users.count = 3", 3),
        ("trade_off", "2,3,4,5,6", "λ = 4", 4),
        ("trade_off", "0.5,1,2,3,4", "λ = 1", 1),
    ],
)
def test_the_belief_is_drawn_for_one_value_which_is_named(tmp_path, key, values, shown, number):
    jobs = product(**{key: values}, seed="0,1")
    (axes,) = plots.belief_over_steps(summary_of(tmp_path, jobs)).axes
    assert axes.get_ylabel() == f"belief in the true type, {shown}"
    # The second seed has half as many episodes of the last step.
    last = (2 * 0.9 + 0.7) / 3 - 0.01 * number
    (drawn,) = axes.containers
    np.testing.assert_allclose(drawn.lines[0].get_xydata(), [(0, 0.5), (1, 0.8), (2, last)])


@pytest.mark.parametrize(
    ("keys", "rows"),
    [
        ({"solver": "qmdp,qhr", "labeler": "a,b,c,d"}, ["Domain"]),
        ({"solver": "qmdp,qhr,baseline", "labeler": "a,b,c"}, ["labeler"]),
        ({"solver": "qmdp,qhr", "labeler": "a,b", "clusterer": "kmeans,em"}, ["clusterer"]),
    ],
)
def test_columns_are_at_most_eight_and_of_two_keys(tmp_path, keys, rows):
    shown = table(summary_of(tmp_path, product(**keys)))
    assert list(shown.frame)[: shown.left] == rows


def test_a_third_key_makes_rows_and_panels_of_its_own(tmp_path):
    jobs = product(users__count="2,3,4", solver="qmdp,qhr", trade_off="0.5,1,2,3")
    summary = summary_of(tmp_path, jobs)
    shown = table(summary)
    assert list(shown.frame) == ["users.count", "λ", "oracle's cost", "QMDP", "QHR"]
    heads = ["2", *[""] * 3, "3", *[""] * 3, "4", *[""] * 3]
    assert (shown.left, shown.sparse["users.count"].tolist()) == (2, heads)
    figure = plots.against_main_key(summary, "regret")
    titles = [panel.get_title(loc="left") for panel in figure.axes]
    assert titles == [f"users.count = {count}" for count in (2, 3, 4)]
    for count, panel in zip("234", figure.axes, strict=True):
        for solver, line in zip(("qmdp", "qhr"), panel.containers, strict=True):
            values = {"users.count": count, "solver": solver}
            means = [distinct(values | {"lambda": at}, 1.5) for at in (0.5, 1, 2, 3)]
            near = np.abs(line.lines[0].get_xydata() - [*zip((0.5, 1, 2, 3), means, strict=True)])
            assert (near < (0.05, 1e-9)).all()
    assert len({(panel.get_ylim(), panel.bbox.y0) for panel in figure.axes}) == 1  # comparable


def test_a_key_that_another_decides_is_no_dimension_but_is_in_the_csv(tmp_path):
    jobs = [
        setting | {"solver": solver}
        for setting in ({"domain": "rescue"}, {"domain": "four_rooms", "users.count": "2"})
        for solver in ("qmdp", "qhr")
    ]
    summary = summary_of(tmp_path, jobs)
    assert summary.shown == ["domain", "solver"]
    posed = product(domain="rescue,four_rooms", trade_off="1,2")
    assert plots.plot_keys(summary_of(tmp_path / "posed", posed)) == ("lambda", [], ["domain"])
    assert summary.values("users.count") == ["", 2.0]  # what is not set comes first
    found = {(row["domain"], row["users.count"]) for row in rows(regret_csv(summary))}
    assert found == {("rescue", ""), ("four_rooms", "2")}


def test_only_what_the_sweep_file_names_is_pooled(tmp_path):
    jobs = product(users__count="2,4", solver="qmdp,qhr", trade_off="1,2")
    summary = summary_of(tmp_path, jobs, pool=["users.count"])
    shown = table(summary)
    assert next(iter(shown.frame)) == "λ"
    # Between 2 and 4 types lie 20: their mean is that of 3 types.
    middle = np.mean([distinct({"users.count": "3", "lambda": "1"}, t) for t in range(4)])
    assert shown.frame["QMDP"][0].startswith(f"{middle:.2f}")
    assert "users.count" in shown.caption
    assert len(rows(regret_csv(summary))) == 8


def test_one_trace_and_one_seed_have_no_intervals_and_say_so(tmp_path, capsys):
    folder = handmade.sweep(tmp_path, product(solver="qmdp,qhr"), distinct, traces=1)
    print_sweep(Summary(folder))
    out = " ".join(capsys.readouterr().out.split())
    assert "no intervals" in out
    assert "±" not in out


def test_a_way_that_sets_nothing_has_a_name(tmp_path):
    """One of several ways has the default of every swept key. This way has a name in headings, and
    in the sentence about the lowest cost."""
    ways = [{}, {"belief.error": "learned"}, {"belief.accept": "learned"}]
    jobs = [way | {"domain": name} for name in ("rescue", "four_rooms") for way in ways]
    summary = summary_of(tmp_path, jobs)
    heads = list(table(summary).frame)
    assert "defaults" in heads
    assert all(head.strip() for head in heads)
    parts = answer(summary).split("Least cost: ")[1].split(";")
    assert all(not part.strip().startswith("in ") for part in parts)
