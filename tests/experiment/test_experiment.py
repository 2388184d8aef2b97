"""The references of a run, on handmade traces, without learning."""

from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import pytest

from tests.handmade import a_prepared
from xplain.experiment.cache import EpisodeCache
from xplain.experiment.certificates import Certify
from xplain.experiment.experiment import Experiment
from xplain.experiment.explanations import Costs
from xplain.experiment.progress import SILENT
from xplain.explanation.belief import Independent
from xplain.interaction.explainees import Exact
from xplain.interaction.metrics import Record
from xplain.solvers.base import Solver
from xplain.solvers.greedy import QMDP, Baseline
from xplain.solvers.simple import QHR


def learned_again() -> NoReturn:
    raise AssertionError("data and types are known already")


EXPERIMENT = Experiment(
    components=learned_again,
    costs=Costs(1.5, 1.0, 1.0, 0.95, "action", "uniform"),
    solver=QMDP(),
    belief=Independent(),
    explainee=Exact(),
    certify=Certify(traces=0, gap=0.1, nodes=1, beliefs=0, episodes=2),
    seed=0,
)


@pytest.mark.parametrize(
    ("solver", "perfect", "beside"),
    [
        (QMDP(), True, {"oracle", "true_labels"}),
        (QMDP(), False, {"true_labels"}),  # what an oracle knows was not learned
        (Baseline(), True, {"oracle"}),  # true types change nothing that it plans with
    ],
)
def test_a_solver_is_compared_with_those_that_can_be(
    solver: Solver, perfect: bool, beside: set[str]
) -> None:
    prepared = a_prepared(perfect)
    same, records = replace(EXPERIMENT, solver=solver).explain_cases(
        prepared, EpisodeCache(None, {}), SILENT
    )
    assert same is prepared
    assert {record.solver for record in records} == {"solver", "clairvoyant", *beside}
    for name in {record.solver for record in records}:
        met = [(r.trace, r.user_type) for r in records if r.solver == name]
        users = range(len(prepared.types))
        assert met == [(trace, user) for trace in range(len(prepared.cases)) for user in users]


def costs(records: list[Record]) -> dict[tuple[str, int, int], float]:
    return {(r.solver, r.trace, r.user_type): r.episode.cost for r in records}


def test_episodes_that_results_share_are_those_that_each_would_have_made(tmp_path: Path) -> None:
    """Every solver after the first finds its references in the cache, for any learner."""
    kept = EpisodeCache(tmp_path, {"lambda": 1.5})
    other = a_prepared()
    wrong = [replace(case.learned, p=1 - case.learned.p) for case in other.cases]
    cases = zip(other.cases, wrong, strict=True)
    learned = (replace(case, learned=table, everything=table) for case, table in cases)
    other = replace(other, cases=tuple(learned))
    for number, (solver, prepared) in enumerate(
        [(QMDP(), a_prepared()), (QHR(), a_prepared()), (QMDP(), other)]
    ):
        own = replace(EXPERIMENT, solver=solver)
        cache = replace(kept, config={**kept.config, "solver": repr(solver), "points": number})
        _, alone = own.explain_cases(prepared, EpisodeCache(None, {}), SILENT)
        for _ in range(2):
            _, shared = own.explain_cases(prepared, cache, SILENT)
            assert costs(shared) == costs(alone)
        # References and two solvers with true labels; another learner adds none.
        assert len([*tmp_path.iterdir()]) == min(number + 2, 3)


def test_a_damaged_entry_is_made_again(tmp_path: Path) -> None:
    cache = EpisodeCache(tmp_path, {})
    _, before = EXPERIMENT.explain_cases(a_prepared(), cache, SILENT)
    for path in tmp_path.iterdir():
        path.write_text(path.read_text()[:100])
    _, after = EXPERIMENT.explain_cases(a_prepared(), cache, SILENT)
    assert costs(after) == costs(before)
