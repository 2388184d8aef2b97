"""The literal POMDP and its reduction; the exported file, read back and solved as any POMDP."""

import re
from collections import defaultdict
from dataclasses import dataclass, field
from itertools import product

import numpy as np
import pytest
from hypothesis import example, given, settings

from tests.explanation.problems import misleading_problem, tiny_problems
from xplain import InputError, Problem
from xplain.explanation.files import pomdp_lines
from xplain.explanation.habits import habits_of
from xplain.testing.literal_pomdp import (
    EXPLAIN,
    LiteralPOMDP,
    literal_optimal_value,
    reduced_optimal_value,
)


@dataclass(frozen=True)
class Flat:
    """A POMDP from a file; missing entries are 0.

    Attributes:
        discount: γ.
        states, actions, observations: numbers of these.
        start: initial belief, one number for each state.
        transition: {(action, state): {next state: probability}}.
        observation: {(action, next state): {observation: probability}}.
        reward: {(action, state): expected value}.
    """

    discount: float
    states: int
    actions: int
    observations: int
    start: tuple[float, ...]
    transition: dict[tuple[int, int], dict[int, float]] = field(
        default_factory=lambda: defaultdict(dict)
    )
    observation: dict[tuple[int, int], dict[int, float]] = field(
        default_factory=lambda: defaultdict(dict)
    )
    reward: dict[tuple[int, int], float] = field(default_factory=dict)


def read(text: str) -> Flat:
    """Numeric entries, one a line; rewards by action and state."""
    lines = [line.split(":", 1) for line in text.splitlines()]
    header = {key: rest for key, rest in lines if key not in ("T", "O", "R")}
    flat = Flat(
        float(header["discount"]),
        int(header["states"]),
        int(header["actions"]),
        int(header["observations"]),
        tuple(float(p) for p in header["start"].split()),
    )
    for key, rest in lines:
        action, _, entry = rest.partition(":")
        match key, entry.replace(":", " ").split():
            case "R", [state, "*", "*", value]:
                flat.reward[int(action), int(state)] = float(value)
            case "T" | "O", [state, place, value]:
                entries = flat.transition if key == "T" else flat.observation
                entries[int(action), int(state)][int(place)] = float(value)
            case _:
                assert key in header, f"{key}:{rest} is no numeric entry"
    return flat


def text_of(problem: Problem) -> str:
    return "\n".join(pomdp_lines(problem))


def expectimax(flat: Flat, belief: dict[int, float], horizon: int) -> float:
    """Computes the optimal value of a general POMDP, without knowledge about explanations."""
    if horizon == 0:
        return 0.0
    best = -np.inf
    for action in range(flat.actions):
        reward, seen = 0.0, {}
        for state, weight in belief.items():
            reward += weight * flat.reward.get((action, state), 0.0)
            for after, p in flat.transition[action, state].items():
                for o, q in flat.observation[action, after].items():
                    joint = seen.setdefault(o, {})
                    joint[after] = joint.get(after, 0.0) + weight * p * q
        later = 0.0
        for joint in seen.values():
            total = sum(joint.values())
            if set(joint) != {flat.states - 1}:  # the end is worth nothing
                posterior = {state: weight / total for state, weight in joint.items()}
                later += total * expectimax(flat, posterior, horizon - 1)
        best = max(best, reward + flat.discount * later)
    return best


@settings(deadline=None, max_examples=40)
@given(tiny_problems(max_types=2, max_steps=2))
@example(misleading_problem())
def test_the_file_has_the_optimum_of_the_problem(problem: Problem) -> None:
    """Problems are refused if the file has no states or discounts for them."""
    with pytest.raises(InputError, match=r"missed|discount_per"):
        text_of(problem.with_habits(habits_of(0.0, 0.5, 0.0)))
    if problem.discount_per == "step" and problem.discount < 1:
        with pytest.raises(InputError, match="discount_per"):
            text_of(problem)
        return
    flat = read(text_of(problem))
    start = {state: p for state, p in enumerate(flat.start) if p > 0}
    horizon = problem.n_steps + problem.n_messages
    optimum = reduced_optimal_value(problem)
    assert expectimax(flat, start, horizon) == pytest.approx(optimum, abs=1e-9)


@settings(deadline=None, max_examples=40)
@given(tiny_problems())
def test_the_file_is_a_pomdp(problem: Problem) -> None:
    """Every row of T and O exists and sums to 1; entries are numbers, except for the wildcards of
    R."""
    if problem.discount_per == "step" and problem.discount < 1:
        return
    text = text_of(problem)
    plain = re.sub(r"(?m)^(R: \d+ : \d+ : )\* : \* ", r"\1", text)
    assert not re.search(r"[A-Za-z*]", re.sub(r"(?m)^(\w+|T|O|R):|reward|e-\d+", "", plain))
    flat = read(text)
    assert sum(flat.start) == pytest.approx(1)
    for action, state in product(range(flat.actions), range(flat.states)):
        assert sum(flat.transition[action, state].values()) == pytest.approx(1)
        assert sum(flat.observation[action, state].values()) == pytest.approx(1)
        assert max(flat.observation[action, state]) < flat.observations


@settings(deadline=None, max_examples=60)
@given(tiny_problems())
def test_literal_and_reduced_agree(problem: Problem) -> None:
    literal = literal_optimal_value(problem)
    assert literal == pytest.approx(reduced_optimal_value(problem), abs=1e-9)


def test_a_worked_example() -> None:
    """There are two steps and one message with cost 1.2, without a discount. Type 0 needs the
    message, type 1 never does. The message at once costs 1.2. The labels of the first step show the
    type: type 0 pays 1 and then 1.2 for the second prefix (rather than 2), type 1 nothing: 0.5 ·
    2.2 = 1.1.
    """
    p = np.array([[[0, 1], [0, 1]], [[1, 1], [1, 1]]], dtype=float)
    problem = Problem(p, np.array([1.2]), discount=1.0)
    assert literal_optimal_value(problem) == pytest.approx(-1.1)


def test_messages_used_are_no_actions() -> None:
    p = np.tile([0.2, 0.4, 0.6, 0.8, 0.2, 0.4, 0.6, 0.8], (1, 2, 1))
    pomdp = LiteralPOMDP(Problem(p, np.zeros(3)))  # the last changes nothing
    (start,) = pomdp.initial()
    assert pomdp.actions(start) == [EXPLAIN, 0, 1]
    ((_, pending, seen, _),) = pomdp.outcomes(start, 1)
    assert (pomdp.actions(pending), seen) == ([EXPLAIN, 0], None)
    for _, after, labels, _ in pomdp.outcomes(pending, EXPLAIN):
        assert pomdp.actions(after) == [EXPLAIN, 0]
        assert labels == after.labels
