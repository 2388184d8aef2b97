"""The first half of the method: observe, learn the user types, lay out the traces.

    Setting ── Dataset ── UserTypes ── Case (one a trace)

All of it is the same for every solver and λ, and :func:`prepare` ends in plain data, so that a
sweep does this work once. What follows, Problem ── Policy ── Episode, is in
:mod:`xplain.experiment.explanations`. Each stage is one function, which commands and the study
call as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from xplain.data.dataset import Dataset
from xplain.data.observers import Observers
from xplain.data.queries import Queries
from xplain.data.rollouts import sample_trace
from xplain.domains.base import (
    Domain,
    Scene,
    changes_of,
    transition_feature_names,
    transition_features,
)
from xplain.errors import InputError, XplainError, whole_number
from xplain.experiment.known_types import Known, Tables, true_types, unless_too_large
from xplain.explanation.label_table import LabelTable
from xplain.learning.clustering import Clusterer, Perfect
from xplain.learning.cross_validation import fresh_accuracy
from xplain.learning.labelers import Labeler, LabelerTrainer
from xplain.learning.true_labels import TrueLabels
from xplain.learning.user_types import AskedOnce, UserTypes, learn_types
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
        domain, users, observers, queries, labeler, clusterer: chosen in the configuration.
        traces: how many traces to explain.
        max_steps: a trace ends at a terminal state or here.
        seed: of every stream.
    """

    domain: Domain
    users: TypeSource
    observers: Observers
    queries: Queries
    labeler: LabelerTrainer
    clusterer: Clusterer
    traces: int
    max_steps: int
    seed: int

    def __post_init__(self) -> None:
        """Raises InputError for a number out of its range."""
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
        learned: P(label is 1) by the labelers of the N types that were found.
        everyone: of one labeler of all data (the baseline's); None where it looks at too many
            messages on this trace.
        perfect: of M labelers under perfect clustering; None where the true types of the observers
            are unknown, or a type has no observer.
        labels: the true labels of each of M true types.
        changes: what each transition changes, as short phrases; empty where the domain tells none.
    """

    transitions: NDArray[np.int64]
    phrases: tuple[str, ...]
    positions: tuple[tuple[int, int], ...]
    learned: LabelTable
    everyone: LabelTable | None
    perfect: LabelTable | None
    labels: LabelTable
    changes: tuple[tuple[str, ...], ...] = ()


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

    @property
    def behaviour(self) -> NDArray[np.int64] | None:
        """[O] the ``distinct`` number of each observer's type: types that label everything alike
        are one, for whoever clusters and whoever scores. None where the truth is unknown."""
        return None if self.truth is None else self.setting.distinct[self.truth]


@dataclass(frozen=True)
class References:
    """Labelers that policies are compared with.

    Attributes:
        everyone: one labeler of all data (the baseline's).
        perfect: types under perfect clustering, L_pc; None where the true types of the observers
            are unknown.
        oracle: [M] the labeler of each true type under perfect clustering; None where no observer
            behaves like a type, or the true types are unknown.
    """

    everyone: Labeler
    perfect: UserTypes | None = None
    oracle: tuple[Labeler, ...] | None = None


def prepare(components: Components, track: Track[Any] = untracked) -> Prepared:
    """Builds the setting, lets observers label, finds the types and learns their labelers.

    Raises:
        XplainError: the configuration or the data cannot be used; the text says what to change.
    """
    domain, seed = components.domain, components.seed
    observed = observe(domain, components.users, components.observers, components.queries, seed)
    setting = observed.setting
    if isinstance(components.labeler, TrueLabels):
        known = true_types(setting, observed.truth)
    else:
        known = learned_types(observed, components)
    traces = track(range(components.traces), "labelling traces", components.traces)
    return Prepared(
        domain=domain.name,
        messages=setting.message_names,
        sentences=tuple(parameter.message for parameter in domain.parameters),
        types=tuple(user_type.name for user_type in setting.types),
        distinct=setting.distinct,
        learned_types=known.names,
        matched_true_type=known.matched_true_type,
        type_shares=known.shares,
        learning=known.figures,
        curve=known.curve,
        rule=known.rule,
        scene=domain.scene,
        cases=tuple(
            build_case(
                setting, draw_trace(setting, components.max_steps, seed, index), known.tables
            )
            for index in traces
        ),
    )


def learned_types(observed: Observed, components: Components) -> Known:
    """What labels tell: the types that a clusterer finds, with a labeler each.

    Raises:
        InputError: the labels are too few, or not of this domain's features and messages.
    """
    domain, trainer, seed = components.domain, components.labeler, components.seed
    _require_same_features(observed.dataset, domain)
    references = learn_references(observed, trainer, seed)
    types = learn(
        observed.dataset,
        trainer,
        components.clusterer,
        seed,
        observed.behaviour,
        known=references.perfect.by_observers if references.perfect else None,
    )
    _require_tested(types.labelers)
    oracle = references.oracle
    once = AskedOnce()

    def tables(transitions: NDArray[np.int64]) -> Tables:
        features = transition_features(domain, transitions)
        return Tables(
            learned=once.label_table(types.labelers, features, transitions),
            everyone=unless_too_large(
                lambda: once.label_table([references.everyone], features, transitions)
            ),
            perfect=None if oracle is None else once.label_table(oracle, features, transitions),
        )

    clustering = types.clustering
    curve = np.zeros(0) if clustering.curve is None else clustering.curve
    return Known(
        names=types.names,
        matched_true_type=match_true_types(observed, types),
        shares=np.bincount(clustering.assignment) / len(clustering.assignment),
        figures=learning_figures(observed, types, references, trainer, seed),
        curve=np.asarray(curve, dtype=float),
        rule=clustering.rule,
        tables=tables,
    )


def observe(
    domain: Domain, users: TypeSource, observers: Observers, queries: Queries, seed: int
) -> Observed:
    """The true types, and the labels that observers of these types gave when asked.

    Raises:
        XplainError: the types do not fit the domain, or the labels cannot be used.
    """
    setting = Setting.build(domain, users.types(domain, stream(seed, "users")))
    dataset, truth = observers.collect(setting, queries, seed)
    return Observed(setting, dataset, truth)


def learn(
    dataset: Dataset,
    trainer: LabelerTrainer,
    clusterer: Clusterer,
    seed: int,
    truth: NDArray[np.int64] | None = None,
    none_of_these: float = 0.0,
    known: Mapping[tuple[int, ...], Labeler] | None = None,
) -> UserTypes:
    """Clusters the observers, and learns one labeler a cluster.

    Args:
        dataset: the labels.
        trainer: fits labelers.
        clusterer: finds the types.
        seed: of the run.
        truth: [O] true types, which only perfect clustering may look at.
        none_of_these, known: see :func:`xplain.learning.user_types.learn_types`.
    """
    clustering = clusterer.cluster(dataset, trainer, derived_seed(seed, "clusterer"), truth)
    return learn_types(
        dataset,
        clustering,
        trainer,
        labeler_seed(seed),
        none_of_these=none_of_these,
        known=known,
    )


def learn_references(observed: Observed, trainer: LabelerTrainer, seed: int) -> References:
    """The labeler of all data, and the labelers under perfect clustering.

    Raises:
        XplainError: too few labels to hold some out.
    """
    dataset, behaviour = observed.dataset, observed.behaviour
    everyone = trainer.fit(dataset, labeler_seed(seed))
    _require_tested([everyone])
    if behaviour is None:
        return References(everyone)
    best = Perfect().cluster(dataset, trainer, 0, behaviour)
    perfect = learn_types(dataset, best, trainer, labeler_seed(seed))
    return References(everyone, perfect, _of_each_type(perfect, observed))


def labeler_seed(seed: int) -> int:
    """The seed of every labeler of a run: the same labels give the same labeler, so that types
    found right have the labelers of the true ones."""
    return derived_seed(seed, "labelers")


def _of_each_type(perfect: UserTypes, observed: Observed) -> tuple[Labeler, ...] | None:
    """The labeler of each true type; None where no observer behaves like it. Clusters are numbered
    as their observers come, which may be in any order."""
    first = [np.flatnonzero(observed.behaviour == alike)[:1] for alike in observed.setting.distinct]
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
    tables: Callable[[NDArray[np.int64]], Tables],
) -> Case:
    """Lays out what every agent and every user thinks of a trace [m, 3]."""
    domain = setting.domain
    states = [*transitions[:, 0].tolist(), int(transitions[-1, 2])]
    cells = [domain.position(state) for state in states]
    return Case(
        transitions=transitions,
        phrases=tuple(domain.describe(transition) for transition in transitions),
        positions=tuple(cell for cell in cells if cell is not None),
        **tables(transitions)._asdict(),
        labels=setting.true_labels(transitions),
        changes=changes_of(domain, transitions),
    )


def match_true_types(observed: Observed, types: UserTypes) -> NDArray[np.int64]:
    """[N] for each learned type the ``distinct`` number of most of its observers; −1 where the
    observers' true types are unknown."""
    matched = np.full(len(types.labelers), -1)
    alike = observed.behaviour
    if alike is not None:
        for learned in range(types.clustering.n_types):
            matched[learned] = np.bincount(alike[types.clustering.members(learned)]).argmax()
    return matched


def learning_figures(
    observed: Observed,
    types: UserTypes,
    references: References,
    trainer: LabelerTrainer,
    seed: int,
) -> dict[str, float]:
    """How well the types were found and the labels learned, by name.

    ``labeler_accuracy`` is the paper's, on held-out (transition, message set), ``fresh_accuracy``
    what fresh questions would show (:func:`~xplain.learning.cross_validation.fresh_accuracy`).
    Both are means over types.
    """
    clustering = types.clustering
    fresh = [
        fresh_accuracy(observed.dataset.of(clustering.members(t)), trainer, labeler_seed(seed))
        for t in range(clustering.n_types)
    ]
    figures = {
        "types_found": float(len(types.labelers)),
        "labeler_accuracy": _mean_accuracy(types.labelers),
        "fresh_accuracy": float(np.mean(fresh)),
        "everyone_accuracy": references.everyone.accuracy,
    }
    alike = observed.behaviour
    if alike is not None and references.perfect is not None:
        from sklearn.metrics import adjusted_rand_score

        index = adjusted_rand_score(alike, clustering.assignment)
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
