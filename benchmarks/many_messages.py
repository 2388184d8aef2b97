"""Measures time and memory against messages, steps and types, with tables by type and dense tables.

    python benchmarks/many_messages.py            some minutes
    python benchmarks/many_messages.py --quick    some seconds

Random problems have the form of the pipeline's: each of n facts matters at a few neighbouring
transitions or at none, every type believes some facts incorrectly, and its labeler has one
confidence. Seconds are CPU time, the minimum of some repeats in one process with compiled kernels.
Memory is the peak of what Python and numpy allocate (tracemalloc), without the problem's table.
"""

import argparse
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.table import Table

from xplain.errors import TooLargeError
from xplain.explanation.actions import Action, VisibleState
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.solvers.base import Solver, messages_of
from xplain.solvers.greedy import QMDP
from xplain.solvers.hsvi import Certified, CertifiedPolicy
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.pomcp import POMCP, Search


def problem_of(
    steps: int, messages: int, types: int, facts: int, seed: int = 0, bearing: int = 3
) -> Problem:
    """Makes a problem in which each type believes ``facts`` facts incorrectly, and up to
    ``bearing`` facts matter at a transition."""
    rng = np.random.default_rng(seed)
    sets = np.arange(1 << facts)
    most = min(bearing, messages)
    about = [
        set(rng.choice(messages, rng.integers(0, most + 1), replace=False).tolist())
        for _ in range(steps)
    ]
    rows = np.stack([rng.permutation(messages)[:facts] for _ in range(types)])
    p = np.empty((types, steps, len(sets)))
    for t, row in enumerate(rows.tolist()):
        confidence = rng.uniform(0.9, 0.99)
        for i, own in enumerate(about):
            needed = sum(1 << b for b, j in enumerate(row) if j in own)
            p[t, i] = np.where(sets & needed == needed, confidence, 1 - confidence)
    return Problem(LabelTable.by_type(rows, p), np.ones(messages))


def seconds(work: Callable[[], object], repeats: int) -> float:
    """Measures the CPU seconds of the fastest of several calls, after one call that is not
    counted."""
    work()
    times = []
    for _ in range(repeats):
        began = time.process_time()
        work()
        times.append(time.process_time() - began)
    return min(times)


def mebibytes(work: Callable[[], object]) -> float:
    """Measures the peak memory of a call."""
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 2**20


def cells(solver: Solver, problem: Problem, repeats: int) -> tuple[str, str]:
    """Formats the milliseconds to plan and take the first decision, and MiB; or returns
    ``refused``."""

    def work() -> Action:
        return solver.plan(problem).decide(VisibleState(), problem.prior)

    try:
        return f"{1e3 * seconds(work, repeats):.2f}", f"{mebibytes(work):.2f}"
    except TooLargeError:
        return "refused", ""


def growth(quick: bool, repeats: int) -> Table:
    """Measures QMDP while one size varies: with tables by type, and with a dense table if it
    fits."""
    shown = Table(
        "steps", "messages", "types", "facts", "with effect", "by type (ms)", "MiB",
        "dense (ms)", "MiB", title="QMDP: plan and first decision",
    )  # fmt: skip
    sizes = [(20, n, 8, 6) for n in ((10, 40) if quick else (10, 14, 18, 20, 30, 40, 50, 60))]
    if not quick:
        sizes += [(m, 40, 8, 6) for m in (10, 50, 100, 200)]
        sizes += [(20, 40, types, 6) for types in (2, 16, 50)]
        sizes += [(20, 40, 8, facts) for facts in (2, 4, 8, 10)]
    for m, n, types, facts in sizes:
        problem = problem_of(m, n, types, facts)
        row = cells(QMDP(), problem, repeats)
        dense = ("", "")
        if n <= (14 if quick else 18):
            table = replace(problem, table=LabelTable.dense(problem.p_explicable))
            dense = cells(QMDP(), table, 1)
        worth = len(problem.messages_with_effect)
        shown.add_row(*map(str, (m, n, types, facts, worth)), *row, *dense)
    return shown


def solvers(quick: bool, repeats: int) -> Table:
    """Measures every solver of types on the sizes with goals of the project."""
    shown = Table(
        "solver", "steps", "messages", "types", "facts", "with effect", "plan, decide (ms)", "MiB",
        title="solvers",
    )  # fmt: skip
    for m, n, types, facts, bearing in ((20, 60, 8, 6, 3), (20, 60, 8, 6, 12), (12, 40, 5, 4, 3)):
        problem = problem_of(m, n, types, facts, bearing=bearing)
        worth = len(problem.messages_with_effect)
        for name, solver in (
            ("qmdp", QMDP()),
            ("pomcp", POMCP(simulations=3_000)),
            ("lookahead", Lookahead()),
        ):
            row = cells(solver, problem, repeats)
            shown.add_row(name, *map(str, (m, n, types, facts, worth)), *row)
    return shown


def pomcp_decisions(quick: bool) -> Table:
    """Measures POMCP with 3,000 simulations: a search, and a decision (a search for each message
    that is given, and a last search)."""
    shown = Table(
        "facts on a transition", "with effect", "messages per decision", "search (ms)",
        "decision (ms)", title="POMCP: 60 messages, 20 steps, 8 types of 6 facts, medians",
    )  # fmt: skip
    for bearing in (3, 6, 12):
        problem = problem_of(20, 60, 8, 6, bearing=bearing)
        policy = POMCP(simulations=3_000).plan(problem)
        assert isinstance(policy, Search)
        policy.decide(VisibleState(), problem.prior)
        rng = np.random.default_rng(0)
        said, searches, decisions = [], [], []
        for k in range(1 if quick else 12):
            belief = rng.dirichlet(np.ones(8))
            began = time.process_time()
            policy.search(VisibleState(k), 0, belief)
            searches.append(time.process_time() - began)
            began = time.process_time()
            said.append(messages_of(policy.decide(VisibleState(k), belief)).bit_count())
            decisions.append(time.process_time() - began)
        shown.add_row(
            f"up to {bearing}", str(len(problem.messages_with_effect)), f"{np.median(said):g}",
            f"{1e3 * np.median(searches):.2f}", f"{1e3 * np.median(decisions):.2f}",
        )  # fmt: skip
    return shown


def certified(quick: bool) -> Table:
    """Measures the search to a gap of 1e-2: 40 messages, 12 steps, 5 types of 4 facts."""
    shown = Table(
        "facts on a transition", "seed", "with effect", "gap", "seconds", title="certified to 0.01"
    )
    for bearing in (3, 6, 12):
        for seed in range(1 if quick else 3):
            problem = problem_of(12, 40, 5, 4, seed, bearing)
            began = time.process_time()
            policy = Certified(gap=1e-2, seconds=0.1 if quick else 30).plan(problem)
            spent = time.process_time() - began
            assert isinstance(policy, CertifiedPolicy)
            gap = policy.upper - policy.lower
            shown.add_row(
                f"up to {bearing}",
                str(seed),
                str(len(policy.found.kept)),
                f"{gap:.4f}",
                f"{spent:.2f}",
            )
    return shown


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    quick = parser.parse_args().quick
    console = Console(width=120)
    repeats = 1 if quick else 5
    for table in (
        growth(quick, repeats), solvers(quick, repeats), pomcp_decisions(quick), certified(quick)
    ):  # fmt: skip
        console.print(table)


if __name__ == "__main__":
    main()
