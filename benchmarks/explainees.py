"""Measures explanations to people who err, miss messages or forget them (docs/people-who-err.md).

    python benchmarks/explainees.py errors     answers that are the opposite of what is thought
    python benchmarks/explainees.py learned    the same, with types and rates learned from answers
    python benchmarks/explainees.py found      messages that are missed, with types from answers
    python benchmarks/explainees.py earlier    … with rates learned from earlier explanations
    python benchmarks/explainees.py optimum    proven bounds of the lowest expected cost
    python benchmarks/explainees.py --quick    a smoke run

Types and labels are true (except in "learned" and "found"), λ = 1 without discount, in both of the
paper's domains; costs count true labels. Every row has the same people, and differences are paired
by seed.
"""

import argparse
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from questions import MAPS, domain_of

from xplain.experiment.config import compose_config
from xplain.experiment.explanations import Costs, evaluate, problem_of_types
from xplain.experiment.from_config import components_of, costs_of
from xplain.experiment.pipeline import PreparedData, prepare
from xplain.explanation.belief import BeliefUpdate, Independent, Persistent
from xplain.explanation.habits import PAPER, Assumed, Habits, habits_of
from xplain.explanation.label_table import LabelTable
from xplain.explanation.listening import ExplanationRecord, learn_habits
from xplain.interaction.explainees import Exact, Explainee, Heedless, SimulatedUser, Slips
from xplain.interaction.metrics import Record
from xplain.interaction.statistics import clustered_mean
from xplain.solvers.base import Solver
from xplain.solvers.bounds import bounds
from xplain.solvers.greedy import QMDP
from xplain.solvers.hsvi import Effort
from xplain.solvers.lookahead import Lookahead

DOMAINS = ("rescue", "four_rooms")
SEEDS = range(9300, 9312)
POINTS = (0.8, 0.0), (0.8, 0.1)
"""α and φ of people who miss messages, and of people who also forget them."""
TRUE = "labeler=truth", "clusterer=perfect"
SMALL = "max_steps=3", "users.count=2"
"""Changes for a smoke run."""
FLOOR = 0.002
"""The minimum probability of an answer if an explainer knows only that errors exist."""


@dataclass(frozen=True)
class Halves(Explainee):
    """People of two kinds: half never err, and half err at one rate."""

    rate: float
    repeats: bool

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> SimulatedUser:
        """Makes a person who errs at every second seed."""
        who: Explainee = Slips(self.rate, self.repeats) if seed % 2 else Exact()
        return who.meet(labels, same, seed)


class World(NamedTuple):
    """The types, traces and costs of one seed."""

    prepared: PreparedData
    costs: Costs
    seed: int

    def meets(self, explainee: Explainee, belief: BeliefUpdate, solver: Solver) -> list[Record]:
        """Runs the episodes of one explainer with these people."""
        own = {"solver": solver}
        return evaluate(self.prepared, self.costs, own, belief, explainee, self.seed)


def worlds(name: str, seeds: Iterable[int], traces: int, *source: str) -> Iterator[World]:
    """Makes a world for each seed, of a domain or of a random map."""
    domain = "rescue" if "rescue" in name else "four_rooms"
    for seed in seeds:
        fixed = (f"domain={domain}", "discount=1", f"traces={traces}", f"seed={seed}")
        cfg = compose_config("config", [*fixed, *source])
        components = replace(components_of(cfg), domain=domain_of(name, seed))
        yield World(prepare(components), costs_of(cfg), seed)


def floored(world: World) -> World:
    """Returns the same world with label probabilities from FLOOR to 1 − FLOOR."""
    cases = tuple(
        replace(case, learned=replace(case.learned, p=case.learned.p.clip(FLOOR, 1 - FLOOR)))
        for case in world.prepared.cases
    )
    return world._replace(prepared=replace(world.prepared, cases=cases))


def cost(records: list[Record]) -> float:
    """Returns the mean cost of an episode."""
    return float(np.mean([record.episode.cost for record in records]))


def log_score(records: list[Record]) -> float:
    """Returns the mean log of the final belief in the true type."""
    return float(np.mean([np.log(max(r.right_belief[-1], 1e-12)) for r in records]))


def figure(values: list[float]) -> str:
    """Formats a mean over seeds, with half of its 95 % interval."""
    found = clustered_mean(values, range(len(values)))
    return f"{found.mean:.2f} ± {(found.high - found.low) / 2:.2f}"


def ratio(over: list[float], under: list[float]) -> str:
    """Formats the ratio of two means, with the upper end of its 95 % interval over resampled
    seeds."""
    rng, pairs = np.random.default_rng(0), np.array([over, under])
    drawn = pairs[:, rng.integers(pairs.shape[1], size=(2000, pairs.shape[1]))].mean(axis=2)
    top = np.quantile(drawn[0] / drawn[1], 0.975)
    return f"{pairs[0].mean() / pairs[1].mean():.3f} (≤ {top:.3f})"


def errors(seeds: Iterable[int], traces: int, *small: str, maps: Sequence[str] = DOMAINS) -> None:
    """Prints the table of wrong answers."""
    people: dict[str, tuple[Explainee, Habits]] = {"never": (Exact(), PAPER)}
    for repeats in (False, True):
        how = "repeated mistakes" if repeats else "independent mistakes"
        for rate in (0.1, 0.3):
            people[f"{rate:.0%}, {how}"] = Slips(rate, repeats), habits_of(rate, 1.0, 0.0)
        both = Habits(np.array([0.0, 0.3]), np.ones(2), np.zeros(2), np.full(2, 0.5))
        people[f"half of them 30%, {how}"] = Halves(0.3, repeats), both
    kinds: tuple[Callable[..., BeliefUpdate], ...] = (Independent, Persistent)
    print(
        "| users err | evidence | as the paper | floor | told | learned | learned / told |", end=""
    )
    print(" log score: floor | told | learned |\n|---|---|---|---|---|---|---|---|---|---|")
    for domain in maps:
        print(f"| **{domain.replace('_', ' ')}** |" + " |" * 9)
        found: dict[tuple[str, str, str], list[tuple[float, float]]] = defaultdict(list)
        for world in worlds(domain, seeds, traces, *TRUE, *small):
            for name, (explainee, habits) in people.items():
                knowing = world._replace(prepared=replace(world.prepared, habits=habits))
                for update in kinds:
                    ways = {
                        "paper": (world, update()),
                        "floor": (floored(world), update()),
                        "told": (knowing, update("learned")),
                        "learned": (world, update("learned")),
                    }
                    for way, (what, belief) in ways.items():
                        records = what.meets(explainee, belief, QMDP())
                        key = name, update.__name__.lower(), way
                        found[key].append((cost(records), log_score(records)))
        for name in people:
            for update in kinds:
                kind = update.__name__.lower()
                ways_ = ("paper", "floor", "told", "learned")
                own = {way: list(zip(*found[name, kind, way], strict=True)) for way in ways_}
                costs = [figure(list(own[way][0])) for way in ways_]
                score = [f"{np.mean(own[way][1]):.2f}" for way in ways_[1:]]
                against = ratio(list(own["learned"][0]), list(own["told"][0]))
                print(f"| {name} | {kind} | {' | '.join([*costs, against, *score])} |", flush=True)


def learned(seeds: Iterable[int], traces: int, *small: str, maps: Sequence[str] = DOMAINS) -> None:
    """Prints the table with types from 20 chosen questions, answered at the same error rate."""
    print("| answers wrong | as the paper | told | learned | learned / told | rate learned |")
    print("|---|---|---|---|---|---|")
    for domain in maps:
        print(f"| **{domain.replace('_', ' ')}** |" + " |" * 5)
        for rate in (0.0, 0.1, 0.3):
            found: dict[str, list[float]] = defaultdict(list)
            options = ("labeler=hypotheses", "queries=adaptive", "points=20")
            noise = f"observers.label_noise={rate}"
            for world in worlds(domain, seeds, traces, *options, noise, *small):
                explainee = Slips(rate, repeats=True)
                ways: dict[str, Assumed] = {"paper": 0.0, "told": rate, "learned": "learned"}
                for way, error in ways.items():
                    records = world.meets(explainee, Persistent(error), QMDP())
                    found[way].append(cost(records))
                habits = world.prepared.habits
                assert habits is not None
                found["rate"].append(float(habits.error @ habits.prior))
            cells = [figure(found[way]) for way in ways]
            cells += [ratio(found["learned"], found["told"]), f"{np.mean(found['rate']):.3f}"]
            print(f"| {rate:.0%} | {' | '.join(cells)} |", flush=True)


def found(seeds: Iterable[int], traces: int, *small: str, maps: Sequence[str] = MAPS) -> None:
    """Prints the table of missed messages, with types from 20 chosen questions."""
    print("| α, φ | rates | true types | types found | found / true |\n|---|---|---|---|---|")
    asked = ("labeler=hypotheses", "queries=adaptive", "points=20", "observers.label_noise=0.05")
    ways = "told", "learned"
    for name in maps:
        print(f"| **{name.replace('_', ' ')}** |" + " |" * 4)
        costs: dict[tuple[float, float, str, str], list[float]] = defaultdict(list)
        for types, source in (("true", TRUE), ("found", asked)):
            for world in worlds(name, seeds, traces, *source, *small):
                for (accept, forget), way in product(POINTS, ways):
                    rates: tuple[Assumed, Assumed] = (accept, forget)
                    belief = Independent(0.0, *(rates if way == "told" else ("learned",) * 2))
                    records = world.meets(Heedless(accept, forget), belief, QMDP())
                    costs[accept, forget, way, types].append(cost(records))
        for (accept, forget), way in product(POINTS, ways):
            true, own = (costs[accept, forget, way, types] for types in ("true", "found"))
            cells = f"{figure(true)} | {figure(own)} | {ratio(own, true)}"
            print(f"| {accept:g}, {forget:g} | {way} | {cells} |", flush=True)


def earlier(seeds: Iterable[int], traces: int, *small: str, maps: Sequence[str] = DOMAINS) -> None:
    """Prints the table with rates learned from earlier explanations, in the world of the previous
    seed. An explainer that *weighs* the rates has a belief about them."""
    print("| α, φ | told | weighed | learned from people before |", end="")
    print(" weighed / told | learned / told | α, φ, error learned |\n|---|---|---|---|---|---|---|")
    weighs = Independent(0.0, "learned", "learned")
    for domain in maps:
        print(f"| **{domain.replace('_', ' ')}** |" + " |" * 6)
        costs: dict[tuple[float, float, str], list[float]] = defaultdict(list)
        before: dict[tuple[float, float], Habits] = {}
        for world in worlds(domain, [min(seeds) - 1, *seeds], traces, *TRUE, *small):
            problems = [
                problem_of_types(world.prepared, case, world.costs, Independent())
                for case in world.prepared.cases
            ]
            for accept, forget in ((1.0, 0.0), (0.8, 0.0), (1.0, 0.1), (0.8, 0.1)):
                people = Heedless(accept, forget)
                records = world.meets(people, weighs, QMDP())
                if known := before.get((accept, forget)):
                    knowing = world._replace(prepared=replace(world.prepared, habits=known))
                    costs[accept, forget, "weighed"].append(cost(records))
                    for way, own, belief in (
                        ("told", world, Independent(0.0, accept, forget)),
                        ("learned", knowing, weighs),
                    ):
                        costs[accept, forget, way].append(cost(own.meets(people, belief, QMDP())))
                    for key in ("accept", "forget", "error"):
                        mean = float(getattr(known, key) @ known.prior)
                        costs[accept, forget, key].append(mean)
                before[accept, forget] = learn_habits(
                    [
                        ExplanationRecord(
                            problems[one.trace],
                            one.episode.messages.tolist(),
                            [row[row >= 0].astype(np.uint8) for row in one.episode.labels],
                        )
                        for one in records
                    ]
                )
        for accept, forget in before:
            by = {key: costs[accept, forget, key] for key in ("told", "weighed", "learned")}
            cells = [figure(own) for own in by.values()]
            cells += [ratio(by[way], by["told"]) for way in ("weighed", "learned")]
            means = (np.mean(costs[accept, forget, key]) for key in ("accept", "forget", "error"))
            cells.append(", ".join(f"{mean:.3f}" for mean in means))
            print(f"| {accept:g}, {forget:g} | {' | '.join(cells)} |", flush=True)


def optimum(seeds: Iterable[int], traces: int, *small: str, maps: Sequence[str] = DOMAINS) -> None:
    """Prints the table of proven bounds of the expected cost if an explainer knows α and φ."""
    print("| α, φ | as the paper | QMDP | lookahead | optimum: at least | at most |", end="")
    print(" at least / paper | at most / paper |\n|---|---|---|---|---|---|---|---|")
    for domain in maps:
        print(f"| **{domain.replace('_', ' ')}** |" + " |" * 7)
        costs: dict[tuple[float, float, str], list[float]] = defaultdict(list)
        for world in worlds(domain, seeds, traces, *TRUE, *small):
            for accept, forget in POINTS:
                knowing, people = Independent(0.0, accept, forget), Heedless(accept, forget)
                ways: tuple[tuple[str, BeliefUpdate, Solver], ...] = (
                    ("paper", Independent(), QMDP()),
                    ("qmdp", knowing, QMDP()),
                    ("lookahead", knowing, Lookahead()),
                )
                for way, belief, solver in ways:
                    costs[accept, forget, way].append(cost(world.meets(people, belief, solver)))
                effort = Effort(gap=0.01, nodes=2000)
                found = [
                    bounds(problem_of_types(world.prepared, case, world.costs, knowing), effort)
                    for case in world.prepared.cases
                ]
                costs[accept, forget, "least"].append(-float(np.mean([p.upper for p in found])))
                costs[accept, forget, "most"].append(-float(np.mean([p.lower for p in found])))
        for accept, forget in POINTS:
            names = ("paper", "qmdp", "lookahead", "least", "most")
            by = {way: costs[accept, forget, way] for way in names}
            cells = [figure(own) for own in by.values()]
            cells += [f"{np.mean(by[way]) / np.mean(by['paper']):.3f}" for way in names[3:]]
            print(f"| {accept:g}, {forget:g} | {' | '.join(cells)} |", flush=True)


TABLES = {table.__name__: table for table in (errors, learned, found, earlier, optimum)}


def main() -> None:
    """Prints the table asked for, as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="?", choices=tuple(TABLES))
    parser.add_argument("--quick", action="store_true", help="a smoke run")
    options = parser.parse_args()
    for name, table in TABLES.items():
        if options.quick or options.what == name:
            seeds = range(10) if table is optimum else SEEDS  # the seeds of sweeps=again
            if options.quick:
                table(seeds[:1], 1, *SMALL, maps=["four_rooms"])
            else:
                table(seeds, 8)


if __name__ == "__main__":
    main()
