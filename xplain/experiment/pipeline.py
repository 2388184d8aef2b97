"""The paper's method, from top to bottom: observe, learn the user types, explain, count the cost.

    Setting ── Dataset ── UserTypes ── Case (one a trace) ── Problem ── Policy ── Episode

Everything before the solver and λ is in :func:`prepare`: it is the same for all of them, and its
result is plain data, so that a sweep does this work once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from xplain.data.dataset import Dataset
from xplain.data.rollouts import sample_trace
from xplain.domains.base import (
    Domain,
    Scene,
    transition_feature_names,
    transition_features,
)
from xplain.errors import InputError
from xplain.evaluation.episode import SimulatedUser, explain
from xplain.evaluation.metrics import Record
from xplain.explanation.belief import BeliefUpdate
from xplain.explanation.problem import DiscountPer, Problem
from xplain.randomness import derived_seed, stream
from xplain.solvers.base import Solver
from xplain.solvers.cached_policy import CachedPolicy
from xplain.users.setting import Setting
from xplain.users.types import TypeSource

T = TypeVar("T")
Track = Callable[[Iterable[T], str, int], Iterable[T]]
"""Shows progress: ``track(items, what, how many)`` yields the items."""


def untracked(items: Iterable[Any], what: str, count: int) -> Iterator[Any]:
    """Shows nothing."""
    return iter(items)


class Observers(Protocol):
    """People, simulated or real, who labelled transitions."""

    def collect(self, setting: Setting, seed: int) -> tuple[Dataset, NDArray[np.int64] | None]:
        """Their labels, and the index of each observer's true type where it is known."""
        ...


@dataclass(frozen=True)
class Source:
    """What decides the data, the types and the traces, but no explanation.

    Attributes:
        domain, users, observers, labeler, clusterer: the components chosen in config.
        traces: how many traces to explain.
        max_steps: a trace ends at a terminal state or here.
        seed: of every stream.
    """

    domain: Domain
    users: TypeSource
    observers: Observers
    labeler: Any
    clusterer: Any
    traces: int
    max_steps: int
    seed: int

    def __post_init__(self) -> None:
        """Checks the numbers."""
        for key in ("traces", "max_steps"):
            if getattr(self, key) < 1:
                raise InputError(key, getattr(self, key), "a whole number ≥ 1")
        if self.seed < 0:
            raise InputError("seed", self.seed, "a whole number ≥ 0")


@dataclass(frozen=True)
class Costs:
    """What messages and inexplicable labels cost, and how plans discount (SPEC §5)."""

    trade_off: float
    message_cost: float
    inexplicability_cost: float
    discount: float
    discount_per: DiscountPer
    prior: Literal["uniform", "observers"]

    def __post_init__(self) -> None:
        """Checks what :class:`Problem` would refuse, before any work is done."""
        self.problem(np.full((1, 1, 1), 0.5), (), ("type",), np.ones(1))
        if self.prior not in ("uniform", "observers"):
            raise InputError("prior", self.prior, "uniform or observers")

    def problem(
        self,
        p_explicable: NDArray[np.float64],
        message_names: tuple[str, ...],
        type_names: tuple[str, ...],
        shares: NDArray[np.float64],
    ) -> Problem:
        """The problem of one trace; ``shares`` [N] of the observers, for the prior."""
        if not (np.isfinite(self.message_cost) and self.message_cost >= 0):
            raise InputError("message_cost", self.message_cost, "a number ≥ 0")
        return Problem(
            p_explicable=p_explicable,
            message_cost=np.full(len(message_names), self.message_cost),
            inexplicability_cost=self.inexplicability_cost,
            trade_off=self.trade_off,
            discount=self.discount,
            prior=shares if self.prior == "observers" else np.full(len(shares), 1 / len(shares)),
            discount_per=self.discount_per,
            message_names=message_names,
            type_names=type_names,
        )


@dataclass(frozen=True)
class Case:
    """One trace, and what every agent and every user thinks of it.

    Attributes:
        transitions: [m, 3].
        phrases: m short descriptions.
        positions: m + 1 cells (row, column) of the robot; empty where there is no map.
        learned: [N, m, 2^n] P(label is 1) by the labelers of the types that were found.
        everyone: [1, m, 2^n] by one labeler of all data (the baseline's).
        perfect: [M, m, 2^n] by the labelers under perfect clustering; None where the true types
            of the observers are unknown.
        labels: [M, m, 2^n] the true labels of each true type.
    """

    transitions: NDArray[np.int64]
    phrases: tuple[str, ...]
    positions: tuple[tuple[int, int], ...]
    learned: NDArray[np.float64]
    everyone: NDArray[np.float64]
    perfect: NDArray[np.float64] | None
    labels: NDArray[np.uint8]


@dataclass(frozen=True)
class Prepared:
    """All that is known before a solver and λ are chosen; plain data.

    Attributes:
        domain: its name.
        messages: n names, with ``sentences`` for people.
        types: M names of the true types; ``distinct`` [M] numbers those that behave alike.
        found: N names of the learned types; ``stands_for`` [N] the ``distinct`` number of most
            of their observers (−1 unknown), ``shares`` [N] of the observers.
        learning: figures of the learning stage, by name.
        curve: disagreements for k = 1 … (empty where the method has none).
        rule: what decided the number of types.
        scene: the map, if there is one.
        cases: one a trace.
    """

    domain: str
    messages: tuple[str, ...]
    sentences: tuple[str, ...]
    types: tuple[str, ...]
    distinct: NDArray[np.int64]
    found: tuple[str, ...]
    stands_for: NDArray[np.int64]
    shares: NDArray[np.float64]
    learning: dict[str, float]
    curve: NDArray[np.float64]
    rule: str
    scene: Scene | None
    cases: tuple[Case, ...]


def prepare(source: Source, track: Track[Any] = untracked) -> Prepared:
    """Builds the setting, lets observers label, finds the types and learns their labelers.

    Raises:
        XplainError: the configuration or the data cannot be used; the text says what to change.
    """
    from xplain.learning.clustering import Perfect
    from xplain.learning.user_types import learn_types

    domain, seed, trainer = source.domain, source.seed, source.labeler

    types = source.users.types(domain, stream(seed, "users"))
    setting = Setting.build(domain, types)
    dataset, truth = source.observers.collect(setting, seed)
    _require_same_features(dataset, domain)

    everyone = trainer.fit(dataset, derived_seed(seed, "everyone"))
    _require_tested([everyone])
    clustering = source.clusterer.cluster(dataset, trainer, derived_seed(seed, "clusterer"), truth)
    learned = learn_types(dataset, clustering, trainer, derived_seed(seed, "labelers"))
    _require_tested(learned.labelers)
    perfect = None
    if truth is not None:
        best = Perfect().cluster(dataset, trainer, 0, truth)
        perfect = learn_types(dataset, best, trainer, derived_seed(seed, "perfect"))

    robot, optimal = setting.models[0], setting.optimal[0]
    cases = []
    for index in track(range(source.traces), "labelling traces", source.traces):
        rng = stream(seed, "traces", index)
        transitions = sample_trace(robot, optimal, domain.starts, rng, source.max_steps)
        features = transition_features(domain, transitions)
        states = [*transitions[:, 0].tolist(), int(transitions[-1, 2])]
        cells = [domain.position(state) for state in states]
        cases.append(
            Case(
                transitions=transitions,
                phrases=tuple(domain.describe(transition) for transition in transitions),
                positions=tuple(cell for cell in cells if cell is not None),
                learned=_tables(learned.labelers, features, setting.n_messages),
                everyone=_tables((everyone,), features, setting.n_messages),
                perfect=None
                if perfect is None
                else _tables(perfect.labelers, features, setting.n_messages),
                labels=setting.label_table(transitions),
            )
        )

    figures = {"types_found": float(len(learned.labelers))}
    figures["labeler_accuracy"] = _mean_accuracy(learned.labelers)
    figures["everyone_accuracy"] = everyone.accuracy
    stands_for = np.full(len(learned.labelers), -1)
    if truth is not None and perfect is not None:
        from sklearn.metrics import adjusted_rand_score

        alike = setting.distinct[truth]
        for found in range(len(learned.labelers)):
            stands_for[found] = np.bincount(alike[clustering.assignment == found]).argmax()
        figures["adjusted_rand_index"] = float(adjusted_rand_score(alike, clustering.assignment))
        figures["perfect_labeler_accuracy"] = _mean_accuracy(perfect.labelers)
        figures["true_types"] = float(len(np.unique(alike)))
    return Prepared(
        domain=domain.name,
        messages=setting.message_names,
        sentences=tuple(parameter.message for parameter in domain.parameters),
        types=tuple(user_type.name for user_type in types),
        distinct=setting.distinct,
        found=learned.names,
        stands_for=stands_for,
        shares=np.bincount(clustering.assignment) / len(clustering.assignment),
        learning=figures,
        curve=np.asarray([] if clustering.curve is None else clustering.curve, dtype=float),
        rule=clustering.rule,
        scene=domain.scene,
        cases=tuple(cases),
    )


def problem_for(prepared: Prepared, case: Case, costs: Costs, solver: Solver, user: int) -> Problem:
    """What a solver may plan with when a user of the true type ``user`` is in front of it.

    Raises:
        InputError: the solver needs the observers' true types, and they are unknown.
    """
    name = prepared.types[user]
    alone = np.ones(1)
    if solver.knows == "types":
        return costs.problem(case.learned, prepared.messages, prepared.found, prepared.shares)
    if solver.knows == "everyone":
        return costs.problem(case.everyone, prepared.messages, ("everyone",), alone)
    if solver.knows == "labels":
        truth = case.labels[user : user + 1].astype(np.float64)
        return costs.problem(truth, prepared.messages, (name,), alone)
    if case.perfect is None:
        raise InputError("solver", "oracle", "needs observers whose true types are known")
    return costs.problem(case.perfect[user : user + 1], prepared.messages, (name,), alone)


def evaluate(
    prepared: Prepared,
    costs: Costs,
    solvers: dict[str, Solver],
    belief_update: BeliefUpdate,
    seed: int,
    track: Track[Any] = untracked,
) -> list[Record]:
    """Each solver explains each trace to a user of each true type.

    Args:
        prepared: of :func:`prepare`.
        costs: λ and the rest.
        solvers: by the name in the records.
        belief_update: which labels change the belief.
        seed: the policies' streams come from it and the trace, not from the solver's name.
        track: shows progress.
    """
    records = []
    for index, case in track(enumerate(prepared.cases), "explaining", len(prepared.cases)):
        for name, solver in solvers.items():
            shared = solver.knows in ("types", "everyone")
            policy = problem = None
            for user in range(len(prepared.types)):
                # A user's type changes the plan only of a solver that knows it.
                if policy is None or problem is None or not shared:
                    problem = problem_for(prepared, case, costs, solver, user)
                    planned = solver.plan(problem, trace_seed(seed, index))
                    if index == 0:  # kernels load at the first question: no decision's time
                        planned.messages(0, 0, problem.prior)
                    policy = CachedPolicy(planned)
                episode = explain(problem, policy, SimulatedUser(case.labels[user]), belief_update)
                right = np.ones(problem.n_types, dtype=bool)
                if solver.knows == "types":
                    right = prepared.stands_for == prepared.distinct[user]
                records.append(Record(name, index, user, right, episode))
    return records


def trace_seed(seed: int, index: int) -> int:
    """The seed of every policy for the trace with this index."""
    return derived_seed(seed, "solver", index)


def _tables(
    labelers: Iterable[Any], features: NDArray[np.float64], n_messages: int
) -> NDArray[np.float64]:
    return np.stack([labeler.table(features, n_messages) for labeler in labelers])


def _mean_accuracy(labelers: Iterable[Any]) -> float:
    return float(np.mean([labeler.accuracy for labeler in labelers]))


def _require_tested(labelers: Iterable[Any]) -> None:
    """Raises InputError where no label could be held out to measure a labeler's confidence."""
    for labeler in labelers:
        if labeler.n_test == 0:
            raise InputError(
                "points",
                labeler.n_train,
                "too few: the labels of a type need at least two distinct (transition, message "
                "set) points, one to train its labeler and one to test it",
            )


def _require_same_features(dataset: Dataset, domain: Domain) -> None:
    names = transition_feature_names(domain)
    if dataset.feature_names != names:
        raise InputError(
            "observers.path",
            ",".join(dataset.feature_names),
            f"labels of {domain.name} need the features {','.join(names)} in this order "
            "(python -m xplain.cli.discover finds types in labels of any task)",
        )
    wanted = tuple(parameter.name for parameter in domain.parameters)
    if dataset.messages != wanted:
        raise InputError(
            "observers.messages", ",".join(dataset.messages), f"must be {','.join(wanted)}"
        )
