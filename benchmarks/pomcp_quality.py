"""Measures the distance of POMCP's settings to the certified optimum, on problems like the paper's.

    python benchmarks/pomcp_quality.py                # minutes
    python benchmarks/pomcp_quality.py --problems 2   # a smoke run

With more simulations the paper's setting approaches a limit: two actions of exact expectimax, then
QMDP's value (d = 2). The table also shows the distance to this limit.

Tune with one --seed and report another, because the best of many settings looks better than it is
on the problems that chose it. Keys of pomcp_paper are set by --set exploration=2 and so on.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pomcp import problem_of

from xplain.experiment.config import compose_config
from xplain.experiment.from_config import component
from xplain.explanation.actions import Action, VisibleState, give
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem
from xplain.interaction.statistics import clustered_mean
from xplain.solvers.base import Knowledge, Solver, best_action, messages_of
from xplain.solvers.bounds import bounds
from xplain.solvers.evaluate import evaluate
from xplain.solvers.greedy import Greedy
from xplain.solvers.hsvi import Effort
from xplain.solvers.process import known_values, make_process, matters, outcomes

NEGLIGIBLE = 1e-4
"""Answers with a smaller probability get the value of known types."""


@dataclass(frozen=True)
class Limit:
    """The limit of POMCP with d = 2 actions: expectimax over two actions, then QMDP's value."""

    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> LimitPolicy:
        """Plans the limit's policy; see :class:`xplain.solvers.base.Solver`."""
        process = make_process(problem)
        return LimitPolicy(Greedy(process, known_values(process)))


@dataclass(frozen=True)
class LimitPolicy:
    """The policy of :class:`Limit`.

    Attributes:
        greedy: QMDP's policy.
    """

    greedy: Greedy

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """Adds the best message until *explain* is best; see
        :class:`xplain.solvers.base.Policy`."""
        chosen = 0
        while True:
            said = visible._replace(given=visible.given | chosen)
            new = messages_of(best_action(self.values(said, belief)))
            if not new:
                return give(chosen)
            chosen |= new

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Returns the values of *explain* and of each single message."""
        return self._compute_values(visible.step, visible.given, belief, 1)

    def _compute_values(
        self, step: int, said: int, weight: NDArray[np.float64], further: int
    ) -> dict[Action, float]:
        """Returns the values with this number of further actions before QMDP's value, multiplied by
        the sum of the weights."""
        process, known = self.greedy.process, self.greedy.known
        value = -float(weight @ process.explain_cost[step, process.cells.at(said)])
        if step + 1 < process.n_steps:
            found = outcomes(process, step, said, weight, NEGLIGIBLE)
            assert found is not None
            later = [self._maximise(step + 1, said, one, further) for one in found[0]]
            tail = float(found[1] @ known.now(step + 1, said))
            value += process.discount * (sum(later) + tail)
        values: dict[Action, float] = {give(0): value}
        for j in indices(matters(process, weight) & ~said):
            after = process.message_discount * self._maximise(step, said | 1 << j, weight, further)
            values[give(1 << j)] = after - process.price[j] * weight.sum()
        return values

    def _maximise(self, step: int, said: int, weight: NDArray[np.float64], further: int) -> float:
        if further:
            return max(self._compute_values(step, said, weight, further - 1).values())
        total = float(weight.sum())
        return total * max(self.greedy.values(VisibleState(step, said), weight / total).values())


def solver_of(choice: str, changes: list[str]) -> Solver:
    """Makes a solver of conf/solver/ with changes."""
    keys = [f"solver={choice}", *(f"solver.{change}" for change in changes)]
    solver: Solver = component(compose_config("config", keys), "solver")
    return solver


def main() -> None:
    """Prints mean regret and half of its 95 % interval."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--problems", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument("--only-paper", action="store_true", help="pomcp_paper and its limit")
    parser.add_argument("--quick", action="store_true", help="2 problems: only that it runs")
    options = parser.parse_args()
    if options.quick:
        options.problems = 2
    solvers: dict[str, Solver] = {
        "limit": Limit(),
        "pomcp_paper": solver_of("pomcp_paper", options.set),
    }
    if not options.only_paper:
        solvers |= {name: solver_of(name, []) for name in ("qmdp", "pomcp")}
    worth: dict[str, list[float]] = {name: [] for name in solvers}
    optimum, simulated = [], 0
    for number in range(options.problems):
        seed = 10_000 * options.seed + number
        problem = problem_of(6 + seed % 7, 6, 5, seed)
        if not options.only_paper:
            found = bounds(problem, Effort(gap=0.01, nodes=20_000))
            optimum.append((found.lower + found.upper) / 2)
        for name, solver in solvers.items():
            value = evaluate(problem, solver.plan(problem), 20_000, 400, precision=1e-3)
            simulated += value.value_is == "simulated"
            worth[name].append(value.value)
    _print_loss("pomcp_paper to its limit", np.subtract(worth["limit"], worth["pomcp_paper"]))
    if optimum:
        for name, values in worth.items():
            _print_loss(f"{name} to the optimum", np.subtract(optimum, values))
    print(f"{simulated} of {len(solvers) * options.problems} values simulated, the others exact")


def _print_loss(what: str, lost: NDArray[np.float64]) -> None:
    found = clustered_mean(lost, range(len(lost)))
    half = found.high - found.mean
    print(f"{what:27s} {found.mean:.3f} ± {half:.3f}, largest {max(lost):.3f}")


if __name__ == "__main__":
    main()
