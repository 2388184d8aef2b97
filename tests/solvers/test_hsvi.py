"""Compares certified bounds with brute force, and the policy with its certificate."""

import logging
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from tests.decisions import worths
from tests.solvers.test_optimum import missing, needy
from xplain import LabelTable, Problem, TooLargeError
from xplain.explanation.actions import VisibleState
from xplain.explanation.message_sets import expand
from xplain.solvers.base import GIB
from xplain.solvers.bounds import bounds, known_type_value
from xplain.solvers.evaluate import evaluate
from xplain.solvers.hsvi import Certified, Effort, search
from xplain.solvers.hsvi_kernel import NODES
from xplain.solvers.process import (
    expected_after_forgetting,
    give_all,
    known_bytes,
    known_values,
    set_prices,
)
from xplain.testing.literal_pomdp import reduced_optimal_value
from xplain.testing.problems import random_problem


def test_what_was_found_is_not_searched_for_again() -> None:
    rng = np.random.default_rng(24)
    opened = 0
    for _ in range(30):
        problem = random_problem(rng, max_types=4, max_steps=5, max_messages=3)
        policy = Certified(gap=1e-7).plan(problem)
        searched = replace(policy, brief=Effort(gap=10.0, nodes=1))
        store = policy.found.store
        nodes = store.nodes[: store.used[NODES]]
        for node in np.flatnonzero(nodes["first_action"] >= 0):
            step, given = int(nodes["step"][node]), int(nodes["given"][node])
            visible = VisibleState(step, expand(given, policy.found.kept))
            values = searched.values(visible, store.belief[node])
            assert values == policy.found.values(int(node))
            opened += step > 0
    assert opened >= 5


def test_a_belief_that_was_not_found_is_searched_from_there() -> None:
    """The values bound the optimum of this belief, however close the belief is to a known
    belief."""
    rng, unlike = np.random.default_rng(27), 0
    for _ in range(45):
        problem = random_problem(rng)
        policy = Certified(gap=1e-6, decision_nodes=10_000).plan(problem)
        belief = rng.dirichlet(np.ones(problem.n_types))
        optimum = reduced_optimal_value(replace(problem, prior=belief))
        best = max(worths(policy, 0, 0, belief).values())
        assert optimum - 1e-6 <= best <= optimum + 1e-9
        unlike += abs(optimum - policy.lower) > 1e-3
    assert unlike > 20


def test_unlikely_answers_left_untold_are_bounded_from_both_sides() -> None:
    """One user in twenty has type B or C, which the first label shows. Message z (cost 20) makes
    all transitions explicable, except two: C's second transition, and the third transition, which
    also needs b or c (10 each).

    The optimal policy explains; then it gives z to one user in twenty, explains, and gives b or c,
    by the second label. This user costs 24 + (20 + 12) + (10 + 12); the two 12 are means of C's 24
    and B's 0. At a gap of 3.2 the search does not follow the answer of this user. The upper bound
    there is the value of known types, and the lower bound is the value of a plan that ignores
    answers."""
    p, prior, optimum = np.ones((3, 3, 8)), np.array([0.95, 0.025, 0.025]), -0.05 * 78
    for shown in range(8):
        b, c, z = (shown >> j & 1 for j in range(3))
        p[1, :, shown] = z, z, z & b
        p[2, :, shown] = z, 0, z & c
    problem = Problem(p, np.array([10.0, 10.0, 20.0]), 24.0, discount=1.0, prior=prior)
    assert reduced_optimal_value(problem) == pytest.approx(optimum)
    coarse, fine = Certified(gap=3.2).plan(problem), Certified(gap=1e-6).plan(problem)
    assert coarse.lower <= optimum - 0.3  # what that user is worth was not looked into
    assert coarse.upper >= optimum - 1e-9
    assert (fine.lower, fine.upper) == pytest.approx((optimum, optimum), abs=1e-6)


HARD = Problem(np.random.default_rng(0).random((4, 8, 16)), np.full(4, 0.5))
"""Far from closed after thousands of beliefs."""


@pytest.mark.parametrize("draw", [random_problem, missing, needy])
def test_an_opened_node_has_the_sets_that_may_be_optimal_with_their_bounds(draw: Any) -> None:
    """A set is left out where it is not better, in any state, than nothing or than the set without
    one message. The values of plans are those of the messages that a known type needs."""
    rng = np.random.default_rng(35)
    for _ in range(15):
        problem = draw(rng)
        found = search(problem, Effort(gap=1e3, nodes=1))
        process, kept, store = found.process, found.kept, found.store
        known, start, gamma = known_values(process, True), process.start, process.discount
        m, states, sets = process.n_steps, process.n_states, range(1 << len(kept))
        cells = [process.cells.at(expand(c, kept)) for c in sets]
        plans = np.zeros((states + 1, m + 1, process.p.shape[1]))
        for k, c in product(range(m - 1, -1, -1), sets[::-1]):
            at, said = cells[c], expand(c, kept)
            later = expected_after_forgetting(process, plans[-1, k + 1, at])
            plans[:, k, at] = gamma * later - process.explain_cost[k, at]
            for u in range(states if process.jump is None else 0):
                plans[u, k, at] = gamma * plans[u, k + 1, at] - process.explain_cost[k, at]
                values = {
                    j: process.message_discount * known.now(k, said | 1 << j)[u] - process.price[j]
                    for j in kept
                    if not said >> j & 1
                }
                j = max(values, key=values.__getitem__, default=None)
                if j is not None and values[j] > known.explained(k, said)[u] + 1e-9:
                    given = plans[u, k, cells[c | 1 << kept.index(j)]]
                    plans[u, k, at] = process.message_discount * given - process.price[j]
        own = plans[-len(found.tables.plans) :]
        np.testing.assert_allclose(found.tables.plans, own, atol=1e-9)
        prices, factors = set_prices(process, np.array([expand(c, kept) for c in sets]))
        every = np.empty((3, len(sets), states))  # rewards, upper and lower bounds
        for c in sets:
            said, at = expand(c, kept), cells[c]
            each = -process.explain_cost[0, at], known.explained(0, said), plans[-1, 0, at]
            after = give_all(process, np.eye(states), said)
            every[:, c] = factors[c] * (np.stack(each) @ after.T) - prices[c]
        base, over, under = every
        useful = [
            c
            for c in sets
            if all(
                (over[c] > under[less]).any()
                for less in {0, *(c & ~(1 << i) for i in range(9))} - {c}
            )
        ]
        place = store.places[0, 0]
        listed = slice(place["first_set"], place["first_set"] + place["n_sets"])
        assert store.sets[listed].tolist() == useful
        for kept_, values in ((store.base, base), (store.over, over), (store.under, under)):
            np.testing.assert_allclose(kept_[listed], values[useful], atol=1e-9)
        upper, lower, later = over @ start, under @ start, gamma * factors
        if process.jump is None:
            best = [(own[:, 1, at] @ start).max() for at in cells]
            lower = np.maximum(lower, base @ start + later * best)
        lower = np.minimum(lower, upper)
        least = max((own[:, 0, cells[0]] @ start).max(), lower[useful].max())
        open_ = [c for c in useful if upper[c] >= least - 1e-9 or upper[c] == upper[useful].max()]
        actions = store.actions[: store.used[1]]
        assert actions["messages"].tolist() == open_
        for name, values in (
            ("upper", upper),
            ("lower", lower),
            ("base", base @ start),
            ("later", later),
        ):
            np.testing.assert_allclose(actions[name], values[open_], atol=1e-9)


def test_memory_ends_a_search(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    begun = sum(a.nbytes for a in search(HARD, Effort(gap=1e-9, nodes=1)).store)
    memory = 5 * begun / GIB
    found = search(HARD, Effort(gap=1e-9, nodes=20_000, memory_gib=memory))
    assert begun < sum(a.nbytes for a in found.store) <= memory * GIB
    assert "memory_gib" in caplog.text
    assert found.upper - found.lower > 1e-9


def test_rounding_rules_no_optimal_set_out() -> None:
    """The bounds of two message sets differ by 2e-18 only. The policy of one set once had a value
    0.004 below the certified value of the other."""
    table = np.full((4, 3, 4), 0.9)
    table[2, 1:, :2] = 0.3
    table[3, 1, ::2] = 0.3
    price = np.array([1.1770440751780757, 0.24035167248673944])
    prior = np.array([0.08413891498025429, 0.41300560113035323, 0.1358649199773414])
    prior = np.append(prior, 0.36699056391205115)
    problem = Problem(LabelTable.dense(table), price, 2.0, 0.1, 0.95, prior, "action")
    for gap in (1e-3, 1e-7):
        policy = Certified(gap=gap).plan(problem)
        assert evaluate(problem, policy).value >= policy.lower - 1e-9


def test_bounds_are_simpler_where_memory_is_short() -> None:
    problem = random_problem(np.random.default_rng(5), max_types=3, max_steps=3, max_messages=2)
    enough = bounds(problem)
    room = 1.1 * known_bytes(problem) / GIB  # for known types, not for the search
    little = bounds(problem, Effort(memory_gib=room))
    assert little.lower <= enough.lower + 1e-9
    assert little.upper >= enough.upper - 1e-9
    assert little.known_type == pytest.approx(enough.known_type, abs=1e-9)
    with pytest.raises(TooLargeError):
        bounds(problem, Effort(memory_gib=1e-9))


def test_as_many_messages_as_masks_hold_are_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(34)
    wide = (random_problem(rng, max_steps=3, max_messages=2) for _ in range(200))
    problem = next(p for p in wide if _open(p))
    for most, searched in ((2, True), (1, False)):
        monkeypatch.setattr("xplain.solvers.process.MAX_RELEVANT", most)
        found = bounds(problem)
        assert (found.upper - found.lower <= 1e-3) == searched
        assert found.lower - 1e-9 <= reduced_optimal_value(problem) <= found.upper + 1e-9


def _open(problem) -> bool:
    """True if both messages have an effect, and the bound of known types is at least 0.1 above the
    optimum."""
    known = known_type_value(problem)
    optimum = reduced_optimal_value(problem)
    return len(problem.messages_with_effect) == 2 and known - optimum > 0.1
