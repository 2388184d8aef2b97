"""Files on disk are complete, or do not exist."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.handmade import a_prepared, an_episode
from xplain.experiment.results import (
    Provenance,
    episode_lines,
    find_finished,
    load_results,
    results_of,
    save_results,
)
from xplain.interaction.metrics import Record, summarise
from xplain.interaction.statistics import Estimate

PREPARED = a_prepared(steps=(2, 3))
RNG = np.random.default_rng(1)
RECORDS = [
    Record(solver, trace, user, PREPARED.matched_true_type == PREPARED.distinct[user], episode)
    for solver in ("solver", "oracle", "clairvoyant")
    for trace, steps in enumerate((2, 3))
    for user in range(3)
    for episode in [an_episode(RNG, steps)]
]
ABOUT = Provenance(
    name="by hand",
    fingerprint="f1",
    worker="here 1",
    xplain="0",
    code="c0de",
    git={},
    started=1.5,
    seconds={"explain": 0.25},
    choices={"domain": "made", "solver": "qmdp"},
    config={"lambda": 1.0, "seed": 4},
)


def on_disk(folder):
    """Returns the content that other programs read."""
    return json.loads((folder / "results.json").read_text(encoding="utf-8"))


@pytest.fixture
def results(tmp_path):
    """Returns the results read from the disk."""
    save_results(tmp_path, results_of(PREPARED, RECORDS, ABOUT))
    return on_disk(tmp_path)


def test_what_is_saved_is_loaded(tmp_path):
    results = results_of(PREPARED, RECORDS, ABOUT)
    save_results(tmp_path, results)
    assert load_results(tmp_path) == results
    certified = replace(results, bounds={"optimal_lower": -2.5}, certificates="made")
    save_results(tmp_path, certified)
    assert load_results(tmp_path) == certified


def test_what_is_at_an_address_is_finished_where_it_is_whole_and_belongs_there(tmp_path):
    address = tmp_path / "f1"
    address.mkdir()
    assert find_finished(address) is None
    results = results_of(PREPARED, RECORDS, ABOUT)
    for certificates in ("not asked for", "made"):
        save_results(address, replace(results, certificates=certificates))
        assert find_finished(address) is not None
    save_results(address, replace(results, certificates="failed"))
    assert find_finished(address) is None  # what was asked for may come next time
    save_results(address, replace(results, fingerprint="f2"))
    assert find_finished(address) is None
    save_results(address, replace(results, schema=0))
    assert find_finished(address) is None


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"metrics": '])
def test_what_holds_no_results_is_refused(tmp_path, text):
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(ValueError):  # noqa: PT011  (JSON's own, or ours)
        load_results(tmp_path)


def test_every_episode_is_there_with_its_figures(results):
    assert len(results["episodes"]) == len(RECORDS) == 18
    for row, record in zip(results["episodes"], RECORDS, strict=True):
        episode = record.episode
        triangle = [row[: k + 1].tolist() for k, row in enumerate(episode.labels)]
        belief = episode.beliefs[:, [0, 1, 1][record.user_type]]
        assert row == {
            "solver": record.solver,
            "trace": record.trace,
            "type": f"T{record.user_type + 1}",
            "cost": episode.cost,
            "communication": episode.communication,
            "inexplicability": episode.inexplicability,
            "messages": sum(bin(mask).count("1") for mask in episode.messages.tolist()),
            "inexplicable_labels": sum(labels.count(0) for labels in triangle),
            "questions": 0,
            "questions_cost": 0.0,
            "fit": episode.fit,
            "steps_until_sure": next((k for k, b in enumerate(belief) if b > 0.9), len(belief)),
        }


def test_metrics_are_the_summary_with_its_intervals(results):
    summary = summarise(RECORDS)
    assert results["metrics"].keys() == summary.keys()
    for name, found in results["metrics"].items():
        assert Estimate(**found) == summary[name]
        assert found["low"] <= found["mean"] <= found["high"]
    costs = [row["cost"] for row in results["episodes"] if row["solver"] == "solver"]
    assert results["metrics"]["cost"]["mean"] == pytest.approx(np.mean(costs))


def test_an_interval_that_is_unknown_is_null(tmp_path):
    records = [record for record in RECORDS if record.trace == 0]
    save_results(tmp_path, results_of(PREPARED, records, ABOUT))
    found = on_disk(tmp_path)["metrics"].values()
    assert {(one["low"], one["high"], one["mean"] is None) for one in found} == {
        (None, None, False)
    }


def test_a_line_tells_an_episode_step_by_step():
    lines = episode_lines(PREPARED, RECORDS).splitlines()
    assert len(lines) == len(RECORDS)
    names = {0: [], 1: ["a"], 2: ["b"], 3: ["a", "b"]}
    for line, record in zip(map(json.loads, lines), RECORDS, strict=True):
        episode, case = record.episode, PREPARED.cases[record.trace]
        assert (
            line
            == {  # a map shows what changes
                "solver": record.solver,
                "trace": record.trace,
                "type": PREPARED.types[record.user_type],
                "cost": episode.cost,
                "transitions": list(case.phrases),
                "positions": [list(cell) for cell in case.positions],
                "prior": episode.beliefs[0].tolist(),
                "steps": [
                    {
                        "messages": names[int(episode.messages[k])],
                        "labels": episode.labels[k, : k + 1].tolist(),
                        # The belief after the answer to this step.
                        "belief": pytest.approx(episode.beliefs[k + 1], abs=1e-12),
                    }
                    for k in range(len(case.transitions))
                ],
            }
        )


def test_numbers_that_are_none_are_refused_and_leave_what_was_there(tmp_path):
    good = results_of(PREPARED, RECORDS, ABOUT)
    save_results(tmp_path, good)
    with pytest.raises(ValueError, match="JSON"):
        save_results(tmp_path, replace(good, bounds={"optimal_lower": float("nan")}))
    assert load_results(tmp_path) == good
