"""When a search stops, and what it takes until then: each limit on its far side."""

from __future__ import annotations

import itertools
import logging

import numpy as np
import pytest

from xplain.explanation.problem import Problem
from xplain.solvers.hsvi import explore as module
from xplain.solvers.hsvi.explore import Effort, Explored, _Search, explore
from xplain.solvers.hsvi.search import Start
from xplain.solvers.hsvi.solver import tables_within
from xplain.solvers.hsvi.tree import OPENED, store_bytes
from xplain.solvers.memory import GIB
from xplain.testing.problems import with_questions

HARD = Problem(np.random.default_rng(0).random((4, 8, 16)), np.full(4, 0.5))
"""Far from closed after thousands of beliefs."""


def searched(problem: Problem, effort: Effort, **options: object) -> Explored:
    small, tables = tables_within(problem, 8.0)
    return explore(tables, Start(0, 0, small.prior), effort, **options)  # type: ignore[arg-type]


def gap_of(found: Explored) -> float:
    return found.upper - found.lower


@pytest.mark.parametrize("nodes", [1, 40, 500])
def test_no_more_beliefs_are_opened_than_allowed_but_for_one_trial(nodes: int) -> None:
    found = searched(HARD, Effort(gap=1e-9, nodes=nodes))
    assert nodes <= found.store.used[OPENED] < nodes + HARD.n_steps


def test_time_ends_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that goes on by a second whenever it is looked at."""
    clock = itertools.count()
    monkeypatch.setattr(module.time, "perf_counter", lambda: float(next(clock)))
    monkeypatch.setattr(module, "CHUNK", 100)
    found = searched(HARD, Effort(gap=1e-9, nodes=3000, seconds=5))
    assert found.store.used[OPENED] < 1000
    assert gap_of(found) > 1e-9


def test_memory_ends_a_search(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    begun = store_bytes(searched(HARD, Effort(gap=1e-9, nodes=1)).store)
    memory = 5 * begun / GIB
    found = searched(HARD, Effort(gap=1e-9, nodes=20_000, memory_gib=memory))
    assert begun < store_bytes(found.store) <= memory * GIB
    assert "memory_gib" in caplog.text
    assert gap_of(found) > 1e-9


def test_room_grows_with_the_answers_of_an_action() -> None:
    """Ten unlike labels have 1,024 answers, more than there is room for at first. They are worth
    waiting for: each type needs another message at the last step."""
    p = np.random.default_rng(0).uniform(0.3, 0.7, (2, 11, 4))
    p[0, 10], p[1, 10] = [0.1, 0.9, 0.1, 0.9], [0.1, 0.1, 0.9, 0.9]
    small, tables = tables_within(Problem(p, np.full(2, 0.6), 2.0), 8.0)
    effort = Effort(gap=1e-9, memory_gib=0.5)
    found = explore(tables, Start(9, 0, small.prior), effort)
    assert found.store.actions["n_answers"].max() == 1024
    assert gap_of(found) <= 1e-9


def test_whoever_listens_hears_the_gap_of_the_root_shrink(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CHUNK", 500)
    problem = Problem(np.random.default_rng(4).random((3, 5, 4)), np.full(2, 0.5))
    heard: list[float] = []
    found = searched(problem, Effort(gap=1e-6), told=heard.append)
    assert len(heard) > 2
    assert all(later <= earlier + 1e-12 for earlier, later in itertools.pairwise(heard))
    assert heard[-1] == gap_of(found) <= 1e-6 < heard[0]


@pytest.mark.parametrize("questions", [False, True])
def test_one_pass_brings_all_that_was_learned_to_the_root(
    monkeypatch: pytest.MonkeyPatch, questions: bool
) -> None:
    """What follows comes first: a second pass moves the root hardly any more."""
    monkeypatch.setattr(module, "CHUNK", 300)
    moved = []
    for seed in range(6):
        problem = Problem(np.random.default_rng(seed).random((4, 8, 16)), np.full(4, 0.5))
        if questions:
            problem = with_questions(np.random.default_rng(seed), problem)
        small, tables = tables_within(problem, 8.0)
        search = _Search(tables, Start(0, 0, small.prior), Effort(gap=1e-9, nodes=5000))
        search.sample()
        search.sample()
        gaps = [search.gap]
        for _ in range(2):
            search.back_up_all()
            gaps.append(search.gap)
        moved.append(gaps[0] - gaps[1])
        assert gaps[1] - gaps[2] <= 0.01 * moved[-1] + 1e-9
    assert max(moved) > 0.01
