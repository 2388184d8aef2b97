"""Compares small random MDPs with all of their policies, by linear algebra, and tasks with a goal
with repeated relaxation."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xplain.domains import mdp
from xplain.domains.goal_task import GoalTask, StateSpace
from xplain.domains.mdp import MDP
from xplain.errors import DomainError


@st.composite
def small_mdps(draw: st.DrawFn) -> MDP:
    """Draws MDPs of up to 5 states, 3 actions and 3 outcomes, with unavailable actions and terminal
    states, half of which have no action.

    Rewards are small whole numbers and probabilities are coarse, so that exact ties are common.
    """
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    states, actions, slots = (int(x) for x in rng.integers([2, 1, 1], [6, 4, 4]))
    weight = rng.integers(0, 3, (states, actions, slots)).astype(float)
    weight[:, :, 0] += weight.sum(axis=2) == 0
    available = rng.random((states, actions)) < 0.8
    available[np.arange(states), rng.integers(actions, size=states)] = True
    terminal = rng.random(states) < 0.2
    available[terminal & (rng.random(states) < 0.5)] = False  # nothing is done where all ends
    probability = weight / weight.sum(axis=2, keepdims=True) * available[:, :, None]
    return MDP(
        rng.integers(0, states, weight.shape),
        probability,
        rng.integers(-2, 3, weight.shape).astype(float),
        draw(st.sampled_from([0.0, 0.5, 0.9, 0.99, 0.999])),
        terminal,
    )


def best_by_enumeration(model: MDP) -> np.ndarray:
    """Computes Q* [S, A] by solving (I − γ P) v = r for every deterministic policy; −inf for
    unavailable actions."""
    available = model.probability.sum(axis=2) > 0
    expected = (model.probability * model.reward).sum(axis=2)
    kernel = np.zeros((model.n_states, model.n_actions, model.n_states))
    s, a, _ = np.indices(model.successor.shape)
    np.add.at(kernel, (s, a, model.successor), model.probability)
    choices = [np.flatnonzero(row) for row in available | model.terminal[:, None]]
    rows = np.arange(model.n_states), np.array([*product(*choices)])  # of each policy
    p = kernel[rows] * ~model.terminal[:, None]
    r = expected[rows] * ~model.terminal
    values = np.linalg.solve(np.eye(model.n_states) - model.discount * p, r[:, :, None])
    best = values.max(axis=0)[:, 0]
    q = np.where(available, expected + model.discount * kernel @ best, -np.inf)
    q[model.terminal] = 0
    return q


def scale(model: MDP) -> float:
    """Computes the largest value that a policy could have."""
    return max(np.abs(model.reward[model.probability > 0]).max(initial=0), 1e-12) / (
        1 - model.discount
    )


def solve(models: list[MDP]) -> np.ndarray:
    """Returns [B, S, A] the optimal actions."""
    names = [f"model {i}" for i in range(len(models))]
    return np.array([model.optimal for model in MDP.solve(models, names)])


@settings(max_examples=40, deadline=None)
@given(small_mdps(), st.sampled_from([0.1, 0.3, 0.6, 0.9]), st.sampled_from([0.03, 0.1]))
def test_values_and_optimal_actions_are_those_of_the_best_policy(
    model: MDP, discount: float, asked: float
) -> None:
    """Values have the requested precision; actions are optimal within the tie tolerance."""
    solved, true = mdp.q_values([model])[0], best_by_enumeration(model)
    finite, live = np.isfinite(true), ~model.terminal
    assert np.array_equal(np.isfinite(solved)[live], finite[live])
    # Twice the promise: the reference is rounded as well.
    assert np.abs(solved[finite] - true[finite]).max(initial=0) <= 2 * mdp.SOLVED * scale(model)
    gap = (true.max(axis=1, keepdims=True) - true)[live] / scale(model)
    if not ((gap > mdp.TIE / 2) & (gap < 2 * mdp.CLEAR)).any():
        optimal = solve([model])[0]
        assert np.array_equal(optimal[live], gap < mdp.TIE)
        assert not optimal[model.terminal].any()
    model = replace(model, discount=discount)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mdp, "SOLVED", asked)
        solved, true = mdp.q_values([model])[0], best_by_enumeration(model)
    assert np.abs(solved[finite] - true[finite]).max(initial=0) <= asked * scale(model) + 1e-9


@settings(max_examples=30, deadline=None)
@given(small_mdps(), st.integers(0, 2**32 - 1))
def test_labels_follow_the_definition(model: MDP, seed: int) -> None:
    rng = np.random.default_rng(seed)
    transitions = rng.integers(0, [model.n_states, model.n_actions, model.n_states], (30, 3))
    model = replace(model, optimal=rng.random((model.n_states, model.n_actions)) < 0.5)
    got = model.labels(transitions)
    for (s, a, after), label in zip(transitions, got, strict=True):
        happens = any(
            model.successor[s, a, k] == after and model.probability[s, a, k] > 0
            for k in range(model.successor.shape[2])
        )
        assert label == (model.optimal[s, a] and happens)


def choice(gain: float, discount: float = 0.9) -> MDP:
    """Makes one state with two actions to a terminal state, with values 1 and 1 + gain."""
    return MDP(
        np.ones((2, 2, 1), dtype=np.int64),
        np.ones((2, 2, 1)),
        np.array([[[1.0], [1.0 + gain]], [[0.0], [0.0]]]),
        discount,
        np.array([False, True]),
    )


def test_an_ambiguous_gap_is_refused_and_names_the_model() -> None:
    gain = 10 * np.sqrt(mdp.TIE * mdp.CLEAR)
    with pytest.raises(DomainError, match="ambiguous tie in the second, state 0, action 0"):
        MDP.solve([choice(1), choice(gain)], ["the first", "the second"])


def test_a_gap_is_small_against_its_own_models_scale() -> None:
    """A model is solved together with another model whose rewards are a million times larger."""
    models = [choice(1e-6), replace(choice(0.5), reward=choice(0.5).reward * 1e6)]
    for order in (models, models[::-1]):
        optimal = solve(order)[:, 0].tolist()
        assert optimal == [[False, True], [False, True]]


def test_what_cannot_happen_does_not_matter() -> None:
    """A reward of 10^9 at probability 0 (in a slot not used, or of an action not available)
    changes no value, no tie and no refusal."""

    def widened(gain: float, reward: float) -> MDP:
        """Makes :func:`choice` with an impossible outcome and an unavailable action."""
        one = choice(gain)
        padding = [(0, 0), (0, 1), (0, 1)]
        return MDP(
            np.pad(one.successor, padding),
            np.pad(one.probability, padding),
            np.pad(one.reward, padding, constant_values=reward),
            one.discount,
            one.terminal,
        )

    ambiguous = 10 * np.sqrt(mdp.TIE * mdp.CLEAR)
    for reward in (0.0, 1e9):
        models = [widened(gain, reward) for gain in (0.0, 1e-6, -1.0)]
        optimal = solve(models)[:, 0].tolist()
        assert optimal == [[True, True, False], [False, True, False], [True, False, False]]
        values = mdp.q_values(models)[:, 0, :2]
        assert values == pytest.approx(np.array([[1, 1], [1, 1 + 1e-6], [1, 0]]), abs=1e-9)
        with pytest.raises(DomainError, match="ambiguous tie"):
            solve([widened(ambiguous, reward)])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"discount": 1.0}, "discount"),
        ({"discount": -0.1}, "discount"),
        ({"probability": np.full((2, 2, 1), 0.5)}, "sum to 1"),
        (
            {
                "successor": np.ones((2, 2, 2), dtype=np.int64),
                "probability": np.tile([1.5, -0.5], (2, 2, 1)),
                "reward": np.zeros((2, 2, 2)),
            },
            "sum to 1",
        ),
        ({"reward": np.full((2, 2, 1), np.nan)}, "finite"),
        ({"successor": np.full((2, 2, 1), 2)}, "does not exist"),
        ({"successor": np.array([[[0], [2]], [[1], [1]]])}, "does not exist"),
        ({"successor": np.array([[[0], [-1]], [[1], [1]]])}, "does not exist"),
        ({"terminal": np.zeros(3, dtype=bool)}, "terminal"),
        ({"reward": np.zeros((2, 2, 2))}, r"must all be \[S, A, K\]"),
        ({"probability": np.zeros((2, 2, 1))}, "needs an action"),
    ],
)
def test_contradictions_are_refused(change: dict, text: str) -> None:
    fields = {k: getattr(choice(1), k) for k in MDP.__dataclass_fields__}
    with pytest.raises(DomainError, match=text):
        MDP(**fields | change)


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


def two_ways(
    extra: float = 0.0, cut: Any = (), dead_end: float = 100.0, imagined: Any = None
) -> GoalTask:
    """Makes two ways from state 0 to the goal 2: directly for 2, or by state 1 for 1 and 1 +
    extra. Nobody can do the actions ``cut``."""
    edges = {(0, 0): 2, (0, 1): 1, (1, 2): 2}
    cost = np.array([2.0, 1.0, 1.0 + extra])
    cost[[*cut]] = np.inf
    goal = np.array([False, False, True])
    seen = None if imagined is None else np.array(imagined)
    return GoalTask(space_of(edges, 3, 3), cost, goal, dead_end, 0, seen)


@pytest.mark.parametrize(
    ("task", "said"),
    [
        (two_ways(3e-10), "ambiguous tie in the second"),
        (two_ways(cut=[0, 1]), "unsolvable: the second has no plan"),
        (two_ways(dead_end=2.0), "dead_end_cost=2"),
        # There is no plan from state 1, though the real start has one.
        (two_ways(cut=[2], imagined=[1, 1, 2]), "unsolvable: the second"),
    ],
)
def test_an_unclear_tie_or_no_plan_is_an_error_that_names_the_model(
    task: GoalTask, said: str
) -> None:
    with pytest.raises(DomainError, match=said):
        GoalTask.solve([two_ways(), task], ["the first", "the second"])


def test_a_free_action_makes_sense_only_on_the_way_to_the_goal() -> None:
    edges = {(0, 0): 1, (1, 1): 0, (1, 2): 2, (0, 3): 0}  # there and back, on, and around
    cost, transitions = np.eye(4)[2], np.array([(*edge, after) for edge, after in edges.items()])
    task = GoalTask(space_of(edges, 3, 4), cost, np.arange(3) == 2, 100.0, 0)
    assert task.labels(transitions).tolist() == [True, False, True, False]


def test_an_imagined_state_is_judged_in_place_of_the_real_one() -> None:
    """People who take state 0 for state 1 find the way through 1 and the jump inexplicable. They
    need no plan from state 0."""
    transitions = np.array([[0, 0, 2], [0, 1, 1], [0, 2, 2], [1, 2, 2]])
    for imagined, labels in (
        (None, [True, True, False, True]),
        ([1, 1, 2], [False, False, True, True]),
    ):
        assert two_ways(imagined=imagined).labels(transitions).tolist() == labels
    GoalTask.solve([two_ways(cut=[0, 1], imagined=[1, 1, 2])], ["the dreamer"])
