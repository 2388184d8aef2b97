"""Measures explanations to people nobody assumed (docs/people-nobody-assumed.md).

    python benchmarks/anybody.py true       every kind of people, with true types and labels
    python benchmarks/anybody.py learned    the same, with types learned from 20 labels, 5 % wrong
    python benchmarks/anybody.py --quick    a smoke run

The generators of benchmarks/questions.py draw a new map for each seed. The discount is the default,
and costs count true labels. A ratio compares ``belief=open`` with the best of
``belief=independent``, conformant and say all for that kind of people; its standard error is over
maps.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from explainees import TRUE, World, worlds
from numpy.typing import NDArray
from questions import domain_of

from xplain.errors import InputError
from xplain.experiment.config import compose_config
from xplain.experiment.explanations import problem_of_types, true_thoughts
from xplain.experiment.from_config import components_of
from xplain.experiment.pipeline import Case, PreparedData, with_others
from xplain.explanation.anybody import Open
from xplain.explanation.belief import BeliefUpdate, Independent
from xplain.interaction.episode import Episode, explain
from xplain.interaction.explainees import (
    AllWrong,
    Backlash,
    Between,
    Exact,
    Expert,
    Explainee,
    Heedless,
    LearnsUntold,
    Misreads,
    Slips,
    Sticky,
    Union,
    Unseen,
)
from xplain.randomness import derive_seed
from xplain.solvers.base import CachedPolicy, Solver
from xplain.solvers.greedy import QMDP, Conformant
from xplain.solvers.simple import SayAll

MAPS = ("random rescue", "random rooms")
SEEDS = range(9760, 9765)
TRACES = 3
TRADE_OFFS = (0.5, 1.0, 2.0)
FITS, CERTAIN = 0.95, 0.997
"""A fit and a belief that should be right in 95 of 100 cases."""
KINDS: dict[str, Explainee] = {
    "exact": Exact(),
    "expert": Expert(),
    "all wrong": AllWrong(),
    "union": Union(),
    "unseen": Unseen(),
    "between": Between(),
    "learns untold": LearnsUntold(),
    "misreads": Misreads(),
    "sticky": Sticky(),
    "tiring": Slips(0.0, repeats=False, tires=0.03),
    "polite": Slips(0.0, repeats=False, polite=0.5),
    "polite, repeated": Slips(0.0, repeats=True, polite=0.5),
    "coin": Slips(0.5, repeats=False),
    "slips": Slips(),
    "heedless": Heedless(),
    "backlash": Backlash(),
}
LEARNED = ("labeler=hypotheses", "queries=adaptive", "points=20", "observers.label_noise=0.05")
POLICIES: dict[str, tuple[BeliefUpdate, Solver]] = {
    "open": (Open(), QMDP()),
    "today": (Independent(), QMDP()),
    "conformant": (Independent(), Conformant()),
    "say all": (Independent(), SayAll()),
}


class Told(NamedTuple):
    """One episode with its world, λ, kind of people, policy, trace and user.

    Attributes:
        right: [N] True if a found type has the user's labels of all transitions shown, so that no
            answer distinguishes them.
    """

    seed: int
    trade_off: float
    kind: str
    policy: str
    trace: int
    user: int
    right: NDArray[np.bool_]
    episode: Episode


def of_kinds(world: World, name: str, people: dict[str, Explainee]) -> dict[str, PreparedData]:
    """Returns the world with users of each kind, without the kinds that its task does not have."""
    domain = f"domain={'rescue' if 'rescue' in name else 'four_rooms'}"
    made = components_of(compose_config("config", [domain, f"seed={world.seed}"]))
    components, found = replace(made, domain=domain_of(name, world.seed)), {}
    for kind, explainee in people.items():
        if explainee.as_observed:
            found[kind] = world.prepared
            continue
        try:
            found[kind] = with_others(world.prepared, components, explainee)
        except InputError:
            continue
    return found


def episodes(name: str, seeds: Iterable[int], trade_offs: Iterable[float], *overrides: str,
             traces: int = TRACES) -> Iterator[Told]:  # fmt: skip
    """Lets every explainer explain every trace to all users."""
    people = KINDS
    for world in worlds(name, seeds, traces, *overrides, "discount=0.95"):
        users = of_kinds(world, name, people)
        for index, case in enumerate(world.prepared.cases):
            for trade_off in trade_offs:
                costs = replace(world.costs, trade_off=trade_off)
                for policy, (update, solver) in POLICIES.items():
                    problem = problem_of_types(world.prepared, case, costs, update)
                    planned = CachedPolicy(solver.plan(problem))
                    for kind, prepared in users.items():
                        truth, same = true_thoughts(prepared.cases[index])
                        for user in range(len(prepared.types)):
                            seed = derive_seed(world.seed, "explainee", index, user)
                            own = truth.of_types([user])
                            person = people[kind].meet(own, same, seed)
                            about = world.seed, trade_off, kind, policy, index, user
                            talk = explain(problem, planned, person, update)
                            yield Told(*about, thought_alike(world.prepared, case, talk), talk)


def thought_alike(prepared: PreparedData, case: Case, episode: Episode) -> NDArray[np.bool_]:
    """Returns [N] True if a learned type's true labels are the user's labels at every step."""
    own = [np.flatnonzero(prepared.distinct == one)[0] for one in prepared.matched_true_type]
    given, alike = 0, np.ones(len(own), np.bool_)
    for k, (said, thoughts) in enumerate(zip(episode.messages, episode.thoughts, strict=True)):
        given |= int(said)
        labels = case.labels.label_probabilities(k + 1, given)[own]
        alike &= (labels == thoughts[: k + 1]).all(axis=1)
    return alike


def ratio(over: NDArray[np.float64], under: NDArray[np.float64]) -> tuple[float, float]:
    """Returns the ratio of two costs summed over worlds, with its standard error; the ratio of two
    zeros is 1."""
    if not under.any():
        return (np.inf if over.any() else 1.0), 0.0
    found = over.sum() / under.sum()
    rest = over - found * under
    return float(found), float(np.sqrt((rest**2).sum()) / under.sum())


def table(
    maps: Iterable[str],
    seeds: Iterable[int],
    trade_offs: tuple[float, ...],
    *overrides: str,
    traces: int,
) -> None:
    """Prints the ratios of every kind of people."""
    for name in maps:
        costs: dict[tuple[str, float, str], dict[int, list[float]]] = defaultdict(
            lambda: defaultdict(list)
        )
        opened = defaultdict(list)
        for told in episodes(name, seeds, trade_offs, *overrides, traces=traces):
            costs[told.kind, told.trade_off, told.policy][told.seed].append(told.episode.cost)
            if told.policy == "open":
                opened[told.kind].append(told)
        print(f"| {name} | " + " | ".join(f"λ = {one:g}" for one in trade_offs) + " | best |")
        print("|---" * (len(trade_offs) + 2) + "|")
        logs: dict[float, list[float]] = defaultdict(list)
        for kind in dict.fromkeys(kind for kind, _, _ in costs):
            cells, best = [], []
            for trade_off in trade_offs:
                own = {
                    policy: np.array([np.mean(c) for c in costs[kind, trade_off, policy].values()])
                    for policy in POLICIES
                }
                reference = min(list(POLICIES)[1:], key=lambda policy: own[policy].sum())
                found, error = ratio(own["open"], own[reference])
                if kind != "backlash" and 0 < found < np.inf:
                    logs[trade_off].append(np.log(found))
                cells.append(f"{found:.2f}±{error:.2f}")
                best.append(f"{reference} {own[reference].mean():.2f}")
            print(f"| {kind} | " + " | ".join([*cells, ", ".join(best)]) + " |")
        means = [f"{np.exp(np.mean(logs[one])):.2f}" for one in trade_offs]
        print(f"| geometric mean, without backlash | {' | '.join(means)} | |\n", flush=True)
        calibration(opened)


def calibration(opened: dict[str, list[Told]]) -> None:
    """Prints how often a high fit and a high belief are right if half of the people are as assumed
    and half of another kind."""
    print("| half as assumed, half | mean fit | fit ≥ 0.95 | of a found type | belief ≥ 0.997 "
          "| right |\n|---|---|---|---|---|---|")  # fmt: skip
    found = {}
    for kind, told in opened.items():
        fit = np.array([one.episode.fit for one in told])
        belief = np.array([one.episode.beliefs[-1][: len(one.right)].max() for one in told])
        chosen = [one.episode.beliefs[-1][: len(one.right)].argmax() for one in told]
        right = np.array([one.right[t] for one, t in zip(told, chosen, strict=True)])
        known = np.array([one.right.any() for one in told])
        sure, certain = fit >= FITS, belief >= CERTAIN
        found[kind] = [
            float(one.mean()) for one in (fit, sure, sure & known, certain, certain & right)
        ]
    for kind, own in found.items():
        fit, sure, known, certain, right = np.mean([own, found["exact"]], axis=0)
        shares = [known / sure if sure else np.nan, right / certain if certain else np.nan]
        cells = f"{own[0]:.2f} | {sure:.3f} | {shares[0]:.3f} | {certain:.3f} | {shares[1]:.3f}"
        print(f"| {kind} | {cells} |")
    print(flush=True)


def main() -> None:
    """Prints the table asked for, as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="?", choices=("true", "learned"))
    parser.add_argument("--quick", action="store_true", help="a smoke run")
    parser.add_argument("--seeds", type=int, nargs=2, default=(SEEDS.start, SEEDS.stop))
    parser.add_argument("--lambdas", type=float, nargs="*", default=TRADE_OFFS)
    options = parser.parse_args()
    for name, what, overrides in zip(MAPS, ("true", "learned"), (TRUE, LEARNED), strict=True):
        if options.quick:
            table([name], SEEDS[:1], (1.0,), *overrides, "max_steps=3", traces=1)
        elif options.what == what:
            table(MAPS, range(*options.seeds), tuple(options.lambdas), *overrides, traces=TRACES)


if __name__ == "__main__":
    main()
