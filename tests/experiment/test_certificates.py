"""Compares certificates with brute force over every action and every label, on tiny traces."""

import numpy as np
import pytest
from hydra.utils import instantiate
from scipy import stats

from tests.configurations import composed
from tests.decisions import worth_by_enumeration
from tests.handmade import a_prepared, with_cases
from xplain.errors import InputError, TooLargeError
from xplain.experiment.certificates import Certify
from xplain.experiment.explanations import Costs, trace_seed
from xplain.experiment.pipeline import Case, PreparedData
from xplain.explanation.belief import Independent, Persistent
from xplain.explanation.problem import Problem
from xplain.solvers import evaluate as policy_value
from xplain.solvers.base import GIB, CachedPolicy
from xplain.solvers.greedy import QMDP, Baseline, KnownType
from xplain.solvers.process import known_bytes
from xplain.solvers.simple import QHR, Silent
from xplain.testing.literal_pomdp import literal_optimal_value, reduced_optimal_value

COSTS = Costs(0.8, 0.6, 1.5, 0.9, "action", "observers")
PREPARED = a_prepared(steps=(2, 3))
EFFORT = vars(instantiate(composed().certify, traces=3))


def problem_of(case: Case) -> Problem:
    """Makes the problem of an agent that knows the learned types, from its definition."""
    return Problem(
        case.learned,
        np.full(2, COSTS.message_cost),
        COSTS.inexplicability_cost,
        COSTS.trade_off,
        COSTS.discount,
        PREPARED.type_shares,
        COSTS.discount_per,
    )


def alone(problem: Problem, user_type: int) -> Problem:
    return problem.with_types(problem.table.of_types([user_type]), ("alone",))


PROBLEMS = [problem_of(case) for case in PREPARED.cases]
OPTIMA = [reduced_optimal_value(problem) for problem in PROBLEMS]
KNOWN = [
    sum(p * reduced_optimal_value(alone(problem, t)) for t, p in enumerate(problem.prior))
    for problem in PROBLEMS
]


def found_for(
    solver, prepared: PreparedData = PREPARED, seed: int = 4, **effort
) -> dict[str, float]:
    return Certify(**{**EFFORT, **effort}).certificates(
        prepared, COSTS, solver, Independent(), seed
    )


def test_bounds_enclose_the_optimum_and_are_as_close_as_asked():
    found = found_for(QMDP(), gap=1e-4)
    assert found["optimal_lower"] - 1e-9 <= np.mean(OPTIMA) <= found["optimal_upper"] + 1e-9
    assert found["optimal_upper"] - found["optimal_lower"] <= 1e-4 + 1e-9
    assert found["known_type_value"] == pytest.approx(np.mean(KNOWN))
    price = np.mean(KNOWN) - np.mean(OPTIMA)
    assert price > 0.01  # or the next line says nothing
    assert found["value_of_perfect_information_low"] - 1e-9 <= price
    assert price <= found["value_of_perfect_information_high"] + 1e-9
    assert found["traces"] == 2


MISSED = Independent(accept=0.7, forget=0.2)


@pytest.mark.parametrize(
    ("solver", "belief"),
    [
        (QMDP(), Independent()),
        (QHR(), Independent()),
        (Baseline(), Independent()),
        (QMDP(), MISSED),
        (Baseline(), MISSED),
    ],
)
def test_a_policy_is_worth_what_every_answer_to_it_says(solver, belief):
    """Optimum and values are computed from every action and every answer, also if messages may be
    missed. A baseline is judged by the types that it does not know."""
    effort = Certify(**{**EFFORT, "traces": 2 if belief == Independent() else 1})
    found = effort.certificates(PREPARED, COSTS, solver, belief, 4)
    cases = PREPARED.cases[: effort.traces]
    problems = [problem_of(case).with_habits(belief.habits()) for case in cases]
    everyone = [problem_of(case).with_types(case.everyone, ("everyone",)) for case in cases]
    own = problems if solver.knows == "types" else everyone
    policies = [solver.plan(one) for one in own]
    value, cost = np.mean([*map(worth_by_enumeration, problems, policies)], axis=0)
    assert found["policy_value"] == pytest.approx(value)
    assert found["policy_cost"] == pytest.approx(cost)
    assert (found["policy_value_exact"], found["policy_value_se"]) == (1, 0)
    optimum = np.mean([literal_optimal_value(problem) for problem in problems])
    assert found["optimal_lower"] - 1e-9 <= optimum <= found["optimal_upper"] + 1e-9
    assert found["optimal_upper"] - found["optimal_lower"] <= EFFORT["gap"] + 1e-9
    assert found["known_type_value"] >= optimum
    assert found["price_of_approximation_low"] - 1e-9 <= optimum - value
    assert optimum - value <= found["price_of_approximation_high"] + 1e-9
    assert found["price_of_approximation_high"] <= optimum - value + EFFORT["gap"] + 1e-9


def test_a_baseline_is_judged_where_the_types_messages_are_too_many_to_be_mixed(monkeypatch):
    """The value is the same if it is computed for each type."""
    mixed, mixture = found_for(Baseline()), Problem.mixture

    def too_many(problem, *of):
        if problem.n_types > 1:
            raise TooLargeError("more messages matter than a table over all their subsets holds")
        return mixture(problem, *of)

    monkeypatch.setattr(Problem, "mixture", too_many)
    apart = found_for(Baseline())
    for name in ("policy_value", "policy_cost", "policy_value_exact"):
        assert apart[name] == pytest.approx(mixed[name])


@pytest.mark.parametrize("knows", ["type", "labels"])
def test_who_is_told_the_type_has_no_value_of_its_own(knows):
    found = found_for(KnownType(knows))
    assert not any(name.startswith(("policy", "price_of_approx")) for name in found)
    assert found["known_type_value"] == pytest.approx(np.mean(KNOWN))


def test_simulated_values_come_with_the_error_of_their_mean():
    solver, seed, prepared = QMDP(), 4, a_prepared(steps=(3, 4))
    problems = [problem_of(case) for case in prepared.cases]
    found = found_for(solver, prepared, seed, beliefs=0, episodes=400)
    each = [
        policy_value.simulate(problem, CachedPolicy(solver.plan(problem)), 400, trace_seed(seed, i))
        for i, problem in enumerate(problems)
    ]
    value, error = found["policy_value"], found["policy_value_se"]
    assert found["policy_value_exact"] == 0
    assert value == pytest.approx(np.mean([worth.value for worth in each]))
    # Traces are simulated independently: variances add.
    assert min(worth.value_se for worth in each) > 0
    assert error == pytest.approx((each[0].value_se ** 2 + each[1].value_se ** 2) ** 0.5 / 2)
    exact = np.mean([worth_by_enumeration(p, solver.plan(p))[0] for p in problems])
    assert abs(value - exact) < 4 * error
    # 95 % limits a trace: no narrower than the optimum's bounds, wider by both errors.
    margins = [stats.t.ppf(0.975, 399) * worth.value_se for worth in each]
    low, high = found["price_of_approximation_low"], found["price_of_approximation_high"]
    assert high == pytest.approx(found["optimal_upper"] - value + np.mean(margins))
    assert low == pytest.approx(found["optimal_lower"] - value - np.mean(margins))
    assert low > 0.1  # each trace's is: none was cut at 0
    half = stats.t.ppf(0.975, 399) * error
    ends = found["policy_value_low"], found["policy_value_high"]
    assert ends == pytest.approx((value - half, value + half))


def test_only_the_first_traces_count():
    only = found_for(QMDP(), traces=1)
    assert only["traces"] == 1
    assert only["known_type_value"] == pytest.approx(KNOWN[0])
    assert found_for(QMDP(), traces=9)["traces"] == 2
    assert found_for(QMDP(), traces=0) == {}


@pytest.mark.parametrize(
    ("key", "value"),
    [("traces", -1), ("nodes", 0), ("beliefs", -1), ("episodes", 1), ("gap", 0), ("gap", np.nan)],
)
def test_effort_is_checked(key, value):
    with pytest.raises(InputError, match=f"certify.{key}"):
        Certify(**{**EFFORT, key: value})


def test_nothing_is_certified_of_a_policy_whose_belief_takes_labels_to_be_repeated():
    effort = Certify(**EFFORT)
    fresh = effort.certificates(PREPARED, COSTS, QMDP(), Independent(), 4)
    repeated = effort.certificates(PREPARED, COSTS, QMDP(), Persistent(), 4)
    assert "fresh_labels" not in fresh
    assert repeated["fresh_labels"] == 0
    assert not any(name.startswith(("policy", "price_of_approx")) for name in repeated)
    for name in ("optimal_lower", "optimal_upper", "known_type_value"):
        assert repeated[name] == fresh[name]


def test_a_trace_whose_certificate_takes_too_much_memory_has_none(caplog):
    """The longer of two traces has no certificate; the shorter trace is certified as if it were
    alone."""
    sizes = sorted(known_bytes(problem) / GIB for problem in PROBLEMS)
    little = Certify(**{**EFFORT, "memory_gib": sum(sizes) / 2})
    solver = Silent()
    found = little.certificates(PREPARED, COSTS, solver, Independent(), 4)
    assert "no certificate of trace 1" in caplog.text
    assert "GiB" in caplog.text
    alone = little.certificates(
        with_cases(PREPARED, PREPARED.cases[0]), COSTS, solver, Independent(), 4
    )
    assert found == alone
    assert found["traces"] == 1
    least = Certify(**{**EFFORT, "memory_gib": 1e-9})
    assert least.certificates(PREPARED, COSTS, solver, Independent(), 4) == {}
