"""Compares cheapest plans with plans of repeated relaxation, and with all paths."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xplain.domains.goal_task import GoalTask, StateSpace
from xplain.errors import DomainError


def space_of(edges: Mapping[tuple[int, int], int], states: int, actions: int) -> StateSpace:
    """Makes the space of ``{(state, action): successor}``; every action has one variant."""
    keys = sorted(edges)
    source, variant = np.array(keys).T
    successor = np.array([edges[key] for key in keys])
    return StateSpace(states, actions, np.arange(actions), source, variant, successor)


@st.composite
def tasks(draw: Any) -> tuple[GoalTask, dict[tuple[int, int], int]]:
    """Draws a random task with whole costs, and its edges; any state may be a goal or a dead
    end."""
    states, actions = draw(st.integers(2, 9)), draw(st.integers(1, 4))
    node = st.integers(0, states - 1)
    keys = st.tuples(node, st.integers(0, actions - 1))
    edges = draw(st.dictionaries(keys, node, min_size=1, max_size=20))
    cost = st.one_of(st.integers(1, 5), st.just(np.inf))  # infinite: nobody believes in it
    task = GoalTask(
        space=space_of(edges, states, actions),
        cost=np.array(draw(st.lists(cost, min_size=actions, max_size=actions)), dtype=float),
        terminal=np.array(draw(st.lists(st.booleans(), min_size=states, max_size=states))),
        dead_end_cost=float(draw(st.sampled_from([6, 1000]))),
        start=0,
    )
    return task, edges


@settings(max_examples=80, deadline=None)
@given(tasks())
def test_plans_and_labels_are_those_of_the_cheapest_way_to_a_goal(made: Any) -> None:
    """Nobody leaves a goal; a state that costs as much as a dead end is a dead end. Labels follow
    the definition for each transition, and equal the dense tables."""
    task, edges = made
    distance = np.where(task.terminal, 0.0, np.inf)
    for _ in range(task.n_states):  # a cheapest way has at most so many steps
        for (s, a), after in edges.items():
            if not task.terminal[s]:
                distance[s] = min(distance[s], task.cost[a] + distance[after])
    distance[distance >= task.dead_end_cost] = np.inf
    assert task.to_go.tolist() == distance.tolist()
    n, actions = task.n_states, task.n_actions
    every = np.array([(s, a, t) for s in range(n) for a in range(actions) for t in range(n)])
    expected = [
        bool(
            edges.get((s, a)) == t
            and not task.terminal[s]
            and np.isfinite(task.to_go[s])
            and task.cost[a] + task.to_go[t] == task.to_go[s]
        )
        for s, a, t in every.tolist()
    ]
    assert task.labels(every).tolist() == expected
    table = np.zeros((n, actions), dtype=bool)
    for (s, a, _), good in zip(every.tolist(), expected, strict=True):
        table[s, a] |= good
    assert np.array_equal(task.optimal, table)
    reached = {tuple(x) for x in task.on_policy(np.arange(n)).tolist()}
    assert reached == {tuple(x) for x, good in zip(every.tolist(), expected, strict=True) if good}


def choice(extra: float) -> GoalTask:
    """Makes two ways from state 0 to the goal 2: directly for 2, or by state 1 for 1 and 1 +
    extra."""
    edges = {(0, 0): 2, (0, 1): 1, (1, 2): 2}
    cost = np.array([2.0, 1.0, 1.0 + extra])
    goal = np.array([False, False, True])
    return GoalTask(space_of(edges, 3, 3), cost, goal, 100.0, 0)


def test_who_imagines_another_start_needs_a_plan_from_there() -> None:
    task = choice(0)
    for imagined, cut, solvable in (
        ([1, 1, 2], [0, 1], True),  # the real start is a dead end, 1 is none
        ([1, 1, 2], [2], False),  # none from 1, though the real start has one
        ([-1, 1, 2], [], False),
    ):
        cost = task.cost.copy()
        cost[cut] = np.inf
        dreamer = GoalTask(task.space, cost, task.terminal, 100.0, 0, np.array(imagined))
        if solvable:
            GoalTask.solve([dreamer], ["the dreamer"])
        else:
            with pytest.raises(DomainError, match="unsolvable: the dreamer"):
                GoalTask.solve([dreamer], ["the dreamer"])


def test_an_unclear_tie_is_an_error_that_names_the_model() -> None:
    with pytest.raises(DomainError, match="ambiguous tie in the second"):
        GoalTask.solve([choice(0), choice(3e-10)], ["the first", "the second"])


def test_a_task_without_a_plan_is_an_error_that_names_the_model() -> None:
    task = choice(0)
    lost = GoalTask(task.space, np.array([np.inf, np.inf, 1]), task.terminal, 100.0, 0)
    with pytest.raises(DomainError, match=r"unsolvable: the pessimist has no plan"):
        GoalTask.solve([task, lost], ["mine", "the pessimist"])
    dear = GoalTask(task.space, task.cost, task.terminal, 2.0, 0)
    with pytest.raises(DomainError, match="dead_end_cost=2"):
        GoalTask.solve([dear], ["mine"])


def test_an_imagined_state_is_judged_in_place_of_the_real_one() -> None:
    """People who take state 0 for state 1 find the way through 1 and the jump inexplicable."""
    task = choice(0)
    imagined = np.array([1, 1, 2])
    dreamer = GoalTask(task.space, task.cost, task.terminal, 100.0, 0, imagined)
    transitions = np.array([[0, 0, 2], [0, 1, 1], [0, 2, 2], [1, 2, 2]])
    assert task.labels(transitions).tolist() == [True, True, False, True]
    assert dreamer.labels(transitions).tolist() == [False, False, True, True]
    nowhere = GoalTask(task.space, task.cost, task.terminal, 100.0, 0, np.array([-1, 1, 2]))
    assert nowhere.labels(transitions).tolist() == [False, False, False, True]
