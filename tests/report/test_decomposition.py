"""What costs are made of, on a sweep whose every number is known."""

import re
from dataclasses import replace
from itertools import product

from tests.report import handmade
from xplain.experiment.results import load_results, save_results
from xplain.report.decomposition import parts, table
from xplain.report.summary import Summary


def sweep_with_true_labels(folder):
    """By seed s and trace t: the clairvoyant costs 1 + t, true labels 2 more (and s), what is
    learned 5 more than that, the oracle .5 more than the clairvoyant."""
    jobs = [
        {"solver": solver, "lambda": trade_off, "seed": str(seed)}
        for solver, trade_off, seed in product(("qhr", "qmdp"), ("2", "1"), range(3))
    ]
    handmade.sweep(folder, jobs, regret=lambda values, _: 6.5 + float(values["seed"]))
    for own in sorted((folder / "results").iterdir()):
        results = load_results(own)
        more = [
            handmade.episode(who, e.trace, e.type, e.cost + add)
            for e in results.episodes
            if e.solver == "oracle"
            for who, add in (("clairvoyant", -0.5), ("true_labels", 1.5 + results.seed))
        ]
        save_results(own, replace(results, episodes=(*results.episodes, *more)))
    return Summary(folder)


def test_parts_add_up_and_are_those_put_in(tmp_path):
    found = list(parts(sweep_with_true_labels(tmp_path)))
    whose = [(values["solver"], values["lambda"]) for values, _ in found]
    assert set(whose) == set(product(("qmdp", "qhr"), (1.0, 2.0)))
    for *_, estimates in found:
        floor, type_unknown, learned, cost, oracle = estimates.values()
        assert floor.mean == 2.0  # 1 + t − .5 over t = 0 … 3
        assert type_unknown.mean == 3.0  # 2 + s over s = 0, 1, 2
        assert type_unknown.low < 2.5  # seeds are what differs
        assert learned.mean == 5.0
        assert (learned.low, learned.high) == (5.0, 5.0)
        assert cost.mean == floor.mean + type_unknown.mean + learned.mean
        assert oracle.mean == 0.5


def test_the_table_has_a_row_a_method_and_trade_off_in_order(tmp_path):
    rows = re.findall(
        r"^\| Disaster rescue \| (\w+) \| (\w+) \|",
        table(sweep_with_true_labels(tmp_path)).markdown(),
        re.MULTILINE,
    )
    assert rows == [("QMDP", "1"), ("QMDP", "2"), ("QHR", "1"), ("QHR", "2")]


def test_methods_without_true_labels_are_left_out(tmp_path):
    handmade.sweep(tmp_path, [{"solver": "qmdp"}], regret=lambda *_: 1.0)
    assert not list(parts(Summary(tmp_path)))
