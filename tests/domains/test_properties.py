"""The shipped domains are real tasks: many different traces and problems (docs/choices.md)."""

import subprocess
import sys

import numpy as np
import pytest

from tests.conftest import ROOT
from tests.domains.configs import configured, setting_of
from tests.domains.properties import (
    count_traces,
    inexplicable_alone,
    on_policy_traces,
    problems,
    share_through,
)
from tests.domains.users.corridor import Corridor
from xplain import Setting, UserType, stream
from xplain.domains.base import cell_name
from xplain.domains.four_rooms import DOORS

FOUR_ROOMS, RESCUE = "domain=four_rooms", "domain=rescue"


def traces_of(domain: str) -> list[np.ndarray]:
    """Draws as many traces as the properties need."""
    return on_policy_traces(setting_of(domain), 200, stream(0, "domain properties"))


def test_four_rooms_is_a_real_task() -> None:
    """The robot walks through the rooms, and each fact that is believed incorrectly matters now and
    then. Drawn types, 2, 3 and 4 as in the paper, need about one message."""
    setting, traces = setting_of(FOUR_ROOMS), traces_of(FOUR_ROOMS)
    assert len(setting.reachable) >= 100
    assert count_traces(setting) >= 500
    assert np.mean([len(trace) for trace in traces]) >= 6
    assert share_through(setting.domain, traces, DOORS) >= 1 / 3
    alone = inexplicable_alone(setting.domain, traces)
    assert all(0.05 <= share <= 0.4 for share in alone.values()), alone
    found = [
        problems(setting_of(FOUR_ROOMS, f"users.count={count}", seed=seed), traces)
        for count in (2, 3, 4)
        for seed in range(2)
    ]
    assert 0.4 <= np.mean([p.smallest.mean() for p in found]) <= 1.2
    assert 1 / 4 <= np.mean([(p.smallest == 0).mean() for p in found]) <= 2 / 3


def test_rescue_is_a_real_task() -> None:
    """Traces need two facts early, give many different problems, and each fact matters."""
    setting, traces = setting_of(RESCUE), traces_of(RESCUE)
    found = problems(setting, traces)
    assert 1.5 <= found.smallest.mean() <= 2.0
    assert found.worth.mean() >= 0.95
    assert found.tables >= 15
    assert found.commonest <= 1 / 4
    assert found.puzzling <= 1 / 10
    alone = inexplicable_alone(setting.domain, traces)
    assert all(share >= 0.02 for share in alone.values()), alone


@pytest.mark.slow
def test_no_map_before_it_has_all_properties() -> None:
    script = [sys.executable, str(ROOT / "benchmarks" / "domains.py"), "--draw"]
    done = subprocess.run(script, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("map 794 of seed 0")
    assert done.stdout.endswith(configured(RESCUE).domain.map)


def test_columns_are_letters_however_many_there_are() -> None:
    """Names are those of spreadsheets: AA follows Z, AAA follows ZZ."""
    names = [cell_name(0, column) for column in (0, 25, 26, 51, 52, 701, 702)]
    assert names == ["A1", "Z1", "AA1", "AZ1", "BA1", "ZZ1", "AAA1"]
    assert cell_name(9, 1) == "B10"


LEFT, TOLL = UserType("left", {"end": "left"}), UserType("toll", {"toll": -5.0})


def walk(*cells: int) -> np.ndarray:
    """Makes a trace to the right through these cells of the corridor."""
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
    assert (found.tables, found.commonest, found.puzzling) == (4, 0.25, 0.5)
    assert count_traces(setting) == 4
    assert inexplicable_alone(domain, traces) == {"end": 1.0, "toll": pytest.approx(2 / 10)}
