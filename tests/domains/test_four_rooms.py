"""The four-rooms task: the published map, its five parameters, bad input."""

from typing import Any

import numpy as np
import pytest

from tests.domains.configs import domain_of, given
from xplain.domains.four_rooms import DOORS, FourRooms
from xplain.errors import InputError

FOUR_ROOMS = "domain=four_rooms"


def accurate(domain: FourRooms) -> dict[str, Any]:
    return {p.name: p.accurate for p in domain.parameters}


def test_the_map_is_the_published_one() -> None:
    grid = domain_of(FOUR_ROOMS).grid
    assert grid.shape == (13, 13)
    assert len(grid.cells) == 104
    inner_walls = [(r, 6) for r in range(1, 12)]
    inner_walls += [(6, c) for c in range(1, 6)] + [(7, c) for c in range(7, 12)]
    doors = {cell for cell in inner_walls if grid.number[cell] >= 0}
    assert doors == {(3, 6), (10, 6), (6, 2), (7, 9)}


def test_the_model_follows_the_values() -> None:
    domain = domain_of(FOUR_ROOMS)
    values = accurate(domain) | {
        "goals": [{"cell": [1, 3], "reward": 5.0}],
        "discount": 0.9,
        "step_cost": 0.25,
        "penalty_cells": [[1, 2]],
        "penalty": 2.0,
    }
    model = domain.model(values)
    state = domain.grid.number[1, 1]
    right = domain.actions.index("right")
    rewards = []
    while not model.terminal[state]:
        rewards.append(model.reward[state, right, 0])
        state = model.successor[state, right, 0]
    assert rewards == pytest.approx([-0.25 - 2.0, -0.25 + 5.0])
    assert model.discount == 0.9
    # Bumping into a wall beside the goal or in the penalty cell is a step, nothing more.
    up, at_penalty = domain.actions.index("up"), domain.grid.number[1, 2]
    assert model.successor[at_penalty, up, 0] == at_penalty
    assert model.reward[at_penalty, up, 0] == pytest.approx(-0.25)
    assert model.terminal.sum() == 1


def test_rewards_are_for_entering_and_add_up() -> None:
    """The goal is in a penalty cell beside a wall. A robot that slips against the wall does not
    enter the cell again."""
    arguments = edited("slip", 0.2)
    domain = FourRooms(**arguments)
    values = accurate(domain) | {
        "goals": [{"cell": [1, 1], "reward": 5.0}],
        "step_cost": 0.25,
        "penalty_cells": [[1, 1]],
        "penalty": 2.0,
    }
    model = domain.model(values)
    goal = domain.grid.number[1, 1]
    for state in (domain.grid.number[1, 2], domain.grid.number[2, 1], goal):
        enters = (model.successor[state] == goal) & (state != goal)
        assert model.reward[state] == pytest.approx(np.where(enters, -0.25 + 5 - 2, -0.25))


def edited(path: str, value: Any) -> dict[str, Any]:
    node = arguments = given("four_rooms")
    *way, last = path.split(".")
    for part in way:
        node = node[part]
    node[last] = value
    return arguments


@pytest.mark.parametrize(
    ("path", "value", "text"),
    [
        ("map", "...\n..", "row 1"),
        ("map", "..G", "unknown symbol"),
        ("slip", "often", r"a number in \[0, 1\)"),
        ("parameters.goals.accurate", [], "at least one goal"),
        ("parameters.goals.accurate", [{"cell": [0, 0], "reward": 1.0}], "not a wall"),
        ("parameters.goals.accurate", [{"cell": [1, 99], "reward": 1.0}], "not a wall"),
        ("parameters.goals.accurate", [{"cell": [-2, 1], "reward": 1.0}], "not a wall"),
        ("parameters.goals.accurate", [{"cell": [13, 1], "reward": 1.0}], "not a wall"),
        ("parameters.goals.accurate", [{"cell": [1, -2], "reward": 1.0}], "not a wall"),
        ("parameters.goals.accurate", [{"cell": [1, 1, 1], "reward": 1.0}], "not a wall"),
        ("parameters.goals.accurate", [{"cell": [1.5, 1], "reward": 1.0}], "not a wall"),
        ("parameters.goals.accurate", [{"cell": "11", "reward": 1.0}], "not a wall"),
        ("parameters.goals.accurate", [{"cell": [1, 1]}], "reward"),
        ("parameters.goals.inaccurate", [[1, 1]], "cell"),
        ("parameters.goals.inaccurate", 3, "a list"),
        ("parameters.discount.inaccurate", 1.0, r"\(0, 1\)"),
        ("parameters.discount.accurate", None, r"a number in \(0, 1\)"),
        ("parameters.step_cost.accurate", "high", "finite number"),
        ("parameters.penalty_cells.inaccurate", [[6, 6]], "not a wall"),
        ("parameters.penalty_cells.inaccurate", "door", "a list"),
        ("parameters.penalty.inaccurate", float("inf"), "finite number"),
        ("parameters.penalty.message", " ", "a sentence"),
        ("parameters.wind", {}, "unknown"),
        ("parameters", {}, "at least one"),
    ],
)
def test_bad_input_is_one_clear_line(path: str, value: Any, text: str) -> None:
    with pytest.raises(InputError, match=text) as caught:
        FourRooms(**edited(path, value))
    assert caught.value.key.startswith("domain.")
    assert "\n" not in str(caught.value)


def test_a_goal_behind_walls_is_refused() -> None:
    """The four doors are walls, so that the rooms are separate."""
    rows = [list(row) for row in given("four_rooms")["map"].splitlines()]
    for row, column in DOORS:
        rows[row][column] = "#"
    arguments = edited("map", "\n".join("".join(row) for row in rows))
    goals, penalty_cells = (arguments["parameters"][name] for name in ("goals", "penalty_cells"))
    goals["accurate"] = [{"cell": [1, 8], "reward": 5.0}]
    goals["inaccurate"] = [{"cell": [1, 9], "reward": 5.0}]
    penalty_cells["accurate"], penalty_cells["inaccurate"] = [[1, 1]], [[1, 2]]
    with pytest.raises(InputError, match="no path from the start to the goal"):
        FourRooms(**arguments)
