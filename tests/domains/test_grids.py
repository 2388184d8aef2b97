"""Compares the rescue task with its rules, written by hand, and four rooms with its values; bad
input of both."""

from collections import Counter
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
import pytest

from tests.domains.configs import domain_of, given
from tests.refusals import refused
from xplain.domains.four_rooms import DOORS, FourRooms
from xplain.domains.rescue import Rescue

REWARD = {"A": "first_aid", "F": "fire", "U": "refuel", "r": "rubble", "p": "puddle", "f": "fence"}
MAP = """
sApF
.#.f
SVrU
"""
ROWS = MAP.strip().split("\n")


def parameters(**inaccurate: float) -> dict[str, dict[str, Any]]:
    values = {name: 1.0 if symbol.isupper() else 0.0 for symbol, name in REWARD.items()}
    return {
        name: {"accurate": value, "inaccurate": inaccurate.get(name, -1.0), "message": name}
        for name, value in values.items()
    }


def rescue(**changes: Any) -> Rescue:
    given = {"map": MAP, "parameters": parameters(), "rescue_reward": 5.0, "discount": 0.9}
    return Rescue(**given | changes)


class Rules:
    """The rules in plain Python: cell, bonuses done, rewards; ``+`` uses the item in the cell."""

    def __init__(self, start: tuple[int, int], rows: Sequence[str] = ROWS) -> None:
        self.cell, self.rows, self.ended = start, rows, False
        self.done: set[str] = set()

    @property
    def here(self) -> str:
        return self.rows[self.cell[0]][self.cell[1]]

    def can_act(self) -> bool:
        return self.here in "AFUV" and self.here not in self.done

    def play(self, action: str) -> float:
        """Applies an action; returns the reward."""
        if action == "+":
            self.done.add(self.here)
            return VALUES.get(REWARD.get(self.here, ""), 0.0)
        (r, c), (dr, dc) = self.cell, STEPS[action]
        inside = 0 <= r + dr < len(self.rows) and 0 <= c + dc < len(self.rows[0])
        if not inside or self.rows[r + dr][c + dc] == "#":
            return 0.0
        self.cell = r + dr, c + dc
        self.ended = self.here == "S" and "V" in self.done
        entered = VALUES[REWARD[self.here]] if self.here in "rpf" else 0.0
        return entered + (5.0 if self.ended else 0.0)


STEPS = {"u": (-1, 0), "d": (1, 0), "l": (0, -1), "r": (0, 1)}
USE = {"A": "pick_up_first_aid", "F": "extinguish_fire", "U": "refuel", "V": "pick_up_victim"}
MOVES = {"u": "up", "d": "down", "l": "left", "r": "right"}
VALUES = {name: 0.25 * (i + 1) for i, name in enumerate(REWARD.values())}


@pytest.mark.parametrize("seed", range(20))
def test_the_model_plays_by_the_rules(seed: int) -> None:
    """Walks of 300 actions, or to the shelter, start in every cell in turn; together they meet
    walls and edges from every kind of cell, with and without the victim."""
    rows = [row[:: (-1) ** seed] for row in ROWS]  # each second map is its mirror image
    domain, rng = rescue(map="\n".join(rows)), np.random.default_rng(seed)
    cells = len(domain.grid.cells)
    state = len(domain.state_features) // cells * (seed % cells)
    model, rules = domain.model(VALUES), Rules(domain.position(state), rows)
    for _ in range(300):
        assert np.count_nonzero(model.probability[state, 4:]) == rules.can_act()
        letter = str(rng.choice([*"udlr", *("++" if rules.can_act() else "")]))
        name = USE[rules.here] if letter == "+" else MOVES[letter]
        action = domain.actions.index(name)
        assert model.probability[state, action].tolist() == [1.0]
        assert model.reward[state, action, 0] == pytest.approx(rules.play(letter)), letter
        state, before = int(model.successor[state, action, 0]), state
        assert not domain.describe(np.array([before, action, state])).startswith(
            "moves " if "V" in rules.done else "carries "
        )
        assert domain.position(state) == rules.cell
        assert len(domain.situation(state)) == len(rules.done)
        assert model.terminal[state] == rules.ended
        if rules.ended:
            break


def test_a_slip_goes_to_one_of_the_two_sides() -> None:
    """From every cell: 0.8 ahead, 0.1 to each side; a wall or the edge stops the robot."""
    domain = rescue(slip=0.2)
    model = domain.model(dict.fromkeys(REWARD.values(), 0.0))
    flags = model.n_states // len(domain.grid.cells)
    sides = {"u": "lr", "d": "lr", "l": "ud", "r": "ud"}
    for cell, (action, ahead) in product(range(len(domain.grid.cells)), enumerate("udlr")):
        expected: Counter[tuple[int, int]] = Counter()
        for letter, chance in zip([ahead, *sides[ahead]], [0.8, 0.1, 0.1], strict=True):
            rules = Rules(domain.position(cell * flags))
            rules.play(letter)
            expected[rules.cell] += chance
        reached: Counter[tuple[int, int]] = Counter()
        for after, p in zip(
            model.successor[cell * flags, action],
            model.probability[cell * flags, action],
            strict=True,
        ):
            reached[domain.position(after)] += p
        assert reached == pytest.approx(expected), (cell, ahead)


@pytest.mark.parametrize(
    ("changes", "key", "text"),
    [
        ({"map": "ssA\nss"}, "domain.map", "row 1 has 2 symbols"),
        ({"map": ""}, "domain.map", "one line for each row"),
        ({"map": 7}, "domain.map", "one line for each row"),
        ({"map": "##\n##"}, "domain.map", "not a wall"),
        ({"map": MAP.replace("#", "x")}, "domain.map", "unknown symbol in row 1, column 1"),
        ({"map": MAP.replace("S", ".")}, "domain.map", "exactly one shelter"),
        ({"map": MAP.replace(".", "S", 1)}, "domain.map", "exactly one shelter"),
        ({"map": MAP.replace("V", ".")}, "domain.map", "exactly one victim"),
        ({"map": MAP.replace("s", "A")}, "domain.map", "exactly one first_aid"),
        ({"map": MAP.replace("F", ".")}, "domain.map", "if and only if fire"),
        ({"map": "s#ApF\n##.f.\nSVrU."}, "domain.map", "no path from the start to the shelter"),
        ({"map": "s.pA#F\n..f##.\nSVrU#."}, "domain.map", "no path from the fire"),
        ({"map": "S#ApF\n##.fV\n.srU."}, "domain.map", "no path from the victim"),
        ({"parameters": {}}, "domain.parameters", "at least one"),
        ({"parameters": {"wind": {}}}, "domain.parameters", "unknown"),
        ({"parameters": {"fire": {"accurate": 1}}}, "domain.parameters.fire", "lacks inaccurate"),
        ({"parameters": parameters(fire=float("nan"))}, "domain.parameters.fire", "finite"),
        ({"parameters": parameters(fire=1.0)}, "domain.parameters.fire", "differs"),
        ({"parameters": parameters(fire="much")}, "domain.parameters.fire", "finite number"),
        ({"rescue_reward": 0}, "domain.rescue_reward", "a number > 0"),
        ({"discount": 1.0}, "domain.discount", r"\(0, 1\)"),
        ({"discount": 0.0}, "domain.discount", r"\(0, 1\)"),
        ({"discount": "high"}, "domain.discount", r"a number in \(0, 1\)"),
        ({"slip": 1.5}, "domain.slip", r"a number in \[0, 1\)"),
        ({"slip": -0.1}, "domain.slip", r"a number in \[0, 1\)"),
        ({"slip": 1.0}, "domain.slip", r"a number in \[0, 1\)"),
        ({"slip": True}, "domain.slip", r"a number in \[0, 1\)"),
    ],
)
def test_bad_input_of_rescue_is_one_clear_line(changes: dict, key: str, text: str) -> None:
    with refused(text, key):
        rescue(**changes)


def test_the_scene_shows_every_item_in_its_place() -> None:
    scene = rescue().scene
    assert (scene.rows, scene.columns, scene.walls) == (3, 4, ((1, 1),))
    drawn = {item.symbol: item.cells for item in scene.items}
    assert drawn == {
        symbol: tuple((r, c) for r in range(3) for c in range(4) if ROWS[r][c] == symbol)
        for symbol in "SVAFUrpf"
    }
    assert {item.name for item in scene.items if item.symbol in "SVr"} == {
        "shelter", "victim", "rubble",
    }  # fmt: skip


def test_what_happened_and_what_is_gone_are_told_of_every_combination() -> None:
    """Flags are in the order first aid, fire, fuel, victim. A fuel station stays."""
    domain = rescue()
    flags = len(domain.state_features) // len(domain.grid.cells)
    done = ["picked up the first aid", "fire is out", "refuelled", "carries the victim"]
    taken = ["first aid", "fire", None, "victim"]
    for state in range(2 * flags):
        happened = [bool(state % flags >> bit & 1) for bit in range(4)]
        expected = [words for words, h in zip(done, happened, strict=True) if h]
        said = zip(domain.situation(state), expected, strict=True)
        assert all(words in sentence for sentence, words in said)
        assert domain.gone(state) == tuple(
            name for name, h in zip(taken, happened, strict=True) if h and name
        )


FOUR_ROOMS = "domain=four_rooms"


def test_the_map_is_the_published_one() -> None:
    grid = domain_of(FOUR_ROOMS).grid
    assert grid.shape == (13, 13)
    assert len(grid.cells) == 104
    inner_walls = [(r, 6) for r in range(1, 12)]
    inner_walls += [(6, c) for c in range(1, 6)] + [(7, c) for c in range(7, 12)]
    doors = {cell for cell in inner_walls if grid.number[cell] >= 0}
    assert doors == {*DOORS} == {(3, 6), (10, 6), (6, 2), (7, 9)}


@pytest.mark.parametrize("slip", [0.0, 0.2])
def test_the_model_follows_the_values(slip: float) -> None:
    """Rewards are for entering, and add up: the goal is a penalty cell too. Moves that bump into a
    wall do not enter."""
    domain = FourRooms(**edited("slip", slip))
    values = {p.name: p.accurate for p in domain.parameters} | {
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
def test_bad_input_of_four_rooms_is_one_clear_line(path: str, value: Any, text: str) -> None:
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
