"""Measures the savings by questions of the explainer (docs/asking.md), for several kinds of people,
and the time of a decision.

    python benchmarks/asking.py table     cost against the price of a question, by solver
    python benchmarks/asking.py learned   with types learned from 20 chosen questions, 5 % wrong
    python benchmarks/asking.py errors    if one answer in ten is wrong
    python benchmarks/asking.py again     if messages may be missed or forgotten
    python benchmarks/asking.py speed     milliseconds of a decision with 150 clips
    python benchmarks/asking.py --quick   a smoke run

λ is 1, without discount; clips show everything that the robot can do; costs count true labels.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from explainees import DOMAINS, World, cost, figure, ratio
from questions import domain_of

from xplain.experiment.config import compose_config
from xplain.experiment.from_config import components_of, costs_of
from xplain.experiment.pipeline import prepare
from xplain.explanation.asking import Limits, When
from xplain.explanation.belief import BeliefUpdate, Independent, Persistent
from xplain.explanation.habits import Assumed
from xplain.interaction.explainees import Exact, Explainee, Heedless, Slips
from xplain.interaction.metrics import Record
from xplain.solvers.base import Solver
from xplain.solvers.greedy import QMDP, KnownType
from xplain.solvers.hsvi import Certified
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.pomcp import POMCP
from xplain.solvers.simple import QHR, AskFirst

PRICES = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
TRACES = {"rescue": 5, "four_rooms": 6}
"""Cases of seed 0 whose optimum with all questions before the first step is known from another
computation."""
SOLVERS: Mapping[str, Solver] = {
    "certified": Certified(),
    "qmdp": QMDP(),
    "pomcp": POMCP(),
    "lookahead": Lookahead(),
    "qhr": QHR(),
    "ask_first": AskFirst(),
}
KNOWN = "labeler=truth", "clusterer=perfect"
LEARNED = "labeler=hypotheses", "queries=adaptive", "points=20", "observers.label_noise=0.05"
Rates = Sequence[tuple[float, float]]
AGAIN: Rates = ((1.0, 0.0), (0.9, 0.0), (0.8, 0.0), (1.0, 0.05), (1.0, 0.1), (0.8, 0.1))
"""Pairs of α and φ."""
MAPS = (*DOMAINS, "random rescue", "random rooms")
FRESH = 9400
"""The first seed of people and traces; no setting was chosen on this or later seeds."""
SMALL = ("max_steps=6", "ask.clips=5", "points=5")
"""Changes for a smoke run."""


def world(name: str, seed: int, traces: int, *source: str) -> World:
    """Makes a map's types, traces and clips."""
    domain = "rescue" if "rescue" in name else "four_rooms"
    fixed = (f"domain={domain}", "discount=1", f"traces={traces}", f"seed={seed}")
    cfg = compose_config("config", [*fixed, "ask=clips", *source])
    components = components_of(cfg)
    if name.startswith("random"):
        components = replace(components, domain=domain_of(name, seed))
    return World(prepare(components), costs_of(cfg), seed)


def at(world_: World, price: float, when: When = "anytime") -> World:
    """Returns the same world with this cost of a question."""
    return world_._replace(costs=replace(world_.costs, asking=Limits(price, when=when)))


def silent(world_: World) -> World:
    """Returns the same world without questions."""
    cases = tuple(replace(case, questions=None) for case in world_.prepared.cases)
    return world_._replace(prepared=replace(world_.prepared, cases=cases))


def asked(records: list[Record]) -> float:
    """Returns the mean number of questions in an episode."""
    return float(np.mean([record.episode.n_questions for record in records]))


def table(
    *small: str, traces: Mapping[str, int] = TRACES, prices: Sequence[float] = PRICES
) -> None:
    """Prints the cost by κ and solver, with the mean number of questions."""
    head = " | ".join(f"{price:g}" for price in prices)
    print(f"| solver | never | {head} |\n|{'---|' * (len(prices) + 2)}")
    for domain, count in traces.items():
        print(f"| **{domain.replace('_', ' ')}** |" + " |" * (len(prices) + 1))
        worlds = [world(domain, 0, count, *KNOWN, *small)]
        for name, solver in SOLVERS.items():
            cells = [figures(worlds, solver, Exact(), None)]
            cells += [figures(worlds, solver, Exact(), price) for price in prices]
            print(f"| {name} | {' | '.join(cells)} |", flush=True)
        floor = [cost(w.meets(Exact(), Independent(), KnownType("labels"))) for w in worlds]
        print(f"| type known | {np.mean(floor):.3f} |" + " |" * len(prices), flush=True)


def figures(worlds: list[World], solver: Solver, explainee: Explainee, price: float | None) -> str:
    """Formats the mean cost and the mean number of questions."""
    asks = [silent(w) if price is None else at(w, price) for w in worlds]
    records = [w.meets(explainee, Independent(), solver) for w in asks]
    said = f"{np.mean([cost(r) for r in records]):.3f}"
    return said if price is None else f"{said} ({np.mean([asked(r) for r in records]):.1f})"


def learned(seeds: Iterable[int], traces: int, *small: str, maps: Iterable[str] = MAPS) -> None:
    """Prints the costs with types learned from 20 questions to each person, 5 % of the answers
    wrong; κ = 0.1."""
    print("| map | never | asking | type known | never / known | asking / known | questions |")
    print("|---|---|---|---|---|---|---|")
    for name in maps:
        found: dict[str, list[float]] = defaultdict(list)
        for seed in seeds:
            here = at(world(name, seed, traces, *LEARNED, *small), 0.1)
            found["never"].append(cost(silent(here).meets(Exact(), Independent(), QMDP())))
            records = here.meets(Exact(), Independent(), QMDP())
            found["asking"].append(cost(records))
            found["questions"].append(asked(records))
            found["known"].append(cost(here.meets(Exact(), Independent(), KnownType("labels"))))
        cells = [figure(found[way]) for way in ("never", "asking", "known")]
        cells += [ratio(found[way], found["known"]) for way in ("never", "asking")]
        print(f"| {name} | {' | '.join(cells)} | {np.mean(found['questions']):.1f} |", flush=True)


def errors(seeds: Iterable[int], traces: int, *small: str, maps: Iterable[str] = MAPS) -> None:
    """Prints the costs if one answer in ten is wrong; κ = 0.1, true types and labels, the rate
    known or learned."""
    ways = ("never", "first", "anytime")
    print("| map | users err | rate | never | first | anytime | never − anytime | questions |")
    print("|---|---|---|---|---|---|---|---|")
    for name in maps:
        worlds = [world(name, seed, traces, *KNOWN, *small) for seed in seeds]
        for repeats in (True, False):
            kinds: dict[str, Assumed] = {"told": 0.1, "learned": "learned"}
            for rate, assumed in kinds.items():
                update = (Persistent if repeats else Independent)(assumed)
                found: dict[str, list[float]] = defaultdict(list)
                for here in worlds:
                    for way in ways:
                        records = meets(here, way, Slips(0.1, repeats), update)
                        found[way].append(cost(records))
                    found["questions"].append(asked(records))
                gain = np.subtract(found["never"], found["anytime"]).tolist()
                cells = [*(figure(found[way]) for way in ways), figure(gain)]
                how = "repeated" if repeats else "independent"
                mean = f"{np.mean(found['questions']):.1f}"
                print(f"| {name} | {how} | {rate} | {' | '.join(cells)} | {mean} |", flush=True)


def meets(here: World, way: str, explainee: Explainee, update: BeliefUpdate) -> list[Record]:
    """Runs episodes of QMDP that asks never, first, or anytime."""
    if way == "never":
        return silent(here).meets(explainee, update, QMDP())
    return at(here, 0.1, "first" if way == "first" else "anytime").meets(explainee, update, QMDP())


def again(
    seeds: Iterable[int],
    traces: int,
    *small: str,
    maps: Sequence[str] = DOMAINS,
    rates: Rates = AGAIN,
) -> None:
    """Prints the costs if messages may be missed (α) or forgotten (φ) at known rates; κ = 0.1, true
    labels."""
    print(
        "| α, φ | never | asking | never − asking | questions | POMCP, asking | type and K seen |"
    )
    print("|---|---|---|---|---|---|---|")
    for domain in maps:
        print(f"| **{domain.replace('_', ' ')}** |" + " |" * 6)
        worlds = [at(world(domain, seed, traces, *KNOWN, *small), 0.1) for seed in seeds]
        for accept, forget in rates:
            people, update = Heedless(accept, forget), Independent(0.0, accept, forget)
            found: dict[str, list[float]] = defaultdict(list)
            for here in worlds:
                found["never"].append(cost(silent(here).meets(people, update, QMDP())))
                records = here.meets(people, update, QMDP())
                found["asking"].append(cost(records))
                found["questions"].append(asked(records))
                found["pomcp"].append(cost(here.meets(people, update, POMCP())))
                seen = here.meets(people, Independent(), KnownType("labels"))
                found["seen"].append(cost(seen))
            gain = np.subtract(found["never"], found["asking"]).tolist()
            cells = [figure(found["never"]), figure(found["asking"]), figure(gain)]
            cells += [f"{np.mean(found['questions']):.1f}"]
            cells += [figure(found["pomcp"]), figure(found["seen"])]
            print(f"| {accept:g}, {forget:g} | {' | '.join(cells)} |", flush=True)


def speed(seeds: Iterable[int], traces: int, *small: str) -> None:
    """Prints the milliseconds of a step's decision about questions and messages."""
    print("| solver | clips | mean of a step | longest |\n|---|---|---|---|")
    for name in ("qmdp", "pomcp", "certified"):
        for error in (0.0, 0.1)[: 1 if name == "certified" else 2]:  # 0.1 would take minutes
            times, most = [], 0
            for here in decided(seeds, traces, *small):
                most = max(len(c.questions.texts) for c in here.prepared.cases if c.questions)
                records = here.meets(Exact(), Independent(error), SOLVERS[name])
                times += [record.episode.seconds for record in records]
            steps = np.concatenate(times)
            kind = f"{name}, error {error:g}"
            print(f"| {kind} | {most} | {1e3 * steps.mean():.2f} | {1e3 * steps.max():.1f} |")


def decided(seeds: Iterable[int], traces: int, *small: str) -> Iterator[World]:
    """Yields worlds of rescue with learned labels."""
    for seed in seeds:
        yield at(world("rescue", seed, traces, *LEARNED, *small), 0.1)


def main() -> None:
    """Prints the table asked for, as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parts = ("table", "learned", "errors", "again", "speed")
    parser.add_argument("what", nargs="?", choices=parts)
    parser.add_argument("--quick", action="store_true", help="a smoke run")
    options = parser.parse_args()
    if options.quick:
        rooms, seeds = ["four_rooms"], range(FRESH, FRESH + 1)
        table(*SMALL, traces={"four_rooms": 1}, prices=PRICES[:1])
        learned(seeds, 1, *SMALL, maps=rooms)
        errors(seeds, 1, *SMALL, maps=rooms)
        again(seeds, 1, *SMALL, maps=rooms, rates=AGAIN[-1:])
        speed(seeds, 1, *SMALL, "domain=four_rooms")
    elif options.what == "table":
        table()
    elif options.what == "learned":
        learned(range(FRESH, FRESH + 5), 30)
    elif options.what == "errors":
        errors(range(FRESH, FRESH + 8), 8)
    elif options.what == "again":
        again(range(FRESH, FRESH + 10), 4)
    elif options.what == "speed":
        speed(range(FRESH, FRESH + 2), 8)


if __name__ == "__main__":
    main()
