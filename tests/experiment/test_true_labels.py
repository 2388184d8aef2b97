"""``labeler=truth``: labels are known, and the type is unknown. Types that were found exactly give
the same."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.configurations import composed, world
from xplain.errors import InputError
from xplain.experiment.explanations import (
    Costs,
    evaluate,
    problem_of_types,
    trace_seed,
    with_true_labels,
)
from xplain.experiment.from_config import components_of
from xplain.experiment.pipeline import PreparedData, observe, prepare
from xplain.explanation.belief import Independent
from xplain.interaction.explainees import Exact
from xplain.interaction.metrics import Record
from xplain.learning.data.observers import FileObservers
from xplain.learning.user_types import TrueLabels
from xplain.solvers.base import Solver
from xplain.solvers.bounds import bounds
from xplain.solvers.evaluate import evaluate as policy_value
from xplain.solvers.greedy import QMDP, Baseline, KnownType
from xplain.solvers.hsvi import Certified, Effort
from xplain.solvers.pomcp import POMCP
from xplain.solvers.simple import QHR, SayAll, Silent

SOLVERS: dict[str, Solver] = {
    "qmdp": QMDP(),
    "qhr": QHR(),
    "pomcp": POMCP(simulations=300),
    "certified": Certified(gap=1e-6),
    "baseline": Baseline(),
    "silent": Silent(),
    "say_all": SayAll(),
}
SMALL = ("domain=rescue", "observers.label_noise=0.02", "points=150", "traces=2", "seed=2")
PLANS: dict[str, Solver] = {"qmdp": QMDP(), "pomcp": POMCP(simulations=100)}
GAMMA_1 = ("labeler=truth", "discount=1", "traces=4", "max_steps=7", "lambda=1.3")


def truth(domain: str) -> tuple[PreparedData, Costs]:
    return world(f"domain={domain}", *GAMMA_1)


@cache
def episodes(domain: str) -> dict[tuple[str, int, int], Record]:
    """Makes episodes of undiscounted plans, so that plans minimise the reported costs."""
    known = {"oracle": KnownType("type"), "clairvoyant": KnownType("labels")}
    records = evaluate(*truth(domain), SOLVERS | known, Independent(), Exact(), 0)
    return {(record.solver, record.trace, record.user_type): record for record in records}


both = pytest.mark.parametrize("domain", ["rescue", "four_rooms"])


@both
def test_the_oracle_is_the_clairvoyant_and_nobody_costs_less(domain: str) -> None:
    found = episodes(domain)
    for (_, *key), record in found.items():
        oracle, clairvoyant = found["oracle", *key].episode, found["clairvoyant", *key].episode
        assert oracle.cost == clairvoyant.cost
        assert np.array_equal(oracle.messages, clairvoyant.messages)
        assert record.episode.cost >= oracle.cost - 1e-9


def test_true_types_are_equally_likely_whatever_was_found() -> None:
    found, costs = truth("rescue")
    two = replace(found, learned_types=found.types[:2], type_shares=np.array([0.9, 0.1]))
    known = with_true_labels(two)
    problem = problem_of_types(
        known, known.cases[0], replace(costs, prior="observers"), Independent()
    )
    assert problem.prior.tolist() == [1 / len(found.types)] * len(found.types)


@both
def test_what_happens_is_what_the_model_expects(domain: str) -> None:
    """Users of every type in turn are the uniform prior, and their labels the model's own: the
    mean cost is the policy's exact expectation, and none is below the certified optimum."""
    known, costs = truth(domain)
    users = range(len(known.types))
    for index, case in enumerate(known.cases):
        problem = problem_of_types(known, case, costs, Independent())
        optimum = -bounds(problem, Effort(gap=1e-6)).upper
        for name, solver in SOLVERS.items():
            if name == "baseline":  # it plans for the mixture, which is none of these users
                continue
            worth = policy_value(problem, solver.plan(problem, trace_seed(0, index)), 50_000)
            assert worth.value_is == "exact"
            costs_met = [episodes(domain)[name, index, user].episode.cost for user in users]
            assert worth.cost == pytest.approx(np.mean(costs_met)), name
            assert np.mean(costs_met) >= optimum - 1e-6
            if name == "certified":
                assert np.mean(costs_met) <= optimum + 1e-5


@both
def test_a_true_type_is_never_ruled_out_and_the_figures_say_what_is_known(domain: str) -> None:
    known, _ = truth(domain)
    for record in episodes(domain).values():
        assert (record.right_belief > 0).all()
    assert known.learned_types == known.types
    assert known.matched_true_type.tolist() == known.distinct.tolist()
    for case in known.cases:
        assert set(np.unique(case.learned.p)) <= {0.0, 1.0}
        assert np.array_equal(case.learned.p, case.perfect.p)
        # As many observers a type: everybody's labeler is the types' mean.
        n = len(known.messages)
        mean = case.labels.array(n).mean(axis=0)
        np.testing.assert_allclose(case.everyone.array(n)[0], mean)


def test_shares_are_the_observers() -> None:
    """The observers' shares are the prior if a key says so, and weight the labeler for
    everybody."""
    known, _ = world("labeler=truth", "observers.per_type=[5,1,1,2,1]", "traces=1")
    assert known.type_shares.tolist() == [0.5, 0.1, 0.1, 0.2, 0.1]
    case = known.cases[0]
    weighed = np.tensordot(known.type_shares, case.labels.array(6), 1)
    np.testing.assert_allclose(case.everyone.array(6)[0], weighed)


def test_types_of_real_people_are_not_known(tmp_path) -> None:
    components = components_of(composed("labeler=truth", "traces=1"))
    observed = observe(
        components.domain, components.users, components.observers, components.queries, 0
    )
    with pytest.raises(InputError, match=r"labeler='truth'.*simulated"):
        TrueLabels().types_of(replace(observed, truth=None))
    with pytest.raises(InputError, match="absent"):
        prepare(replace(components, observers=FileObservers(str(tmp_path / "absent.csv"))))


# --- Types that were found ------------------------------------------------------------------------


def records(*overrides: str) -> list[Record]:
    solvers = PLANS | {"oracle": KnownType("type")}
    return evaluate(*world(*SMALL, *overrides), solvers, Independent(), Exact(), 0)


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
    found, _ = world(*SMALL, "clusterer=dirichlet", labeler)
    assert found.learning["adjusted_rand_index"] == 1
    true, _ = world(*SMALL, "clusterer=perfect", labeler)
    assert found.matched_true_type.tolist() == true.matched_true_type.tolist()
    for one, other in zip(found.cases, true.cases, strict=True):
        assert np.array_equal(one.learned.p, other.learned.p)
        # The oracle's labelers are the found ones, type by type.
        for t, matched in enumerate(found.matched_true_type):
            user = found.distinct.tolist().index(matched)
            assert np.array_equal(one.learned.p[..., t], one.perfect.p[..., user])
    ways = (records(f"clusterer={own}", labeler) for own in ("dirichlet", "perfect"))
    assert all(same(one, other) for one, other in zip(*ways, strict=True))


def test_a_solver_that_knows_the_labels_costs_what_it_costs_without_a_labeler() -> None:
    """The reference that a run logs is the run with ``labeler=truth``."""
    learned, costs = world(*SMALL, "labeler=tree", "clusterer=dirichlet")
    reference, true, own = (
        evaluate(known, costs, PLANS, Independent(), Exact(), 0)
        for known in (with_true_labels(learned), world(*SMALL, "labeler=truth")[0], learned)
    )
    assert all(same(one, other) for one, other in zip(reference, true, strict=True))
    assert not all(same(one, other) for one, other in zip(reference, own, strict=True))
