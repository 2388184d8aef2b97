"""The first half of the method: observe, learn the user types, lay out the traces.

    Setting ── Dataset ── UserTypes ── Case (one a trace)

All of it is the same for every solver and λ, and :func:`prepare` ends in plain data, so that a
sweep does this work once. What follows, Problem ── Policy ── Episode, is in
:mod:`xplain.experiment.explanations`. Each stage is one function, which commands and the study
call as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from xplain.data.dataset import Dataset
from xplain.data.observers import Observers
from xplain.data.rollouts import sample_trace
from xplain.domains.base import (
    Domain,
    Scene,
    transition_feature_names,
    transition_features,
)
from xplain.errors import InputError, XplainError, whole_number
from xplain.learning.clustering import Clusterer, Perfect
from xplain.learning.labelers import Labeler, LabelerTrainer
from xplain.learning.user_types import UserTypes, learn_types, p_explicable
from xplain.randomness import derived_seed, stream
from xplain.users.setting import Setting
from xplain.users.types import TypeSource

T = TypeVar("T")
Track = Callable[[Iterable[T], str, int], Iterable[T]]
"""Shows progress: ``track(items, what, how many)`` yields the items."""


def untracked(items: Iterable[Any], what: str, count: int) -> Iterator[Any]:
    """Yields the items without showing progress."""
    return iter(items)


@dataclass(frozen=True)
class Components:
    """What decides the data, the types and the traces, but no explanation.

    Attributes:
        domain, users, observers, labeler, clusterer: chosen in the configuration.
        traces: how many traces to explain.
        max_steps: a trace ends at a terminal state or here.
        seed: of every stream.
    """

    domain: Domain
    users: TypeSource
    observers: Observers
    labeler: LabelerTrainer
    clusterer: Clusterer
    traces: int
    max_steps: int
    seed: int

    def __post_init__(self) -> None:
        """Checks the numbers."""
        for key in ("traces", "max_steps"):
            whole_number(key, getattr(self, key), 1)
        whole_number("seed", self.seed, 0)


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
            of the observers are unknown, or a type has no observer.
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
        learned_types: N names; ``matched_true_type`` [N] the ``distinct`` number of most of their
            observers (−1 unknown), ``type_shares`` [N] of the observers.
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
    learned_types: tuple[str, ...]
    matched_true_type: NDArray[np.int64]
    type_shares: NDArray[np.float64]
    learning: dict[str, float]
    curve: NDArray[np.float64]
    rule: str
    scene: Scene | None
    cases: tuple[Case, ...]


@dataclass(frozen=True)
class Observed:
    """What observers gave, and what is true of them.

    Attributes:
        setting: the domain, the true types and their models.
        dataset: the labels.
        truth: [O] index of each observer's true type; None where nobody knows it.
    """

    setting: Setting
    dataset: Dataset
    truth: NDArray[np.int64] | None


@dataclass(frozen=True)
class References:
    """Labelers that policies are compared with.

    Attributes:
        everyone: one labeler of all data (the baseline's).
        perfect: types under perfect clustering, L_pc; None where the true types of the observers
            are unknown.
        oracle: [M] the labeler of each true type under perfect clustering; None where a type has
            no observer, or the true types are unknown.
    """

    everyone: Labeler
    perfect: UserTypes | None = None
    oracle: tuple[Labeler, ...] | None = None


def prepare(components: Components, track: Track[Any] = untracked) -> Prepared:
    """Builds the setting, lets observers label, finds the types and learns their labelers.

    Raises:
        XplainError: the configuration or the data cannot be used; the text says what to change.
    """
    domain, trainer, seed = components.domain, components.labeler, components.seed
    observed = observe(domain, components.users, components.observers, seed)
    _require_same_features(observed.dataset, domain)
    references = learn_references(observed, trainer, seed)
    types = learn(observed.dataset, trainer, components.clusterer, seed, observed.truth)
    _require_tested(types.labelers)
    setting = observed.setting
    traces = track(range(components.traces), "labelling traces", components.traces)
    cases = tuple(
        build_case(
            setting, draw_trace(setting, components.max_steps, seed, index), types, references
        )
        for index in traces
    )
    assignment = types.clustering.assignment
    return Prepared(
        domain=domain.name,
        messages=setting.message_names,
        sentences=tuple(parameter.message for parameter in domain.parameters),
        types=tuple(user_type.name for user_type in setting.types),
        distinct=setting.distinct,
        learned_types=types.names,
        matched_true_type=match_true_types(observed, types),
        type_shares=np.bincount(assignment) / len(assignment),
        learning=learning_figures(observed, types, references),
        curve=np.asarray(
            [] if types.clustering.curve is None else types.clustering.curve, dtype=float
        ),
        rule=types.clustering.rule,
        scene=domain.scene,
        cases=cases,
    )


def observe(domain: Domain, users: TypeSource, observers: Observers, seed: int) -> Observed:
    """The true types, and the labels that observers of these types gave.

    Raises:
        XplainError: the types do not fit the domain, or the labels cannot be used.
    """
    setting = Setting.build(domain, users.types(domain, stream(seed, "users")))
    dataset, truth = observers.collect(setting, seed)
    return Observed(setting, dataset, truth)


def learn(
    dataset: Dataset,
    trainer: LabelerTrainer,
    clusterer: Clusterer,
    seed: int,
    truth: NDArray[np.int64] | None = None,
    none_of_these: float = 0.0,
) -> UserTypes:
    """Clusters the observers, and learns one labeler a cluster.

    Args:
        dataset: the labels.
        trainer: fits labelers.
        clusterer: finds the types.
        seed: of the run.
        truth: [O] true types, which only perfect clustering may look at.
        none_of_these: see :func:`xplain.learning.user_types.learn_types`.
    """
    clustering = clusterer.cluster(dataset, trainer, derived_seed(seed, "clusterer"), truth)
    return learn_types(
        dataset,
        clustering,
        trainer,
        derived_seed(seed, "labelers"),
        none_of_these=none_of_these,
    )


def learn_references(observed: Observed, trainer: LabelerTrainer, seed: int) -> References:
    """The labeler of all data, and the labelers under perfect clustering.

    Raises:
        XplainError: too few labels to hold some out.
    """
    dataset, truth = observed.dataset, observed.truth
    everyone = trainer.fit(dataset, derived_seed(seed, "everyone"))
    _require_tested([everyone])
    if truth is None:
        return References(everyone)
    best = Perfect().cluster(dataset, trainer, 0, truth)
    perfect = learn_types(dataset, best, trainer, derived_seed(seed, "perfect"))
    return References(everyone, perfect, _of_each_type(perfect, truth, len(observed.setting.types)))


def _of_each_type(
    perfect: UserTypes, truth: NDArray[np.int64], count: int
) -> tuple[Labeler, ...] | None:
    """The labeler of each true type; None where a type has no observer. Clusters are numbered as
    their observers come, which may be in any order."""
    first = [np.flatnonzero(truth == user_type)[:1] for user_type in range(count)]
    if not all(map(len, first)):
        return None
    return tuple(perfect.labelers[perfect.clustering.assignment[int(o[0])]] for o in first)


def draw_trace(setting: Setting, max_steps: int, seed: int, index: int) -> NDArray[np.int64]:
    """[m, 3] the trace with this index: it starts at random and follows the robot's policy."""
    rng = stream(seed, "traces", index)
    robot, optimal = setting.models[0], setting.optimal[0]
    return sample_trace(robot, optimal, setting.domain.starts, rng, max_steps)


def build_case(
    setting: Setting,
    transitions: NDArray[np.int64],
    types: UserTypes,
    references: References,
) -> Case:
    """Lays out what every agent and every user thinks of a trace [m, 3]."""
    domain, n = setting.domain, setting.n_messages
    features = transition_features(domain, transitions)
    states = [*transitions[:, 0].tolist(), int(transitions[-1, 2])]
    cells = [domain.position(state) for state in states]
    everyone, oracle = references.everyone, references.oracle
    return Case(
        transitions=transitions,
        phrases=tuple(domain.describe(transition) for transition in transitions),
        positions=tuple(cell for cell in cells if cell is not None),
        learned=p_explicable(types.labelers, features, n),
        everyone=p_explicable([everyone], features, n),
        perfect=None if oracle is None else p_explicable(oracle, features, n),
        labels=setting.label_table(transitions),
    )


def match_true_types(observed: Observed, types: UserTypes) -> NDArray[np.int64]:
    """[N] for each learned type the ``distinct`` number of most of its observers; −1 where the
    observers' true types are unknown."""
    matched = np.full(len(types.labelers), -1)
    if observed.truth is not None:
        alike = observed.setting.distinct[observed.truth]
        for learned in range(types.clustering.n_types):
            matched[learned] = np.bincount(alike[types.clustering.members(learned)]).argmax()
    return matched


def learning_figures(
    observed: Observed, types: UserTypes, references: References
) -> dict[str, float]:
    """How well the types were found and the labels learned, by name."""
    figures = {
        "types_found": float(len(types.labelers)),
        "labeler_accuracy": _mean_accuracy(types.labelers),
        "everyone_accuracy": references.everyone.accuracy,
    }
    if observed.truth is not None and references.perfect is not None:
        from sklearn.metrics import adjusted_rand_score

        alike = observed.setting.distinct[observed.truth]
        index = adjusted_rand_score(alike, types.clustering.assignment)
        figures["adjusted_rand_index"] = float(index)
        figures["perfect_labeler_accuracy"] = _mean_accuracy(references.perfect.labelers)
        figures["true_types"] = float(len(np.unique(alike)))
    return figures


def _mean_accuracy(labelers: Iterable[Any]) -> float:
    return float(np.mean([labeler.accuracy for labeler in labelers]))


def _require_tested(labelers: Iterable[Any]) -> None:
    """Raises XplainError where no label could be held out to measure a labeler's confidence."""
    for labeler in labelers:
        if labeler.n_test == 0:
            raise XplainError(
                f"points: too few; the {labeler.n_train} labels of a type are all of one "
                "(transition, message set), and its labeler needs two: one to train it and one "
                "to test it"
            )


def _require_same_features(dataset: Dataset, domain: Domain) -> None:
    names = transition_feature_names(domain)
    if dataset.feature_names != names:
        raise InputError(
            "observers.path",
            ",".join(dataset.feature_names),
            f"labels of {domain.name} need the features {','.join(names)} in this order "
            "(python -m xplain discover finds types in labels of any task)",
        )
    wanted = tuple(parameter.name for parameter in domain.parameters)
    if dataset.messages != wanted:
        raise InputError(
            "observers.messages", ",".join(dataset.messages), f"must be {','.join(wanted)}"
        )
