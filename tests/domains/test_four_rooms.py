"""The four-rooms task: the published map, its five parameters, bad input."""

from typing import Any

import numpy as np
import pytest

from tests.domains.configs import domain_of, given
from tests.refusals import refused
from xplain.domains.four_rooms import DOORS, FourRooms

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


@pytest.mark.parametrize("slip", [0.0, 0.2])
def test_the_model_follows_the_values(slip: float) -> None:
    """Rewards are for entering, and add up: the goal is a penalty cell too. Moves that bump into a
    wall do not enter."""
    domain = FourRooms(**edited("slip", slip))
    values = accurate(domain) | {
        "goals": [{"cell": [1, 1], "reward": 5.0}],
        "discount": 0.9,
        "step_cost": 0.25,
        "penalty_cells": [[1, 1], [1, 2]],
        "penalty": 2.0,
    }
    model, (goal, penalty, beyond) = domain.model(values), domain.grid.number[1, [1, 2, 3]]
    assert model.discount == 0.9
    assert np.flatnonzero(model.terminal).tolist() == [goal]
    enters = model.successor != np.arange(model.n_states)[:, None, None]
    expected = 5.0 * (model.successor == goal) - 2 * np.isin(model.successor, [goal, penalty])
    assert model.reward == pytest.approx(enters * expected - 0.25)
    left, up = domain.actions.index("left"), domain.actions.index("up")
    path = [model.successor[beyond, left, 0], model.successor[penalty, left, 0]]
    assert path == [penalty, goal]
    assert model.successor[penalty, up, 0] == penalty


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
    with refused(text, "domain."):
        FourRooms(**edited(path, value))


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
    with refused("no path from the start to the goal"):
        FourRooms(**arguments)
