"""What a run compares its solver with, on hand-made traces: nothing is learned here."""

from __future__ import annotations

from dataclasses import replace
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
from xplain.solvers.base import Solver
from xplain.solvers.greedy import QMDP, Baseline


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
    same, records = replace(EXPERIMENT, solver=solver).explained(
        prepared, EpisodeCache(None, {}), SILENT
    )
    assert same is prepared
    assert {record.solver for record in records} == {"solver", "clairvoyant", *beside}
    for name in {record.solver for record in records}:
        met = [(r.trace, r.user_type) for r in records if r.solver == name]
        users = range(len(prepared.types))
        assert met == [(trace, user) for trace in range(len(prepared.cases)) for user in users]


def test_without_certificates_there_are_none() -> None:
    assert EXPERIMENT.certificates(a_prepared(), SILENT) == {}
