"""Measures how long a robot waits for the explainer: decisions on a trace of 20 steps.

    python benchmarks/explainer.py [--quick]

Goals: a decision (``messages()``) takes at most 5 ms with qmdp and 50 ms with pomcp at its default
budget. The table has medians and 95th percentiles over the steps of many sessions: for the first
decision of a session, which includes the plan; for later decisions; for a new transition with the
next decision; and for the belief update.
"""

import sys
import time
from collections.abc import Callable

import numpy as np

from xplain import Explainer, GivenTypes
from xplain.solvers.base import Solver
from xplain.solvers.greedy import QMDP
from xplain.solvers.pomcp import POMCP
from xplain.solvers.simple import QHR

STEPS, TYPES = 20, 5
SOLVERS: dict[str, tuple[Solver, float]] = {
    "qmdp": (QMDP(), 5.0),
    "qhr": (QHR(), 5.0),
    "pomcp": (POMCP(), 50.0),
}


def main() -> None:
    """Prints the table."""
    sessions = 1 if "--quick" in sys.argv[1:] else 30
    print(f"{STEPS} steps, {TYPES} types, {sessions} sessions")
    print("milliseconds: median (95th percentile)\n")
    head = ("solver", "messages", "first decision", "decision", "goal", "growing", "observe")
    print("".join(f"{name:>18}" for name in head))
    for n in (6, 10):
        for name, (solver, goal) in SOLVERS.items():
            taken: dict[str, list[float]] = {key: [] for key in ("first", "next", "grow", "hear")}
            play(explainer(solver, n, 10**6), {key: [] for key in taken})  # compiles
            for seed in range(sessions):
                play(explainer(solver, n, seed), taken)
            cells = [f"{np.median(v):.2f} ({np.quantile(v, 0.95):.2f})" for v in taken.values()]
            row = (name, n, *cells[:2], f"≤ {goal:g}", *cells[2:])
            print("".join(f"{cell:>18}" for cell in row))


def explainer(solver: Solver, n: int, seed: int) -> Explainer:
    """Makes types that each need two of the messages, on a random trace, with labelers of
    confidence 0.95."""
    rng = np.random.default_rng(seed)
    given = np.arange(1 << n)
    about = rng.integers(n, size=STEPS)
    table = np.full((TYPES, STEPS, 1 << n), 0.95)
    for t in range(TYPES):
        for i in np.flatnonzero(np.isin(about, rng.choice(n, 2, replace=False))):
            table[t, i] = np.where(given >> about[i] & 1, 0.95, 0.05)
    names = tuple(f"m{j}" for j in range(n)), tuple(f"t{t}" for t in range(TYPES))
    return Explainer(GivenTypes(table, *names), solver, trade_off=1.5, seed=seed)


def play(one: Explainer, taken: dict[str, list[float]]) -> None:
    """Plays a session with a known trace, and a session whose trace grows step by step."""
    rng = np.random.default_rng(0)
    session = one.session(range(STEPS))
    while not session.finished:
        taken["next" if session.shown > 1 else "first"].append(timed(session.messages))
        labels = rng.random(session.shown) < 0.9
        taken["hear"].append(timed(lambda labels=labels: session.observe(labels)))
    growing = one.session(range(STEPS // 2))
    for i in range(STEPS // 2, STEPS):
        taken["grow"].append(timed(lambda i=i: growing.extend([i])) + timed(growing.messages))
        growing.observe(np.ones(growing.shown, dtype=int))


def timed(action: Callable[[], object]) -> float:
    """Measures the milliseconds of a call."""
    before = time.perf_counter()
    action()
    return 1e3 * (time.perf_counter() - before)


if __name__ == "__main__":
    main()
