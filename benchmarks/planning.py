"""Measures planning time against the size of the problem, and the certified gap against time.

    python benchmarks/planning.py            some minutes
    python benchmarks/planning.py --quick    some seconds

Random problems have the form of the pipeline's: every type believes two of n facts incorrectly, up
to two facts matter at a transition, the transition is explicable to a type that knows these facts,
and a type's labeler has one confidence. Times are medians of repeats in one process with compiled
kernels.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.table import Table

from xplain.explanation.actions import VisibleState
from xplain.explanation.problem import Problem
from xplain.solvers.base import GIB
from xplain.solvers.evaluate import evaluate
from xplain.solvers.greedy import QMDP
from xplain.solvers.hsvi import Certified, CertifiedPolicy
from xplain.solvers.process import known_bytes, known_values, make_process


def facts_problem(m: int, n: int, types: int, seed: int = 0, trade_off: float = 1.0) -> Problem:
    """Makes a problem of m steps and n messages, as described above."""
    rng = np.random.default_rng(seed)
    sets = np.arange(1 << n)
    bearing = [set(rng.choice(n, rng.integers(0, 3), replace=False)) for _ in range(m)]
    p = np.empty((types, m, 1 << n))
    for t in range(types):
        lacking = set(rng.choice(n, 2, replace=False))
        confidence = rng.uniform(0.9, 0.99)
        for i, facts in enumerate(bearing):
            needed = sum(1 << int(j) for j in facts & lacking)
            p[t, i] = np.where(sets & needed == needed, confidence, 1 - confidence)
    return Problem(p, np.ones(n), trade_off=trade_off)


def median_seconds(work: Callable[[], object], repeats: int) -> float:
    """Measures the median seconds of several calls."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def tables(quick: bool, repeats: int) -> Table:
    """Measures QMDP's tables and one decision while one size varies around (20, 12, 5)."""
    shown = Table("steps", "messages", "types", "tables (s)", "GiB", "decision (ms)", title="QMDP")
    sizes = [(20, n, 5) for n in ((4,) if quick else (4, 8, 12, 16, 18, 20))]
    sizes += [(m, 12, 5) for m in (5, 10, 40)] + [(20, 12, types) for types in (2, 10, 20)]
    for m, n, types in sizes:
        problem = facts_problem(m, n, types)
        seconds = median_seconds(
            lambda p=problem: known_values(make_process(p)), 1 if n > 16 else repeats
        )
        policy = QMDP().plan(problem)
        decision = median_seconds(
            lambda q=policy, p=problem: q.decide(VisibleState(), p.prior), 5 * repeats
        )
        gib = known_bytes(problem) / GIB
        shown.add_row(
            str(m), str(n), str(types), f"{seconds:.4f}", f"{gib:.3f}", f"{1e3 * decision:.2f}"
        )
    return shown


def certified(quick: bool, seeds: int) -> Table:
    """Measures the time until the gap is closed, over random problems of a size."""
    shown = Table(
        "steps", "messages", "types", "gap asked", "closed", "median (s)", "worst (s)",
        title="certified: tables and search, λ ∈ {0.5, 1, 2}",
    )  # fmt: skip
    sizes = [(8, 6, 5, 1e-3), (15, 8, 5, 1e-3), (10, 10, 5, 1e-3), (20, 10, 8, 1e-2)]
    for m, n, types, gap in sizes[: 1 if quick else 4]:
        times, closed = [], 0
        for seed in range(seeds):
            for trade_off in (0.5, 1.0, 2.0):
                problem = facts_problem(m, n, types, seed, trade_off)
                solver = Certified(gap=gap, seconds=0.1 if quick else 30)
                began = time.perf_counter()
                policy = solver.plan(problem)
                times.append(time.perf_counter() - began)
                assert isinstance(policy, CertifiedPolicy)
                closed += policy.upper - policy.lower <= gap
        shown.add_row(
            str(m), str(n), str(types), f"{gap:g}", f"{closed} of {len(times)}",
            f"{statistics.median(times):.4f}", f"{max(times):.3f}",
        )  # fmt: skip
    return shown


def gap_against_time(quick: bool) -> Table:
    """Measures the bounds of one hard problem over time, and QMDP's value."""
    problem = facts_problem(15, 8, 5, seed=2, trade_off=1.0)
    worth = evaluate(problem, QMDP().plan(problem))
    title = f"certified on one hard (15, 8, 5); QMDP's value {worth.value:.4f} ({worth.value_is})"
    shown = Table("seconds", "lower", "upper", "gap", title=title)
    for seconds in (0.01,) if quick else (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0):
        policy = Certified(gap=1e-6, seconds=seconds).plan(problem)
        assert isinstance(policy, CertifiedPolicy)
        lower, upper = policy.lower, policy.upper
        shown.add_row(f"{seconds:g}", f"{lower:.5f}", f"{upper:.5f}", f"{upper - lower:.5f}")
    return shown


def main() -> None:
    """Prints the three tables."""
    parser = argparse.ArgumentParser(description="planning time and certified gaps")
    parser.add_argument("--quick", action="store_true", help="a smoke test of some seconds")
    quick = parser.parse_args().quick
    Certified().plan(facts_problem(15, 8, 5))  # compiles
    console = Console()
    console.print(tables(quick, 1 if quick else 3))
    console.print(certified(quick, 1 if quick else 3))
    console.print(gap_against_time(quick))


if __name__ == "__main__":
    main()
