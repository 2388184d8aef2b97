"""Properties of domains against a corridor worked out by hand, and enumeration."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.domains.configs import domain_of, setting_of
from tests.domains.properties import (
    count_traces,
    inexplicable_alone,
    on_policy_traces,
    problems,
    share_through,
)
from tests.domains.rescue_maps import random_map
from tests.domains.users.corridor import Corridor
from xplain.domains.mdp import MDP
from xplain.domains.users.setting import Setting, UserType
from xplain.randomness import stream

LEFT, TOLL = UserType("left", {"end": "left"}), UserType("toll", {"toll": -5.0})


def walk(*cells: int) -> np.ndarray:
    """To the right through these cells of the corridor."""
    return np.array([[s, 1, s + 1] for s in cells])


def test_the_corridor_is_as_by_hand() -> None:
    """Who thinks the end is left finds every step puzzling; who fears the toll, worth five rewards
    and due from cell 2 to 3, that step alone: left of it nothing is to be gained, right of it
    nothing is to be feared."""
    domain = Corridor()
    setting = Setting.build(domain, (LEFT, TOLL))
    traces = [walk(1, 2, 3, 4), walk(2, 3, 4), walk(3, 4), walk(4)]
    found = problems(setting, traces)
    assert found.smallest.tolist() == [[1, 1], [1, 1], [1, 0], [1, 0]]
    # Silence: type "left" labels 0 each of m transitions, m + … + 1 times in all: 10, 6, 3, 1.
    # Type "toll" labels 0 the step from cell 2: shown 3 times, 3 times, never, never.
    assert found.worth.tolist() == [[True, True], [True, True], [True, False], [False, False]]
    assert found.tables == 4
    assert found.commonest == 0.25
    assert found.puzzling == 0.5
    assert inexplicable_alone(domain, traces) == {"end": 1.0, "toll": pytest.approx(2 / 10)}


def test_traces_that_differ_in_what_nobody_doubts_are_one_problem() -> None:
    setting = Setting.build(Corridor(), (TOLL,))
    found = problems(setting, [walk(3, 4), walk(4), walk(2, 3, 4), walk(2, 3), walk(1, 2)])
    assert found.tables == 2
    assert found.commonest == pytest.approx(3 / 5)


def smallest_and_silence(table: np.ndarray) -> tuple[int, int]:
    """Of label table [m, 2^n]: messages of the smallest set that leaves nothing inexplicable, and
    the cost of silence by Definition 2 (C_inexp = 1)."""
    explained = np.flatnonzero(table.all(axis=0))
    smallest = min(int(h).bit_count() for h in explained)
    shown = len(table) - np.arange(len(table))
    return smallest, int(((1 - table[:, 0].astype(int)) * shown).sum())


@pytest.mark.parametrize("choice", ["rescue", "four_rooms"])
def test_the_smallest_sets_and_their_worth_are_as_one_by_one(choice: str) -> None:
    setting = setting_of(f"domain={choice}")
    traces = on_policy_traces(setting, 30, stream(0, "test"))
    found = problems(setting, traces)
    for trace, small, worth in zip(traces, found.smallest, found.worth, strict=True):
        for t, table in enumerate(setting.label_table(trace)):
            size, silence = smallest_and_silence(table)
            assert small[t] == size
            assert worth[t] == all(x * size < silence for x in (0.5, 1, 1.5, 2, 2.5))


def enumerated(setting: Setting, max_length: int) -> set[tuple[tuple[int, int, int], ...]]:
    """All traces, one by one."""
    model, optimal = setting.models[0], setting.optimal[0]
    found = set()
    todo: list[tuple[int, tuple[tuple[int, int, int], ...]]]
    todo = [(int(s), ()) for s in setting.domain.starts]
    while todo:
        state, so_far = todo.pop()
        if model.terminal[state] or len(so_far) == max_length:
            found.add(so_far)
            continue
        for a in np.flatnonzero(optimal[state]):
            for k in np.flatnonzero(model.probability[state, a]):
                after = int(model.successor[state, a, k])
                todo.append((after, (*so_far, (state, int(a), after))))
    return found


@pytest.mark.parametrize("max_length", [1, 4, 6])
@pytest.mark.parametrize("choice", ["rescue", "frozen_lake"])
def test_traces_are_counted_as_if_one_by_one(choice: str, max_length: int) -> None:
    """Frozen lake slips, also against its edges, where two outcomes are one transition."""
    if choice == "frozen_lake":
        pytest.importorskip("gymnasium")
    setting = setting_of(f"domain={choice}")
    assert count_traces(setting, max_length) == len(enumerated(setting, max_length))


@pytest.mark.parametrize("starts", [[0], [0, 1], [0, 0, 1]])
def test_any_number_of_traces_is_counted(starts: list[int]) -> None:
    """Four ways at each of 40 steps: more than a machine word holds; each start once."""
    model = MDP(
        np.ones((2, 4, 1), dtype=np.int64),
        np.ones((2, 4, 1)),
        np.zeros((2, 4, 1)),
        0.9,
        np.zeros(2, dtype=bool),
    )
    domain = SimpleNamespace(starts=np.array(starts))
    reachable = np.array([(state, action, 1) for state in (0, 1) for action in range(4)])
    setting: Any = SimpleNamespace(models=[model], reachable=reachable, domain=domain)
    assert count_traces(setting, 40) == len(set(starts)) * 4**40


def test_traces_are_the_robots_own() -> None:
    setting = setting_of("domain=rescue")
    traces = on_policy_traces(setting, 20, stream(0, "test"), 6)
    assert {tuple(map(tuple, trace.tolist())) for trace in traces} <= enumerated(setting, 6)


def test_a_door_is_passed_only_between_start_and_end() -> None:
    domain = domain_of("domain=four_rooms")
    right = domain.actions.index("right")
    cells = [domain.grid.number[3, column] for column in range(4, 9)]
    way = np.array([[s, right, t] for s, t in pairwise(cells)])
    door = {(3, 6)}
    assert share_through(domain, [way, way[:2], way[2:], way[:3]], door) == 0.5
    assert share_through(domain, [way[1:]], door) == 1  # after a single step


@pytest.mark.parametrize("seed", range(5))
def test_a_random_map_holds_what_it_should(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(50):
        rows = random_map(rng).splitlines()
        assert [len(row) for row in rows] == [6] * 6
        symbols = "".join(rows)
        assert all(symbols.count(one) == 1 for one in "SVAFU")
        assert all(1 <= symbols.count(obstacle) <= 3 for obstacle in "rpf")
        assert symbols.count("#") <= 9
        assert set(symbols) <= set("SVAFUrpf#.")


def test_every_thing_may_be_drawn_anywhere() -> None:
    """A thousand maps: the shelter lies in each of 36 cells about as often (6 standard errors)."""
    rng = np.random.default_rng(0)
    at = [random_map(rng).replace("\n", "").index("S") for _ in range(1000)]
    share = np.bincount(at, minlength=36) / 1000
    assert share == pytest.approx(np.full(36, 1 / 36), abs=6 * (1 / 36 / 1000) ** 0.5)
