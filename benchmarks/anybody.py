"""Measures explanations to people nobody assumed (docs/people-nobody-assumed.md).

    python benchmarks/anybody.py true       every kind of people, with true types and labels
    python benchmarks/anybody.py learned    the same, with types learned from 20 labels, 5 % wrong
    python benchmarks/anybody.py observers  observers are of the same kind as the people
    python benchmarks/anybody.py --quick    a smoke run

The generators of benchmarks/questions.py draw a new map for each seed. The discount is the default,
and costs count true labels. A ratio compares ``belief=open`` with the best of
``belief=independent``, conformant and say all for that kind of people; its standard error is over
maps.
"""

import argparse
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from explainees import TRUE, World, worlds
from numpy.typing import NDArray
from questions import domain_of

from xplain.domains.base import Domain
from xplain.domains.users.setting import Setting, UserType
from xplain.domains.users.types import TypeSource
from xplain.errors import DomainError, InputError
from xplain.experiment.config import compose_config
from xplain.experiment.explanations import Costs, estimate_costs, problem_of_types, true_thoughts
from xplain.experiment.from_config import components_of, costs_of
from xplain.experiment.pipeline import Case, PreparedData, prepare, with_others
from xplain.explanation.anybody import Open
from xplain.explanation.belief import BeliefUpdate, Independent
from xplain.explanation.habits import WAYS
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
    SimulatedUser,
    Slips,
    Sticky,
    Union,
    Unseen,
)
from xplain.learning.data.queries import Answer, Queries, QueryAnswers
from xplain.randomness import derive_seed, stream
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


OBSERVED = ("shipped rescue", "shipped rooms")
"""Maps for observers and people of one kind. On random maps (seeds 9970 and 9971), all ratios but
one in a hundred are below SAFE."""
NAMED = ("open", "conformant", "say all")
"""The policies that xplain compares if types are doubtful."""
SAFE = 1.3
"""With observers and people of one kind, explanations should cost at most this number of times the
better of conformant and say all."""


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


@dataclass(frozen=True)
class TypesOfKind:
    """The true types of people of one kind.

    Attributes:
        users: draws the types of people as assumed.
        kind: the kind.
    """

    users: TypeSource
    kind: Explainee

    def types(self, domain: Domain, rng: np.random.Generator) -> tuple[UserType, ...]:
        """Draws at most as many types as ``users``, of which no two behave alike."""
        observed = self.users.types(domain, rng)
        if self.kind.as_observed:
            return observed
        found: list[UserType] = []
        for one in self.kind.others(domain, observed, rng):
            with suppress(DomainError):  # the goal is out of reach under the type's beliefs
                distinct = Setting.build(domain, (*found, one)).distinct
                found += [one] if distinct[-1] not in distinct[:-1] else []
        return tuple(found[: len(observed)])


@dataclass(frozen=True)
class AskedPeople:
    """A query design whose observers are of one kind. In addition, they err as configured.

    Attributes:
        queries: chooses the questions.
        kind: the kind.
        seed: seed of the people.
    """

    queries: Queries
    kind: Explainee
    seed: int

    def ask(
        self, setting: Setting, sizes: NDArray[np.int64], answer: Answer, seed: int
    ) -> list[QueryAnswers]:
        """Asks the observers (:class:`~xplain.learning.data.queries.Queries`)."""
        reachable = setting.reachable
        place = {tuple(row): i for i, row in enumerate(reachable.tolist())}
        labels, each = setting.true_labels(reachable), len(sizes) // len(setting.types)
        people: list[SimulatedUser] = []
        for o in range(len(sizes)):
            own = labels.of_types([o // each]), np.arange(len(place))
            people.append(self.kind.meet(*own, derive_seed(self.seed, "observer", o)))
        before: dict[int, list[int]] = defaultdict(list)

        def answer_as_person(
            o: int, transitions: NDArray[np.int64], told: NDArray[np.int64]
        ) -> NDArray[np.uint8]:
            error = answer(o, transitions, told) ^ setting.labels(o // each, transitions, told)
            person, said = people[o], before[o]
            for row, given in zip(transitions.tolist(), told.tolist(), strict=True):
                person.step = len(said)
                person.knows = 0  # messages are given again
                person.hear(given)
                said.append(person.answer(place[tuple(row)], given))
                repeats = stream(person.seed, "repeats", len(said)).random()
                if isinstance(self.kind, Sticky) and said[1:] and repeats < self.kind.rate:
                    said[-1] = said[-2]
            return np.array(said[-len(told) :], np.uint8) ^ error

        return self.queries.ask(setting, sizes, answer_as_person, seed)


def of_one_kind(
    name: str, seed: int, kind: Explainee, trade_offs: Iterable[float], traces: int
) -> Iterator[tuple[float, str, dict[str, float]]]:
    """Learns types from observers of one kind, and explains to people of this kind. Yields each λ
    with the policy that is named beforehand, and the mean cost of each policy; "open, assumed" does
    not learn from observers how people answer."""
    domain = f"domain={'rescue' if 'rescue' in name else 'four_rooms'}"
    words = (domain, f"seed={seed}", f"traces={traces}", "discount=0.95", *LEARNED)
    cfg = compose_config("config", [*words])
    made = components_of(cfg)
    users, queries = TypesOfKind(made.users, kind), AskedPeople(made.queries, kind, seed)
    known = prepare(replace(made, domain=domain_of(name, seed), users=users, queries=queries))
    assert known.habits is not None
    assumed = replace(known, habits=replace(known.habits, ways=WAYS))
    for trade_off in trade_offs:
        costs, found = replace(costs_of(cfg), trade_off=trade_off), defaultdict(list)
        for policy, (update, solver) in (POLICIES | {"open, assumed": POLICIES["open"]}).items():
            prepared = assumed if policy == "open, assumed" else known
            for index, case in enumerate(prepared.cases):
                problem = problem_of_types(prepared, case, costs, update)
                planned = CachedPolicy(solver.plan(problem))
                truth, same = true_thoughts(case)
                for user in range(len(prepared.types)):
                    own = derive_seed(seed, "explainee", index, user)
                    person = kind.meet(truth.of_types([user]), same, own)
                    found[policy].append(explain(problem, planned, person, update).cost)
        means = {policy: float(np.mean(own)) for policy, own in found.items()}
        yield trade_off, name_cheapest(known, costs), means


def name_cheapest(prepared: PreparedData, costs: Costs) -> str:
    """Returns the policy that a run names as the cheapest before any explanation; "open" if it says
    nothing, because the types are not doubtful."""
    found = {} if prepared.doubted is None else estimate_costs(prepared, costs)
    means = [own.mean for own in found.values()]
    return NAMED[int(np.argmin(means))] if means else NAMED[0]


def observers(
    maps: Iterable[str],
    seeds: Iterable[int],
    trade_offs: tuple[float, ...],
    traces: int,
    kinds: dict[str, Explainee] = KINDS,
) -> None:
    """Prints the costs with observers and people of one kind, divided by the better of conformant
    and say all; then how often this ratio is at most SAFE, or the run names the cheaper one
    beforehand; and how much the named policy costs relative to the cheapest."""
    rules = ("open", "open, assumed", "today")
    safe: dict[tuple[str, float], list[bool]] = defaultdict(list)
    warned: dict[float, list[bool]] = defaultdict(list)
    ratios: dict[float, list[float]] = defaultdict(list)
    for name in maps:
        columns = (f"{r}, λ = {x:g}" for x in trade_offs for r in (*rules, "named"))
        print(f"| {name} | {' | '.join(columns)} |")
        print("|---" * (len(trade_offs) * (len(rules) + 1) + 1) + "|")
        for kind, explainee in kinds.items():
            costs: dict[float, list[dict[str, float]]] = defaultdict(list)
            names: dict[float, list[str]] = defaultdict(list)
            for seed in seeds:
                with suppress(InputError):  # the task has no people of this kind
                    made = of_one_kind(name, seed, explainee, trade_offs, traces)
                    for trade_off, named, own in made:
                        costs[trade_off].append(own)
                        names[trade_off].append(named)
            cells = []
            for trade_off, each in costs.items():
                best = [min(own["conformant"], own["say all"]) for own in each]
                for rule in rules:
                    cost = [own[rule] for own in each]
                    cells.append(f"{ratio(np.array(cost), np.array(best))[0]:.2f}")
                    safe[rule, trade_off] += [
                        a <= SAFE * b + 1e-9 for a, b in zip(cost, best, strict=True)
                    ]
                for named, own, two in zip(names[trade_off], each, best, strict=True):
                    told = named != "open" and own[named] <= two + 1e-9
                    warned[trade_off].append(told or own["open"] <= SAFE * two + 1e-9)
                    least = min(own[policy] for policy in NAMED)
                    ratios[trade_off].append(own[named] / least if least else 1.0 + own[named])
                counts = Counter(names[trade_off])
                cells.append(", ".join(f"{count} {named}" for named, count in counts.items()))
            print(f"| {kind} | {' | '.join(cells)} |", flush=True)
    for (rule, trade_off), kept in safe.items():
        print(f"{rule}, λ = {trade_off:g}: at most {SAFE} in {np.mean(kept):.0%} of {len(kept)}")
    for trade_off, kept in warned.items():
        shares = [np.mean(np.array(ratios[trade_off]) <= most + 1e-9) for most in (1.05, SAFE)]
        print(
            f"λ = {trade_off:g}: at most {SAFE}, or the cheaper one named, in {np.mean(kept):.0%}"
        )
        print(
            f"the named costs ≤ 1.05, {SAFE} times the cheapest in {shares[0]:.0%}, {shares[1]:.0%}"
        )


def main() -> None:
    """Prints the table asked for, as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="?", choices=("true", "learned", "observers"))
    parser.add_argument("--quick", action="store_true", help="a smoke run")
    parser.add_argument("--seeds", type=int, nargs=2, default=(SEEDS.start, SEEDS.stop))
    parser.add_argument("--lambdas", type=float, nargs="*", default=TRADE_OFFS)
    options = parser.parse_args()
    for name, what, overrides in zip(MAPS, ("true", "learned"), (TRUE, LEARNED), strict=True):
        if options.quick:
            table([name], SEEDS[:1], (1.0,), *overrides, "max_steps=3", traces=1)
        elif options.what == what:
            table(MAPS, range(*options.seeds), tuple(options.lambdas), *overrides, traces=TRACES)
    if options.quick:
        observers(
            OBSERVED[-1:], SEEDS[:1], (1.0,), 1, {one: KINDS[one] for one in ("union", "coin")}
        )
    elif options.what == "observers":
        observers(OBSERVED, range(*options.seeds), tuple(options.lambdas), traces=8)


if __name__ == "__main__":
    main()
