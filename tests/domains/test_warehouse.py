"""The warehouse: facts of any number, each of which matters somewhere, and few of them on a way."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from tests.domains.configs import setting_of
from xplain.domains.warehouse import BLOCK, Warehouse, size_for
from xplain.errors import InputError
from xplain.users.setting import Setting, UserType
from xplain.users.types import FewFacts


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
        wrong = float((labels.p[j, :, 0] == 0).mean())
        assert wrong <= 0.4, f"{setting.types[j].name} makes {wrong:.0%} inexplicable"
        assert labels.p[j, :, 1].all()


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
