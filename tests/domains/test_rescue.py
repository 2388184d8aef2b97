"""Compares the rescue task with its rules, written by hand, and its map with docs/choices.md."""

from collections import Counter
from itertools import product
from typing import Any

import numpy as np
import pytest

from tests.refusals import refused
from xplain.domains.rescue import Rescue

RESCUE = "domain=rescue"
REWARD = {"A": "first_aid", "F": "fire", "U": "refuel", "r": "rubble", "p": "puddle", "f": "fence"}
MAP = """
sApF
.#.f
SVrU
"""


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

    def __init__(self, rows: list[str], start: tuple[int, int], values: dict[str, float]) -> None:
        self.rows, self.cell, self.values = rows, start, values
        self.done: set[str] = set()
        self.ended = False

    @property
    def here(self) -> str:
        return self.rows[self.cell[0]][self.cell[1]]

    def can_act(self) -> bool:
        return self.here in "AFUV" and self.here not in self.done

    def play(self, action: str) -> float:
        """Applies an action; returns the reward."""
        if action == "+":
            self.done.add(self.here)
            return self.values.get(REWARD.get(self.here, ""), 0.0)
        (r, c), (dr, dc) = self.cell, STEPS[action]
        inside = 0 <= r + dr < len(self.rows) and 0 <= c + dc < len(self.rows[0])
        if not inside or self.rows[r + dr][c + dc] == "#":
            return 0.0
        self.cell = r + dr, c + dc
        self.ended = self.here == "S" and "V" in self.done
        entered = self.values[REWARD[self.here]] if self.here in "rpf" else 0.0
        return entered + (RESCUE_REWARD if self.ended else 0.0)


STEPS = {"u": (-1, 0), "d": (1, 0), "l": (0, -1), "r": (0, 1)}
RESCUE_REWARD = 5.0
ROWS = MAP.strip().split("\n")
VALUES = {name: 0.25 * (i + 1) for i, name in enumerate(REWARD.values())}


def act(domain: Rescue, symbol: str) -> int:
    """Returns the action that uses the item in the cell."""
    wanted = {"A": "pick_up_first_aid", "F": "extinguish_fire", "U": "refuel"}
    return domain.actions.index(wanted.get(symbol, "pick_up_victim"))


def follow(domain: Rescue, rows: list[str], state: int, rng: np.random.Generator) -> None:
    """Follows a random walk of 300 actions, or to the shelter, in the model and by the rules."""
    model, rules = domain.model(VALUES), Rules(rows, domain.position(state), VALUES)
    for _ in range(300):
        assert np.count_nonzero(model.probability[state, 4:]) == rules.can_act()
        letter = str(rng.choice([*"udlr", *("++" if rules.can_act() else "")]))
        action = act(domain, rules.here) if letter == "+" else "udlr".index(letter)
        assert model.probability[state, action].tolist() == [1.0]
        assert model.reward[state, action, 0] == pytest.approx(rules.play(letter)), letter
        state = int(model.successor[state, action, 0])
        assert domain.position(state) == rules.cell
        assert len(domain.situation(state)) == len(rules.done)
        assert model.terminal[state] == rules.ended
        if rules.ended:
            break


@pytest.mark.parametrize("seed", range(20))
def test_the_model_plays_by_the_rules(seed: int) -> None:
    """Walks start in every cell in turn; together they meet walls and edges from every kind of
    cell, with and without the victim."""
    domain = rescue()
    cells = len(domain.grid.cells)
    start = len(domain.state_features) // cells * (seed % cells)
    follow(domain, ROWS, start, np.random.default_rng(seed))


def test_a_slip_goes_to_one_of_the_two_sides() -> None:
    """From every cell: 0.8 ahead, 0.1 to each side; a wall or the edge stops the robot."""
    domain = rescue(slip=0.2)
    model = domain.model(dict.fromkeys(REWARD.values(), 0.0))
    flags = model.n_states // len(domain.grid.cells)
    sides = {"u": "lr", "d": "lr", "l": "ud", "r": "ud"}
    for cell, (action, ahead) in product(range(len(domain.grid.cells)), enumerate("udlr")):
        expected: Counter[tuple[int, int]] = Counter()
        for letter, chance in zip([ahead, *sides[ahead]], [0.8, 0.1, 0.1], strict=True):
            rules = Rules(ROWS, domain.position(cell * flags), VALUES)
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
def test_bad_input_is_one_clear_line(changes: dict, key: str, text: str) -> None:
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
        said = domain.situation(state)
        assert len(said) == sum(happened)
        for sentence, words in zip(
            said, [w for w, h in zip(done, happened, strict=True) if h], strict=True
        ):
            assert words in sentence
        assert domain.gone(state) == tuple(
            name for name, h in zip(taken, happened, strict=True) if h and name
        )
