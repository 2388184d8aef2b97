"""A session kept as text between any two requests goes on as one that never stopped."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from xplain.explanation.asking import Limits, Question
from xplain.explanation.belief import Independent, Persistent
from xplain.interaction.explainer import Explainer, GivenTypes
from xplain.interaction.session import Say, Session
from xplain.solvers.base import Solver
from xplain.solvers.greedy import QMDP
from xplain.solvers.hsvi import Certified
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.pomcp import POMCP
from xplain.solvers.simple import QHR

SOLVERS = [QMDP(), POMCP(simulations=200), Certified(nodes=100), Lookahead(), QHR()]
LISTENING = [(0.0, 1.0, 0.0), (0.1, 1.0, 0.0), (0.1, 0.7, 0.2)]


def explainer_of(rng: np.random.Generator, solver: Solver, habits: Any, asks: bool) -> Explainer:
    """Three types that need other messages for each of eight transitions."""
    needed = rng.integers(4, size=(3, 8, 1))
    table = np.where(needed & ~np.arange(4) == 0, 0.95, 0.1)
    update = (Independent, Persistent)[rng.integers(2)](*habits)
    return Explainer(
        GivenTypes(table, ("a", "b"), ("x", "y", "z")),
        solver,
        trade_off=float(rng.choice([0.2, 0.6])),
        belief_update=update,
        ask=Limits(cost=0.02) if asks else None,
    )


def requests(session: Session, explainer: Explainer, seed: int, restored: bool) -> list[Any]:
    """What a session answers to requests, one after the other; the trace grows on the way."""
    rng, seen, ahead = np.random.default_rng(seed), list[Any](), [5, 6]
    while len(seen) < 60:
        if restored:
            session = explainer.from_json(session.to_json())
        if session.finished:
            if not ahead:
                break
            session.extend([ahead.pop()])
        move = session.next()
        if restored:
            session = explainer.from_json(session.to_json())
        seen.append((move, session.belief, session.said, session.cost, str(session.why())))
        if restored:
            session = explainer.from_json(session.to_json())
        if isinstance(move, Question):
            session.answer(int(rng.integers(2)))
        elif not isinstance(move, Say):
            if ahead and rng.random() < 0.3:
                session.extend([ahead.pop()])
                continue  # while labels are awaited
            session.observe(rng.integers(2, size=move.steps))
    assert session.finished
    return seen


@pytest.mark.parametrize("asks", [False, True])
@pytest.mark.parametrize("habits", LISTENING)
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_restored_session_goes_on_as_one_that_never_stopped(
    solver: Solver, habits: tuple[float, float, float], asks: bool
) -> None:
    for seed in range(3):
        explainer = explainer_of(np.random.default_rng(seed), solver, habits, asks)
        clips = [3, 7] if asks else []
        one, other = (explainer.session([0, 1, 2], clips=clips) for _ in range(2))
        whole = requests(one, explainer, seed, restored=False)
        assert requests(other, explainer, seed, restored=True) == whole
        assert len(whole) > 3
