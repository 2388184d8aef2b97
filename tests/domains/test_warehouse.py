"""The warehouse: facts of any number, each of which matters somewhere, and few of them on a way."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from tests.domains.configs import setting_of
from xplain.domains.users.setting import Setting, UserType
from xplain.domains.users.types import FewFacts
from xplain.domains.warehouse import BLOCK, Warehouse, size_for
from xplain.errors import InputError


@cache
def one_fact_each(facts: int) -> Setting:
    """A type for each fact, which holds it alone wrong."""
    warehouse = Warehouse(facts)
    types = tuple(UserType(p.name, {p.name: p.inaccurate}) for p in warehouse.parameters)
    return Setting.build(warehouse, types)


@pytest.mark.parametrize("facts", [2, 10, 40, 62])
def test_each_fact_matters_on_a_few_of_the_robots_ways(facts: int) -> None:
    setting = one_fact_each(facts)
    labels = setting.labels_by_type(setting.reachable)
    for j, own in enumerate(labels.effective()):
        assert own == (j,)
        wrong = float((labels.p[:, 0, j] == 0).mean())
        assert wrong <= 0.4, f"{setting.types[j].name} makes {wrong:.0%} inexplicable"
        assert labels.p[:, 1, j].all()


def test_the_map_is_the_smallest_with_a_stretch_for_each_fact() -> None:
    for facts in range(2, 63):
        high, wide = size_for(facts)
        assert high * (wide - 1) + (high - 1) * wide >= facts
        smaller = (high, wide - 1) if wide > high else (high - 1, wide)
        if min(smaller) > 1:
            assert smaller[0] * (smaller[1] - 1) + (smaller[0] - 1) * smaller[1] < facts
    warehouse = Warehouse(40)
    assert warehouse.grid.shape == (4 * BLOCK + 1, 4 * BLOCK + 1)
    assert len(warehouse.parameters) == 40
    assert len({p.message for p in warehouse.parameters}) == 40


def test_a_lane_is_one_way_in_peoples_minds_only_against_the_robots_way() -> None:
    warehouse = Warehouse(10)
    accurate = {p.name: p.accurate for p in warehouse.parameters}
    robot = warehouse.model(accurate)
    for parameter in warehouse.parameters:
        theirs = warehouse.model(accurate | {parameter.name: parameter.inaccurate})
        changed = np.argwhere(theirs.reward != robot.reward)
        ways = {warehouse.actions[a] for _, a, _ in changed}
        if parameter.name.startswith("lane"):
            assert ways == {warehouse.stretches[parameter.name].way}
        else:
            assert len(ways) == 2


def test_the_robot_takes_a_shortest_way() -> None:
    """All moves cost the same: on its ways it drives right and down alone."""
    setting = one_fact_each(10)
    ways = {setting.domain.actions[a] for a in setting.reachable[:, 1]}
    assert ways == {"right", "down"}


def test_each_layout_is_another() -> None:
    ways = [
        tuple((name, s.cells) for name, s in Warehouse(10, layout).stretches.items())
        for layout in (0, 1, 2, 0)
    ]
    assert ways[0] == ways[3]
    assert len(set(ways)) == 3


def test_kinds_come_as_often_as_said_and_are_numbered_each_from_one() -> None:
    """Of five facts two are wet, two are lanes, and one charges."""
    names = [p.name for p in Warehouse(15).parameters]
    numbers = {"wet": 6, "lane": 6, "charger": 3}
    assert set(names) == {f"{kind}_{i + 1}" for kind, n in numbers.items() for i in range(n)}


@pytest.mark.parametrize("slip", [0.0, 0.2])
def test_each_fact_costs_where_its_stretch_is_entered(slip: float) -> None:
    """A drive costs 1; on a stretch held wrong that much more, or for a charger less; a bump
    enters nothing. Two facts held wrong are both counted."""
    warehouse = Warehouse(10, slip=slip, wet=3.0, against=1.5, charge=0.25)
    held = {p.name: p.inaccurate for p in warehouse.parameters}
    assert set(held.values()) == {-3.0, -1.5, 0.25}
    model = warehouse.model(held)
    for s, a, k in np.ndindex(model.reward.shape):
        after, expected = int(model.successor[s, a, k]), -1.0
        for name, stretch in warehouse.stretches.items():
            enters = after != s and warehouse.position(after) in stretch.cells
            moved = np.subtract(warehouse.position(after), warehouse.position(s)).tolist()
            ahead = moved == {"right": [0, 1], "down": [1, 0]}[stretch.way]
            asked = warehouse.actions[a] == stretch.way
            if enters and (not name.startswith("lane") or asked):
                assert ahead or slip or not name.startswith("lane")
                expected += held[name]
        assert model.reward[s, a, k] == pytest.approx(expected)


def test_phrases_and_pictures_name_the_stretch() -> None:
    warehouse = Warehouse(10)
    drawn = {
        (cell, label)
        for item in warehouse.scene.items
        if item.symbol != "D"
        for cell, label in zip(item.cells, item.labels, strict=True)
    }
    for name, stretch in warehouse.stretches.items():
        kind, number = name.split("_")
        symbol = {"wet": "≈", "charger": "+", "lane": {"right": "←", "down": "↑"}[stretch.way]}
        assert {(cell, symbol[kind] + number) for cell in stretch.cells} <= drawn
        before = warehouse.grid.number[stretch.cells[0]]
        after = warehouse.grid.number[stretch.cells[1]]
        step = np.array([before, warehouse.actions.index(stretch.way), after])
        said = f"drives {stretch.way} on {name} at {stretch.cells[1]}"
        assert warehouse.describe(step) == said
    assert len(drawn) == 2 * 10


@pytest.mark.parametrize(
    ("key", "value"),
    [("facts", 63), ("facts", 1), ("facts", 4.5), ("layout", -1), ("wet", 0.0), ("against", -1),
     ("charge", 1.0), ("charge", 0.0), ("discount", 1.0), ("slip", 1.0)],
)  # fmt: skip
def test_bad_values_are_named(key: str, value: Any) -> None:
    with pytest.raises(InputError) as caught:
        Warehouse(**{"facts": 10, key: value})
    assert caught.value.key == f"domain.{key}"


def test_types_hold_few_facts_and_differ() -> None:
    setting = setting_of("domain=warehouse")
    assert len(setting.types) == 6
    assert all(2 <= len(t.inaccurate) <= 6 for t in setting.types)
    assert len(set(setting.distinct.tolist())) == 6
    with pytest.raises(InputError, match=r"users\.most"):
        FewFacts(2, most=11).types(Warehouse(10), np.random.default_rng(0))
    with pytest.raises(InputError, match=r"users\.most"):
        FewFacts(2, fewest=3, most=2)
