"""Measures the quality and the time of each solver's explanations.

    python benchmarks/time_to_quality.py            # tens of minutes
    python benchmarks/time_to_quality.py --quick    # seconds

The random problems have three sizes (types, messages that matter, steps). Each solver explains the
same traces to the same users, whose labels are drawn once. The output has CPU milliseconds to plan
and for a decision, and the cost of an explanation minus QMDP's (mean and standard error over
problems; less than 0 is better). ``certified`` searches until the gap is 1 % of the value of a
known type. If a solver refuses a size, its row says why.
"""

import argparse
import time
from collections.abc import Iterator

import numpy as np
from many_messages import problem_of
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from xplain.errors import TooLargeError
from xplain.explanation.belief import Independent
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.interaction.episode import explain
from xplain.interaction.explainees import SimulatedUser
from xplain.solvers.base import CachedPolicy, Solver
from xplain.solvers.bounds import known_type_value
from xplain.solvers.greedy import QMDP, Baseline, Conformant
from xplain.solvers.hsvi import Certified
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.pomcp import POMCP
from xplain.solvers.simple import QHR, SayAll, Silent

SIZES = ((5, 6, 12, 2), (20, 16, 40, 4), (50, 48, 40, 4))
"""Types, messages, steps, and facts that a type believes incorrectly."""


def solvers_of(problem: Problem) -> dict[str, Solver]:
    """Makes every solver that does not need the user's type."""
    gap = 0.01 * abs(known_type_value(problem))
    return {
        "qmdp": QMDP(),
        "lookahead": Lookahead(),
        "pomcp": POMCP(),
        "certified to 1 %": Certified(gap=max(gap, 1e-9), seconds=60),
        "baseline": Baseline(),
        "conformant": Conformant(),
        "qhr": QHR(),
        "say_all": SayAll(),
        "silent": Silent(),
    }


def users_of(problem: Problem, count: int, seed: int) -> Iterator[SimulatedUser]:
    """Makes users of types drawn from the prior, with labels drawn once."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        table = problem.table.of_types([int(rng.choice(problem.n_types, p=problem.prior))])
        labels = (rng.random(table.p.shape) < table.p).astype(float)
        yield SimulatedUser(LabelTable(table.relevant, labels))


def measured(
    problem: Problem, solver: Solver, users: list[SimulatedUser]
) -> tuple[float, float, NDArray[np.float64]]:
    """Measures milliseconds to plan and for a decision, and the cost of each user's explanation."""
    began = time.process_time()
    policy = CachedPolicy(solver.plan(problem))
    planned = time.process_time()
    costs = [explain(problem, policy, user, Independent()).cost for user in users]
    decisions = len(users) * problem.n_steps
    return (
        1e3 * (planned - began),
        1e3 * (time.process_time() - planned) / decisions,
        np.array(costs),
    )


def table_of(size: tuple[int, int, int, int], problems: int, users: int, seed: int) -> Table:
    """Makes the rows of one size."""
    types, messages, steps, facts = size
    shown = Table(title=f"({types} types, {messages} messages, {steps} steps)")
    for column in ("solver", "plan ms", "most", "decision ms", "cost − qmdp's", "problems"):
        shown.add_column(column, justify="left" if column == "solver" else "right")
    found: dict[str, list[tuple[float, float, float]]] = {}
    refused: dict[str, str] = {}
    for number in range(problems):
        problem = problem_of(steps, messages, types, facts, seed + number)
        people, reference = list(users_of(problem, users, number)), np.zeros(users)
        for name, solver in solvers_of(problem).items():
            if number == 0:  # compiles; this time does not count
                try:
                    measured(problem, solver, people[:1])
                except TooLargeError as error:
                    refused[name] = str(error)
            if name in refused:
                continue
            plan, decide, costs = measured(problem, solver, people)
            if name == "qmdp":
                reference = costs
            found.setdefault(name, []).append((plan, decide, float((costs - reference).mean())))
    for name, rows in found.items():
        plans, decisions, worse = np.array(rows).T
        spread = worse.std(ddof=1) / len(worse) ** 0.5 if len(worse) > 1 else float("nan")
        shown.add_row(
            name,
            f"{np.median(plans):0.1f}",
            f"{plans.max():0.1f}",
            f"{np.median(decisions):0.2f}",
            f"{worse.mean():+0.2f} ± {spread:0.2f}",
            str(len(rows)),
        )
    for name, why in refused.items():
        shown.add_row(name, "refused", "", "", "", why.partition(":")[0])
    return shown


def main() -> None:
    """Prints a table for each size."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="one small problem of each size")
    parser.add_argument("--problems", type=int, default=10)
    parser.add_argument("--users", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sizes", type=int, nargs="+", default=range(len(SIZES)))
    options = parser.parse_args()
    for number in options.sizes:
        types, messages, steps, facts = SIZES[number]
        size, counts = (types, messages, steps, facts), (options.problems, options.users)
        if options.quick:
            size, counts = (types, messages, 4, facts), (1, 1)
        Console(width=110).print(table_of(size, *counts, options.seed))


if __name__ == "__main__":
    main()
