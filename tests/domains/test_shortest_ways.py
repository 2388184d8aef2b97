"""Costs of the cheapest ways, against scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from xplain.domains.shortest_ways import shortest_ways


@pytest.mark.parametrize("seed", range(20))
def test_costs_to_the_nearest_goal_are_scipys(seed: int) -> None:
    rng = np.random.default_rng(seed)
    states, edges, variants = 200, int(rng.integers(100, 2000)), 6
    source, target = rng.integers(states, size=(2, edges))
    variant = rng.integers(variants, size=edges)
    cost = rng.integers(1, 9, variants).astype(float)
    cost[rng.random(variants) < 0.2] = np.inf
    goal = rng.random(states) < (1.0 if seed == 0 else 0.1)
    goal[int(rng.integers(states))] = True
    order = np.argsort(target, kind="stable")
    first = np.searchsorted(target[order], np.arange(states + 1))
    found = np.full(states, np.inf)
    shortest_ways(first, order, source, variant, cost, goal, found)
    # Backwards from one more state, from which goals are as good as free; of edges side by side
    # the cheapest counts.
    cheapest = np.full((states + 1, states + 1), np.inf)
    np.minimum.at(cheapest, (target, source), cost[variant])
    free = 1e-9
    cheapest[states, :states][goal] = free
    at = np.nonzero(np.isfinite(cheapest))
    graph = coo_array((cheapest[at], at), shape=cheapest.shape).tocsr()
    np.testing.assert_allclose(found, dijkstra(graph, indices=states)[:states] - free, atol=1e-8)
