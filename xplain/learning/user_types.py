"""Finds user types: the type of each observer, one labeler for each type, and what agents know
about users (docs/method.md, section 4).

    Observed ── find_types ── KnownTypes, label tables of any trace

A component ``clusterer`` is a *type finder*, with one method::

    find(observed, seed) -> UserTypes

It receives the trainer of the run, ``labeler=``. A :class:`Clusterer` groups the observers, and
fits a labeler to the labels of each group.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn, Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.domains.users.setting import Setting
from xplain.domains.users.types import user_type
from xplain.errors import DomainError, InputError, XplainError
from xplain.explanation.habits import PAPER, Habits
from xplain.explanation.label_table import DENSE, LabelTable, stack_types
from xplain.learning.answers import AnswerModel
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.observers import Observations
from xplain.learning.evidence import Evidence
from xplain.learning.labelers import Labeler, LabelerTrainer, fresh_accuracy
from xplain.learning.landing import AcceptanceModel, learn_landing
from xplain.learning.types import (
    Clustering,
    KnownTypes,
    TablesOf,
    TraceTables,
    unless_too_large,
)

log = logging.getLogger(__name__)


NOISY = 0.12
"""If the estimated share of wrong answers is above this number, the types are doubtful. On random
maps with 20 labels from each observer (seeds 9300 to 9302) the estimate was 0.04 to 0.07 if 5 %
were wrong, and 0.15 to 0.35 if observers were polite, repeated themselves, or answered at
random."""
NOISY_TEXT = (
    "about %.0f %% of the answers are not what people think: the types may be wrong; compare "
    "explanations that use these types with solver=conformant, and with solver=say_all, whose "
    "cost does not depend on types"
)


class TypeFinder(Protocol):
    """Finds user types: the interface of every component ``clusterer``."""

    def find(self, observed: Observations, seed: int) -> UserTypes:
        """Finds the types of the observers, with one labeler for each type.

        Args:
            observed: the labels of O observers. Their true types, if known, are for scoring; only
                :class:`Perfect` reads them.
            seed: seed of every draw.

        Raises:
            InputError: the data lack something that the method needs.
            TooLargeError: too many data or messages for the method.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class Clusterer(ABC):
    """A type finder that groups the observers.

    Attributes:
        labeler: fits the labeler of each group.
    """

    labeler: LabelerTrainer = field(default_factory=LabelerTrainer)

    @abstractmethod
    def cluster(self, observed: Observations, seed: int) -> Clustering:
        """Groups the observers: one cluster for each type. Arguments and errors are as in
        :meth:`TypeFinder.find`."""

    def find(self, observed: Observations, seed: int) -> UserTypes:
        """Groups the observers and fits a labeler to the labels of each group; see
        :meth:`TypeFinder.find` for the arguments and errors."""
        trainer = self.labeler.adapt_to(observed)  # once: the trainer caches results about its task
        clustering = replace(self, labeler=trainer).cluster(observed, seed)
        types = learn_types(observed.dataset, clustering, trainer, seed)
        landing = learn_landing(observed.dataset, trainer.thoughts(observed.dataset))
        evidence, answers, doubted = types.evidence, types.answers, None
        if evidence is not None and evidence.lost:
            log.warning("%s", evidence)
        if evidence is not None and answers is not None:
            wrong = answers.wrong(observed.dataset.transition, observed.dataset.observer)
            if wrong > NOISY:
                log.warning(NOISY_TEXT, 100 * wrong)
                known = types.wrong is not None and types.everything is not None
                doubted = answers.observers if known else None
        return replace(types, landing=landing, doubted=doubted)


class Perfect(Clusterer):
    """Perfect clustering: the true types, from which the oracle's labelers are learned
    (docs/method.md, section 6)."""

    def cluster(self, observed: Observations, seed: int) -> Clustering:
        """Groups the observers by their true types.

        Raises:
            InputError: the true types are unknown.
        """
        if observed.behaviour is None:
            wanted = "needs simulated observers, whose type is known"
            raise InputError("clusterer", "perfect", wanted)
        return Clustering(np.asarray(observed.behaviour), "perfect", "truth")


class Single(Clusterer):
    """One type for all observers (the paper's baseline)."""

    def cluster(self, observed: Observations, seed: int) -> Clustering:
        """Puts all O observers into cluster 0."""
        everybody = np.zeros(len(observed.dataset.observers), dtype=np.int64)
        return Clustering(everybody, "single", "one type")


@dataclass(frozen=True)
class UserTypes:
    """N learned user types.

    Attributes:
        labelers: N labelers.
        clustering: the observers' types that the labelers were learned from.
        names: N readable names.
        prior: [N] P(type) of the next user.
        answers: error model for the dataset's transitions and observers; None if not learned.
        evidence: how well hypotheses predicted the answers; None without hypotheses.
        everything: the labeler of a person who believes every fact incorrectly; None if facts are
            unknown.
        landing: how often messages are accepted; None if the answers do not show it.
        doubted: facts and ways of some observers, if the types are doubtful, as in
            :class:`~xplain.learning.types.KnownTypes`.
    """

    labelers: tuple[Labeler, ...]
    clustering: Clustering
    names: tuple[str, ...]
    prior: NDArray[np.float64]
    answers: AnswerModel | None = None
    evidence: Evidence | None = None
    everything: Labeler | None = None
    landing: AcceptanceModel | None = None
    doubted: NDArray[np.int64] | None = None

    @property
    def habits(self) -> Habits | None:
        """People's habits of answering and accepting messages, learned from their answers."""
        own = None if self.answers is None else self.answers.habits
        if self.landing is None or not self.landing.missed:
            return own
        own = own or PAPER
        return replace(own, accept=np.full(len(own), self.landing.mean))

    @property
    def wrong(self) -> NDArray[np.float64] | None:
        """[N, n] P(a person of a type believes a fact incorrectly); None if unknown."""
        own = [one for labeler in self.labelers if (one := labeler.wrong) is not None]
        return np.stack(own) if len(own) == len(self.labelers) else None


def label_table(
    labelers: Iterable[Labeler],
    features: NDArray[np.float64],
    transitions: NDArray[np.int64] | None = None,
) -> LabelTable:
    """Makes the table of P(label = 1) of m transitions; each labeler is one type.

    Args:
        labelers: N ≥ 1 labelers.
        features: [m, F] of the transitions, as in the labelers' training.
        transitions: [m, 3] with these features, if known.

    Raises:
        TooLargeError: a labeler tests too many messages on these transitions.
    """
    return stack_types([labeler.table(features, transitions) for labeler in labelers])


@dataclass(frozen=True)
class LabelTableCache:
    """A cache of label tables. Each labeler is called only once for each transition, even if
    several traces contain the transition: these calls may take longer than all later steps.

    Attributes:
        tables: [2^n] P(label = 1) by labeler and transition, only for transitions of the traces.
    """

    tables: dict[tuple[int, bytes], NDArray[np.float64]] = field(default_factory=dict)

    def label_table(
        self,
        labelers: Sequence[Labeler],
        features: NDArray[np.float64],
        transitions: NDArray[np.int64],
    ) -> LabelTable:
        """Makes the same table as :func:`label_table`. The labelers must exist as long as this
        object."""
        return stack_types(
            [self._make_table(labeler, features, transitions) for labeler in labelers]
        )

    def _make_table(
        self, labeler: Labeler, features: NDArray[np.float64], transitions: NDArray[np.int64]
    ) -> LabelTable:
        if labeler.n_messages > DENSE:  # each trace has its own relevant messages
            return labeler.table(features, transitions)
        keys = [(id(labeler), row.tobytes()) for row in np.hstack([features, transitions])]
        new = {key: i for i, key in enumerate(keys) if key not in self.tables}
        if new:
            rows = list(new.values())
            asked = labeler.table(features[rows], transitions[rows]).array(labeler.n_messages)
            self.tables.update(zip(new, asked[0], strict=True))
        return LabelTable.dense([[self.tables[key] for key in keys]])


def learn_types(
    dataset: Dataset,
    clustering: Clustering,
    trainer: LabelerTrainer,
    seed: int,
) -> UserTypes:
    """Fits one labeler to the pooled labels of each cluster (paper, section 4.1). A cluster without
    labels gets the labeler of all observers.

    Args:
        dataset: the labels.
        clustering: clusters of its observers.
        trainer: fits the labelers.
        seed: seed of every fit. It is the same for all types, so a labeler depends only on its
            labels, not on the numbering of clusters.
    """
    clusters = [clustering.members(t) for t in range(clustering.n_types)]
    trainer, answers, evidence = trainer.with_errors(dataset, clustering.assignment)
    labelers = tuple(
        trainer.fit(dataset.of(own) if np.isin(own, dataset.observer).any() else dataset, seed)
        for own in clusters
    )
    names = tuple(f"type_{t}" for t in range(clustering.n_types))
    answers = answers or clustering.answers
    shares, everything = clustering.shares, trainer.everything()
    return UserTypes(labelers, clustering, names, shares, answers, evidence, everything)


def find_types(
    observed: Observations, trainer: LabelerTrainer, finder: TypeFinder, seed: int
) -> tuple[KnownTypes, TablesOf]:
    """Finds the user types that agents know, with a labeler for each: the types that the trainer
    knows, or otherwise the types that the finder finds in the labels. Returns the types, and the
    function that labels a trace.

    Args:
        observed: labels with their setting.
        trainer: fits the labelers that types are compared with, or knows the types.
        finder: finds the types.
        seed: seed of the run.

    Raises:
        InputError: there are too few labels, or the trainer does not know the types that it should
            know.
    """
    if (given := trainer.types_of(observed)) is not None:
        return given
    trainer = trainer.adapt_to(observed)  # once: the trainer caches results about its task with it
    everyone = trainer.fit(observed.dataset, seed)
    _require_tested([everyone])  # before the types: too few labels fail early
    types = finder.find(observed, seed)
    perfect = learn_perfect(observed, trainer, seed, types)
    _require_tested(types.labelers)
    oracle, everything = oracle_labelers(perfect, observed), trainer.everything()
    once = LabelTableCache()

    def tables(features: NDArray[np.float64], transitions: NDArray[np.int64]) -> TraceTables:
        return TraceTables(
            learned=once.label_table(types.labelers, features, transitions),
            everyone=unless_too_large(lambda: once.label_table([everyone], features, transitions)),
            perfect=None if oracle is None else once.label_table(oracle, features, transitions),
            everything=None if everything is None else everything.table(features, transitions),
        )

    clustering = types.clustering
    curve = np.zeros(0) if clustering.curve is None else clustering.curve
    found = KnownTypes(
        learned_types=types.names,
        matched_true_type=_match_true_types(observed, types),
        type_shares=clustering.shares,
        learning=_measure_types(observed, types, everyone, perfect, trainer, seed),
        curve=np.asarray(curve, dtype=float),
        rule=clustering.rule,
        habits=types.habits,
        wrong=types.wrong,
        new=clustering.new,
        doubted=types.doubted,
    )
    return found, tables


def learn_perfect(
    observed: Observations,
    trainer: LabelerTrainer,
    seed: int,
    found: UserTypes | None = None,
) -> UserTypes | None:
    """Learns types under perfect clustering; their labelers are the paper's L_pc. None if the true
    types of the observers are unknown. ``found`` are types that were learned from these labels with
    this trainer and seed; they are returned if their clustering is perfect.

    Raises:
        XplainError: too few labels to hold some out.
    """
    if observed.behaviour is None:
        return None
    perfect = Perfect().cluster(observed, 0)
    if found is not None and np.array_equal(found.clustering.assignment, perfect.assignment):
        return found
    return learn_types(observed.dataset, perfect, trainer, seed)


def oracle_labelers(
    perfect: UserTypes | None, observed: Observations
) -> tuple[Labeler, ...] | None:
    """Returns [M] the labeler of each true type under perfect clustering; None if the true types
    are unknown, or if some type has no observer who behaves like it. The order of the clusters does
    not matter."""
    if perfect is None or observed.setting is None:
        return None
    first = [np.flatnonzero(observed.behaviour == alike)[:1] for alike in observed.setting.distinct]
    if not all(map(len, first)):
        return None
    return tuple(perfect.labelers[perfect.clustering.assignment[int(o[0])]] for o in first)


def _match_true_types(observed: Observations, types: UserTypes) -> NDArray[np.int64]:
    """Finds [N] the true type that most observers of each learned type have, as its number in
    ``Setting.distinct``; −1 if the true types are unknown."""
    matched = np.full(len(types.labelers), -1)
    alike = observed.behaviour
    if alike is not None:
        for learned in range(types.clustering.n_types):
            matched[learned] = np.bincount(alike[types.clustering.members(learned)]).argmax()
    return matched


def _measure_types(
    observed: Observations,
    types: UserTypes,
    everyone: Labeler,
    perfect: UserTypes | None,
    trainer: LabelerTrainer,
    seed: int,
) -> dict[str, float]:
    """Measures how good the found types and their labelers are. Returns the measures by name.

    ``labeler_accuracy`` is the paper's accuracy, on held-out pairs (transition, message
    set).
    ``fresh_accuracy`` is the accuracy on new questions
    (:func:`~xplain.learning.labelers.fresh_accuracy`). Both are means over types.
    """
    clustering = types.clustering
    fresh = [
        fresh_accuracy(observed.dataset.of(clustering.members(t)), trainer, seed)
        for t in range(clustering.n_types)
    ]
    figures = {
        "types_found": float(len(types.labelers)),
        "labeler_accuracy": _mean_accuracy(types.labelers),
        "fresh_accuracy": float(np.mean(fresh)),
        "everyone_accuracy": everyone.accuracy,
    }
    alike = observed.behaviour
    if alike is not None and perfect is not None:
        from sklearn.metrics import adjusted_rand_score

        index = adjusted_rand_score(alike, clustering.assignment)
        figures["adjusted_rand_index"] = float(index)
        figures["perfect_labeler_accuracy"] = _mean_accuracy(perfect.labelers)
        figures["true_types"] = float(len(np.unique(alike)))
    return figures


def _mean_accuracy(labelers: Iterable[Any]) -> float:
    return float(np.mean([labeler.accuracy for labeler in labelers]))


def _require_tested(labelers: Iterable[Any]) -> None:
    """Raises XplainError if no label could be held out to measure a labeler's confidence."""
    for labeler in labelers:
        if labeler.n_test == 0:
            raise XplainError(
                f"points: too few; the {labeler.n_train} labels of a type are all about one "
                "(transition, message set), and a labeler needs two: one for training and one "
                "for the test"
            )


def _build_everything(setting: Setting) -> Setting | None:
    """Builds the setting of one type that believes every fact incorrectly; None if its task has no
    way to the goal, or if there are too many facts."""
    if setting.n_messages > DENSE:
        return None
    names = setting.message_names
    with suppress(DomainError):
        return Setting.build(setting.domain, (user_type(setting.domain, "everything", names),))
    return None


class TrueLabels(LabelerTrainer):
    """A component ``labeler`` that uses true labels instead of a learned labeler.

    An experiment then plans with the labels of the users' own models, and with one type for each
    true type: only the user's type remains unknown. A policy's cost minus the clairvoyant's cost is
    the cost of not knowing the type. The additional cost with a learned labeler is the cost of the
    labeler's errors. True labels exist only for the types of a setting, not for clusters of
    observers. So the clusterer is not used, and the observers only give the shares of the types.

    The labels of a user who has one of the types never have probability 0, so beliefs stay defined.
    Beliefs can become certain: an answer that contradicts a type excludes this type for all later
    steps.
    """

    def __init__(self) -> None:
        """Takes no options."""
        super().__init__()

    def types_of(self, observed: Observations) -> tuple[KnownTypes, TablesOf]:
        """Returns the true types, and the function that labels a trace with their true labels. The
        labeler for all observers predicts the share of observers whose type gives label 1.

        Raises:
            InputError: the observers' types are unknown, as with real people.
        """
        setting, truth = observed.setting, observed.truth
        everything = _build_everything(setting) if setting else None
        if setting is None or truth is None:
            raise InputError("labeler", "truth", "needs simulated observers, whose type is known")
        shares = np.bincount(truth, minlength=len(setting.types)) / len(truth)

        def tables(_: NDArray[np.float64], transitions: NDArray[np.int64]) -> TraceTables:
            labels = setting.true_labels(transitions)
            everybody = unless_too_large(lambda: labels.mix_types(shares))
            wrong = None if everything is None else everything.true_labels(transitions)
            return TraceTables(learned=labels, everyone=everybody, perfect=labels, everything=wrong)

        count = float(len(np.unique(setting.distinct)))
        known = KnownTypes(
            learned_types=tuple(user_type.name for user_type in setting.types),
            matched_true_type=setting.distinct,
            type_shares=shares,
            learning={"types_found": count, "true_types": count},
            curve=np.zeros(0),
            rule="truth",
            wrong=setting.wrong,
        )
        return known, tables

    def fit(self, *_: Any, **__: Any) -> NoReturn:
        """Raises InputError: labelers are fitted to data alone, without a setting."""
        raise InputError("labeler", "truth", "a labeler that learns; true labels are simulated")
