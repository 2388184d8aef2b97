"""From labels to costs: if the types found are the true ones, nothing else may differ."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from tests.configurations import composed
from xplain.experiment.explanations import Costs, evaluate, with_true_labels
from xplain.experiment.from_config import components_of, costs_of
from xplain.experiment.pipeline import Prepared, prepare
from xplain.explanation.belief import Independent
from xplain.interaction.explainees import Exact
from xplain.interaction.metrics import Record
from xplain.solvers.base import Solver
from xplain.solvers.greedy import QMDP, KnownType
from xplain.solvers.pomcp import POMCP

SMALL = ("domain=rescue", "observers.label_noise=0.02", "points=150", "traces=2", "seed=2")
SOLVERS: dict[str, Solver] = {
    "qmdp": QMDP(),
    "pomcp": POMCP(simulations=100),
    "oracle": KnownType("type"),
}


@cache
def prepared(*overrides: str) -> tuple[Prepared, Costs]:
    cfg = composed(*SMALL, *overrides)
    return prepare(components_of(cfg)), costs_of(cfg)


def episodes(*overrides: str) -> list[Record]:
    return evaluate(*prepared(*overrides), SOLVERS, Independent(), Exact(), 0)


def same(one: Record, other: Record) -> bool:
    key = one.solver, one.trace, one.user_type
    return (
        key == (other.solver, other.trace, other.user_type)
        and one.episode.cost == other.episode.cost
        and np.array_equal(one.episode.messages, other.episode.messages)
        and np.array_equal(one.episode.beliefs, other.episode.beliefs)
    )


@pytest.mark.parametrize("labeler", ["labeler=tree", "labeler=pruned"])
def test_types_found_right_cost_what_the_true_ones_do(labeler: str) -> None:
    """Costs are equal to the last digit, for any solver."""
    found, _ = prepared("clusterer=dirichlet", labeler)
    assert found.learning["adjusted_rand_index"] == 1
    true, _ = prepared("clusterer=perfect", labeler)
    assert found.matched_true_type.tolist() == true.matched_true_type.tolist()
    for one, other in zip(found.cases, true.cases, strict=True):
        assert np.array_equal(one.learned.p, other.learned.p)
        assert one.perfect is not None
        # The oracle's labelers are the found ones, type by type.
        for t, matched in enumerate(found.matched_true_type):
            user = found.distinct.tolist().index(matched)
            assert np.array_equal(one.learned.p[..., t], one.perfect.p[..., user])
    pairs = zip(
        episodes("clusterer=dirichlet", labeler),
        episodes("clusterer=perfect", labeler),
        strict=True,
    )
    assert all(same(one, other) for one, other in pairs)


def test_types_that_behave_alike_are_one_for_the_oracle_too() -> None:
    """The adjusted Rand index counts them as one, and so must the oracle's labelers."""
    users = ("users=explicit", "users.groups={A: [fire, rubble], B: [fence], twin: [fire, rubble]}")
    found, _ = prepared(*users, "clusterer=dirichlet")
    true, _ = prepared(*users, "clusterer=perfect")
    assert found.distinct.tolist() == [0, 1, 0]
    assert found.learning["adjusted_rand_index"] == 1
    for one, other in zip(found.cases, true.cases, strict=True):
        assert np.array_equal(one.learned.p, other.learned.p)
        assert one.perfect is not None
        assert np.array_equal(one.perfect.p[..., 0], one.perfect.p[..., 2])
        assert np.array_equal(one.perfect.p[..., [0, 1]], one.learned.p)


def test_a_solver_that_knows_the_labels_costs_what_it_costs_without_a_labeler() -> None:
    """The reference that a run logs is the run with ``labeler=truth``."""
    learned, costs = prepared()
    solvers = {"qmdp": QMDP(), "pomcp": POMCP(simulations=100)}
    reference = evaluate(with_true_labels(learned), costs, solvers, Independent(), Exact(), 0)
    true = evaluate(*prepared("labeler=truth"), solvers, Independent(), Exact(), 0)
    assert all(same(one, other) for one, other in zip(reference, true, strict=True))
    own = evaluate(learned, costs, solvers, Independent(), Exact(), 0)
    assert not all(same(one, other) for one, other in zip(reference, own, strict=True))
