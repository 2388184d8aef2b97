"""Compares POMCP with pomdp-py's POUCT and POMCP, in one run, on the same explanation problem.

    python benchmarks/pomcp.py            # some minutes; needs pip install 'xplain-hri[bench]'
    python benchmarks/pomcp.py --quick    # seconds; without pomdp-py if it is not installed

Problem, depth, actions, discount and exploration constant are the same. Rollouts are uniformly
random in pomdp-py, and follow QMDP at exact beliefs in our solver. The runs are interleaved, so
that other load on the machine affects all of them equally. The output has medians over the rounds,
and the median of the rounds' ratios. Times are CPU time of one core; the start-up also has wall
time. pomdp-py gets an efficient model: one black box (transition, observation and reward together),
every state, action and observation made once, expected rewards from a table, and only informative
labels are drawn. Its rollouts end at the depth; our rollouts go on to the end of the trace.
"""

import argparse
import random
import subprocess
import sys
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np

from xplain.explanation.actions import VisibleState
from xplain.explanation.problem import Problem
from xplain.solvers.pomcp import POMCP

DEPTHS = (2, 5, 20)
EXPLORATION = 10.0


def problem_of(steps: int = 20, messages: int = 10, types: int = 5, seed: int = 0) -> Problem:
    """Makes a problem like the paper's: each type believes two parameters incorrectly, each
    transition involves some of them, and labels are right with probability 0.98."""
    rng = np.random.default_rng(seed)
    sets = np.arange(1 << messages)
    wrong = [rng.choice(messages, 2, replace=False) for _ in range(types)]
    p = np.empty((types, steps, len(sets)))
    for i in range(steps):
        involved = rng.random(messages) < 0.5
        for t in range(types):
            needed = sum(1 << int(j) for j in wrong[t] if involved[j])
            p[t, i] = np.where(sets & needed == needed, 0.98, 0.02)
    return Problem(p, np.ones(messages))


def ours(problem: Problem, simulations: int, **settings: Any) -> Callable[[], float]:
    """Returns a function that measures the CPU seconds of one search, without planning (pomdp-py's
    model is also built before)."""
    policy: Any = POMCP(simulations=simulations, **settings).plan(problem)
    policy.search(VisibleState(), 0, problem.prior)

    def run() -> float:
        start = time.process_time()
        policy.search(VisibleState(), 0, problem.prior)
        return time.process_time() - start

    return run


def theirs(name: str, problem: Problem, simulations: int, depth: int) -> Callable[[], float]:
    """Returns the same function for a planner of pomdp-py."""
    import pomdp_py

    draw = random.Random(0).random
    n, steps = problem.n_messages, problem.n_steps

    class State(pomdp_py.State):  # type: ignore[misc]
        def __init__(self, step: int, given: int, user_type: int) -> None:
            self.step, self.given, self.user_type = step, given, user_type
            self.key = (step * (1 << n) + given) * problem.n_types + user_type
            self.after: list[State | None] = [None] * (n + 1)
            self.cost, self.news = 0.0, []
            if step < steps:
                p = problem.p_explicable[:, : step + 1, given]
                self.cost = float((1 - p[user_type]).sum())
                informative = np.flatnonzero((p != p[0]).any(axis=0))
                self.news = [(float(p[user_type, i]), 1 << int(i)) for i in informative]

        def __hash__(self) -> int:
            return self.key

        def __eq__(self, other: object) -> bool:
            return self is other

    class Action(pomdp_py.Action):  # type: ignore[misc]
        def __init__(self, index: int) -> None:
            self.index = index

        def __hash__(self) -> int:
            return self.index

        def __eq__(self, other: object) -> bool:
            return self is other

    class Observation(pomdp_py.Observation):  # type: ignore[misc]
        def __init__(self, zeros: int) -> None:
            self.zeros = zeros

        def __hash__(self) -> int:
            return self.zeros

        def __eq__(self, other: object) -> bool:
            return self is other

    states: dict[tuple[int, int, int], State] = {}
    observations: dict[int, Observation] = {}
    actions = [Action(a) for a in range(n + 1)]
    available = [
        tuple(a for a in actions if a.index == n or not given >> a.index & 1)
        for given in range(1 << n)
    ]
    price = [problem.trade_off * float(c) for c in problem.message_cost]
    nothing = Observation(-1)

    def state_of(step: int, given: int, user_type: int) -> State:
        key = (step, given, user_type)
        if key not in states:
            states[key] = State(*key)
        return states[key]

    class Model(pomdp_py.BlackboxModel):  # type: ignore[misc]
        def sample(self, state: State, action: Action) -> tuple[State, Observation, float, int]:
            index = action.index
            after = state.after[index]
            if after is None:
                step = min(state.step + (index == n), steps)
                given = state.given if index == n else state.given | 1 << index
                after = state.after[index] = state_of(step, given, state.user_type)
            if index < n:
                return after, nothing, -price[index], 1
            zeros = 0
            for p, bit in state.news:
                if draw() > p:
                    zeros |= bit
            seen = observations.get(zeros)
            if seen is None:
                seen = observations[zeros] = Observation(zeros)
            return after, seen, -state.cost, 1  # 1: number of steps that are discounted

    class Actions(pomdp_py.RolloutPolicy):  # type: ignore[misc]
        def get_all_actions(self, state: State, history: object = None) -> tuple[Action, ...]:
            return available[state.given]

        def rollout(self, state: State, history: object = None) -> Action:
            options = available[state.given]
            return options[int(draw() * len(options))]

        def sample(self, state: State) -> Action:
            return self.rollout(state)

    roots = [state_of(0, 0, t) for t in range(problem.n_types)]
    choose = Actions()

    def run() -> float:
        if name == "POMCP":
            belief = pomdp_py.Particles(roots * 200)
        else:
            belief = pomdp_py.Histogram(dict(zip(roots, problem.prior.tolist(), strict=True)))
        agent = pomdp_py.Agent(belief, choose, blackbox_model=Model())
        planner = getattr(pomdp_py, name)(
            max_depth=depth,
            discount_factor=problem.discount,
            num_sims=simulations,
            exploration_const=EXPLORATION,
            rollout_policy=choose,
        )
        start = time.process_time()
        planner.plan(agent)
        seconds = time.process_time() - start
        assert planner.last_num_sims == simulations
        return seconds

    return run


def rates(problem: Problem, rounds: int, many: int, few: int, compare: bool) -> None:
    """Prints the simulations per second at each depth."""
    print(f"\nsimulations per second ({problem.n_messages + 1} actions, {problem.n_steps} steps)")
    print("depth      paper's setting   our default   pomdp-py POUCT      POMCP   ratio to each")
    for depth in DEPTHS:
        same = {"depth": depth, "exploration": EXPLORATION}
        runs = {
            "paper": (ours(problem, many, backup="mean", **same), many),
            "default": (ours(problem, many, depth=depth), many),
        }
        if compare:
            for name in ("POUCT", "POMCP"):
                runs[name] = (theirs(name, problem, few, depth), few)
        found: dict[str, list[float]] = {name: [] for name in runs}
        for _ in range(rounds):
            for name, (run, count) in runs.items():
                found[name].append(count / run())
        line = f"{depth:5d} {median(found['paper']):20,.0f} {median(found['default']):13,.0f}"
        for name in ("POUCT", "POMCP"):
            line += f" {median(found[name]):12,.0f}" if compare else f" {'—':>12}"
        if compare:
            ratios = [
                median(a / b for a, b in zip(found["paper"], found[name], strict=True))
                for name in ("POUCT", "POMCP")
            ]
            line += "   " + ", ".join(f"{ratio:,.0f}×" for ratio in ratios)
        print(line, flush=True)


def short_searches(problem: Problem, rounds: int) -> None:
    """Measures whole calls from Python, with allocation."""
    print("\nmilliseconds per search of 2,000 simulations, and of 1 simulation")
    cases: list[tuple[str, dict[str, Any]]] = [
        (f"depth {d}, paper's setting", {"depth": d, "backup": "mean"}) for d in DEPTHS
    ]
    for name, settings in [*cases, ("our default", {})]:
        long, one = ours(problem, 2000, **settings), ours(problem, 1, **settings)
        times = [(long(), one()) for _ in range(10 * rounds)]
        print(
            f"{name:28s} {1e3 * median(a for a, _ in times):8.2f} "
            f"{1e3 * median(b for _, b in times):8.3f}",
            flush=True,
        )


def decisions(rounds: int) -> None:
    """Measures a decision of `Policy.decide` at our default: a search after each message."""
    print("\nour default: milliseconds to plan (tables), and for the first decision")
    print("messages  steps  types       plan   decision")
    for messages, steps, types in ((6, 10, 5), (6, 20, 5), (10, 20, 5), (10, 20, 8), (14, 20, 5)):
        problem = problem_of(steps, messages, types)
        planned, decided = [], []
        for seed in range(rounds):
            start = time.process_time()
            policy = POMCP().plan(problem, seed)
            planned.append(time.process_time() - start)
            start = time.process_time()
            policy.decide(VisibleState(), problem.prior)
            decided.append(time.process_time() - start)
        print(
            f"{messages:8d} {steps:6d} {types:6d} {1e3 * median(planned):10.1f} "
            f"{1e3 * median(decided):10.1f}",
            flush=True,
        )


FRESH = """
import time; start = time.perf_counter()
import numpy as np
from xplain.explanation.actions import VisibleState
from xplain.explanation.problem import Problem
from xplain.solvers.pomcp import POMCP
rng = np.random.default_rng(0)
problem = Problem(rng.random((5, 20, 1024)), np.ones(10))
POMCP(simulations=2000).plan(problem).decide(VisibleState(), problem.prior)
print(time.perf_counter() - start, time.process_time())
"""


def start_up(rounds: int) -> None:
    """Measures imports, first plan and first decision in new processes with compiled kernels."""
    found = []
    for _ in range(rounds + 1):
        done = subprocess.run(
            [sys.executable, "-c", FRESH], check=True, capture_output=True, text=True
        )
        found.append([float(x) for x in done.stdout.split()])
    wall, cpu = (median(column) for column in zip(*found[1:], strict=True))
    print(f"\nimports, first plan and decision in a new process: {wall:.2f} s ({cpu:.2f} s CPU)")


def main() -> None:
    """Runs all parts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a smoke run of few seconds")
    parser.add_argument("--rounds", type=int, default=7)
    options = parser.parse_args()
    rounds = 2 if options.quick else options.rounds
    many, few = (50_000, 200) if options.quick else (1_000_000, 5_000)
    try:
        import pomdp_py  # noqa: F401

        compare = True
    except ImportError:
        compare = False
        print("pomdp-py is not installed, its columns stay empty: pip install 'xplain-hri[bench]'")
        if not options.quick:
            sys.exit(1)
    problem = problem_of()
    rates(problem, rounds, many, few, compare)
    short_searches(problem, rounds)
    decisions(rounds)
    start_up(rounds)


if __name__ == "__main__":
    main()
