"""Compares properties of domains with a corridor, computed by hand, and with enumeration."""

from __future__ import annotations

import numpy as np
import pytest

from tests.domains.configs import setting_of
from tests.domains.properties import (
    count_traces,
    inexplicable_alone,
    on_policy_traces,
    problems,
)
from tests.domains.users.corridor import Corridor
from xplain.domains.users.setting import Setting, UserType
from xplain.randomness import stream

LEFT, TOLL = UserType("left", {"end": "left"}), UserType("toll", {"toll": -5.0})


def walk(*cells: int) -> np.ndarray:
    """To the right through these cells of the corridor."""
    return np.array([[s, 1, s + 1] for s in cells])


def test_the_corridor_is_as_by_hand() -> None:
    """People who believe that the goal is on the left find every step inexplicable. People who
    believe in the toll, which costs five rewards from cell 2 to 3, find only this step
    inexplicable: left of it nothing can be gained, and right of it there is no toll."""
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


def smallest_and_silence(table: np.ndarray) -> tuple[int, int]:
    """Returns for a label table [m, 2^n] the size of the smallest set that leaves nothing
    inexplicable, and the cost of silence by Definition 2 (C_inexp = 1)."""
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
