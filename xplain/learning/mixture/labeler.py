"""A labeler that uses hypotheses: it predicts P(label = 1) of people of one type from the facts
that they may believe incorrectly (docs/what-to-ask.md).

The labeler holds a posterior over fact sets. If answers contradict the hypotheses in a cell, the
answers decide the label of this cell (:mod:`xplain.learning.mixture.likelihood`); all other cells
keep the label of the hypotheses. The result is a weighted mean with predictions from labels alone
(:mod:`xplain.learning.evidence`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from xplain.domains.users.hypotheses import Hypotheses, hypotheses_of
from xplain.errors import InputError, TooLargeError
from xplain.explanation.label_table import DENSE, LabelTable
from xplain.explanation.message_sets import bits_of, indices, names_of, subsets
from xplain.learning.answers import AnswerModel
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.observers import Observations
from xplain.learning.evidence import DOUBTED, Evidence, predict_in_order
from xplain.learning.labelers import (
    Labeler,
    LabelerTrainer,
    MeasuredLabeler,
    TableLabeler,
    by_sets,
    cheap,
    check_tested_messages,
    paper_tree,
)
from xplain.learning.mixture.likelihood import (
    DEVIATION,
    ERROR,
    Cells,
    KnownTransitions,
    by_level,
    cell_posterior,
    scale_errors,
)
from xplain.learning.mixture.partition import errors_of, learn_ways, partition
from xplain.learning.prediction import log_likelihood
from xplain.learning.types import Clustering

log = logging.getLogger(__name__)

KEPT = 1e-4
"""Predictions leave out fact sets with a smaller posterior."""
OFTEN = 0.05
RELEVANT = 0.01
MOST = 12
MAX_TABLE = 1 << 24
EDGE = 0.002
"""Minimum distance of a probability from 0 and 1. Each label of a prefix is counted again at every
later step, so larger doubts without evidence would add up and lead to unnecessary messages."""


@dataclass(frozen=True, kw_only=True)
class HypothesisLabeler(MeasuredLabeler):
    """The posterior over the fact sets of people of one type, and the labels that follow from it.

    It predicts what people find explicable, f, not what they answer: errors in answers are left
    out. The labeler :attr:`alone` predicts transitions that the hypotheses do not contain. If
    transitions are given by their states, transitions with equal features are distinguished.

    A *variant* is a further table of the hypotheses' labels, for people who believe other
    inaccurate values, for example half or double the assumed inaccurate values. δ is the
    probability that the label of a cell differs from the hypotheses
    (:mod:`xplain.learning.mixture.likelihood`).

    Attributes:
        known: the hypotheses.
        fit_alone: fits a labeler to the labels alone.
        trust: weight of the hypotheses; ``alone`` has the remaining weight. The weight is 1 if
            people agree with the hypotheses (:attr:`doubt`).
        facts: [R] likely fact sets.
        weight: [R, 1 + V, D] joint posterior of the fact set, the variant (index 0 is no variant)
            and the value of δ.
        cells: cells of the answers, for each fact set.
        learned: [N] P(f = 1) of each cell, times the weight of its fact set.
        level: [E] posterior of the error levels.
    """

    known: KnownTransitions
    fit_alone: Callable[[], Labeler]
    trust: float
    facts: NDArray[np.int64]
    weight: NDArray[np.float64]
    cells: Cells
    learned: NDArray[np.float64]
    level: NDArray[np.float64]
    means_truth = True

    @classmethod
    def of(
        cls,
        known: KnownTransitions,
        answers: Dataset,
        fit_alone: Callable[[], Labeler],
        given: NDArray[np.float64] | None = None,
        trust: float = 1.0,
    ) -> HypothesisLabeler:
        """Makes the labeler from answers: computes the posterior over fact sets, variants and
        values of δ.

        Args:
            known: the hypotheses; likely fact sets and their neighbours are added.
            fit_alone: see the class.
            answers: P answers of people of the type about known transitions.
            given: [P, 2, E] log P(answer | f) for f = 0 and 1 and each of E equally likely error
                levels; None: all answers have the same error rate.
            trust: weight of the hypotheses.
        """
        given = by_level(answers.label) if given is None else given
        known, about = known.grow(answers), (answers.transition, answers.message_set)
        facts = known.find_supported(answers)
        prior = np.log(known.prior_of(facts) + 1e-300)
        joint = Cells.of(known, *about, facts).log_likelihood(given)
        joint += prior[:, None, None, None] + known.log_prior[:, :, None]
        posterior = np.exp(joint - logsumexp(joint))
        kept = posterior.sum(axis=(1, 2, 3)) > KEPT
        posterior = posterior[kept] / posterior[kept].sum()
        cells = Cells.of(known, *about, facts[kept])
        zero, one = cells.sum_evidence(given)
        of_cell = cell_posterior(cells.one[..., None], one - zero)
        made = cls(
            known=known,
            fit_alone=fit_alone,
            trust=trust,
            facts=facts[kept],
            weight=posterior.sum(axis=3),
            cells=cells,
            learned=(of_cell * posterior[cells.which]).sum(axis=(1, 2, 3)),
            level=posterior.sum(axis=(0, 1, 2)),
            n_messages=known.hypotheses.n_messages,
        )
        return made if made.doubt > DOUBTED else replace(made, trust=1.0)

    @cached_property
    def alone(self) -> Labeler:
        """A labeler fitted to the labels alone. It is fitted when it is first used."""
        return self.fit_alone()

    @property
    def doubt(self) -> float:
        """P(the hypotheses are wrong at one transition in twenty, or more)."""
        return float(self.weight[:, :, DEVIATION >= OFTEN].sum())

    @property
    def unwritten(self) -> float:
        """P(people of the type believe a fact incorrectly that no hypothesis contains)."""
        return float(self.weight[(self.facts & self.known.unwritten) > 0].sum())

    def log_answered(self, answers: Dataset) -> NDArray[np.float64]:
        """Computes [P] the log probability of further answers. An answer differs from the label
        with the mean error rate of the posterior ``level``."""
        one = self.predict_known(answers.transition, answers.message_set)
        error = self.level @ ERROR
        same = np.where(answers.label == 1, one, 1 - one)
        return np.asarray(np.log(same * (1 - error) + (1 - same) * error))

    @cached_property
    def _share(self) -> NDArray[np.float64]:
        """[n] P(a person of the type believes the fact incorrectly); it can be 0 or 1."""
        share: NDArray[np.float64] = self.weight.sum(axis=(1, 2)) @ bits_of(
            self.facts, self.n_messages
        )
        return share

    @property
    def wrong(self) -> NDArray[np.float64]:
        """[n] P(a person of the type believes the fact incorrectly), never exactly 0 or 1."""
        return np.clip(self._share, EDGE, 1 - EDGE)

    def predict_known(
        self, transition: NDArray[np.int64], told: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Computes [P] P(f = 1) of known transitions [P] given message sets [P]."""
        result = np.zeros(len(transition))
        for r in range(len(self.facts)):
            cells = Cells.of(self.known, transition, told, self.facts[[r]])
            one = (cells.one * self.weight[r]).sum(axis=(1, 2))
            own = np.flatnonzero(self.cells.which == r)
            _, here, there = np.intersect1d(
                cells.key, self.cells.key[own], assume_unique=True, return_indices=True
            )
            one[here] = self.learned[own][there]
            result += one[cells.where[0]]
        return self._weigh_with_labels(result, self.known.features[transition], told)

    def exactly(
        self, transitions: NDArray[np.int64], told: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Computes [P] P(f = 1) of transitions [P], given the messages ``told`` [P]. The
        hypotheses' own label of each transition is used, not the mean label of the transitions with
        equal features. The answers do not change this label, because it is unknown which of several
        transitions with equal features an answer was about."""
        result = np.zeros(len(transitions))
        for r, facts in enumerate(self.facts.tolist()):
            one = self.known.exactly(facts & ~told, transitions)
            result += (one * self.weight[r]).sum(axis=(1, 2))
        features = self.known.hypotheses.features
        assert features is not None
        return self._weigh_with_labels(result, features[transitions], told)

    def _weigh_with_labels(
        self, one: NDArray[np.float64], features: NDArray[Any], told: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Computes the weighted mean of P(f = 1) by the hypotheses and by labels alone.

        Args:
            one: [P] P(f = 1) by the hypotheses.
            features: [P, F] features of the transitions.
            told: [P] message sets.

        Returns:
            [P] the mean.
        """
        if self.trust < 1:
            alone = self.alone.probability(features, told)
            one = self.trust * one + (1 - self.trust) * alone
        return np.clip(one, EDGE, 1 - EDGE)

    def probability(
        self, features: NDArray[np.float64], message_sets: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Computes [T] P(label = 1) of each pair (transition [T, F], message set [T]). ``alone``
        predicts transitions that the hypotheses do not contain."""
        transition = self.known.find(features)
        rows, one = transition >= 0, np.empty(len(features))
        one[rows] = self.predict_known(transition[rows], message_sets[rows])
        if not rows.all():
            one[~rows] = self.alone.probability(features[~rows], message_sets[~rows])
        return one

    def table(
        self, features: NDArray[np.float64], transitions: NDArray[np.int64] | None = None
    ) -> LabelTable:
        """Computes the table of P(label = 1). Its relevant messages are all messages if there are
        at most DENSE, otherwise the messages about facts that people of the type are likely to
        believe incorrectly."""
        place = self.known.find(features)
        relevant = self._find_relevant(features, place)
        sets = subsets(relevant)
        table = by_sets(self.probability, features, sets)
        if transitions is not None:
            rows = np.flatnonzero((place >= 0) & self.known.ambiguous[place])
            found = self.known.find_exactly(features[rows], transitions[rows][:, [0, 2]])
            for row, t in zip(rows[found >= 0].tolist(), found[found >= 0].tolist(), strict=True):
                table[row] = self.exactly(np.full(len(sets), t), sets)
        return LabelTable.join_types([relevant], [table])

    def _find_relevant(
        self, features: NDArray[np.float64], place: NDArray[np.int64]
    ) -> Sequence[int]:
        """Finds the relevant messages of the table, ascending: all messages if there are at most
        DENSE.

        Otherwise a message is relevant if people of the type may believe its fact incorrectly. If
        not all fact sets are candidates, the probability of this must be at least RELEVANT, and the
        fact must be one of the MOST most probable facts. For transitions that labels alone help to
        predict, the messages that the labeler :attr:`alone` tests are relevant too. The table
        assumes that no other message is given.
        """
        if self.n_messages <= DENSE:
            return range(self.n_messages)
        likely = np.argsort(-self._share, kind="stable")[:MOST].tolist()
        found = {j for j in likely if self._share[j] >= RELEVANT}
        if self.known.hypotheses.complete:
            found = {*indices(int(np.bitwise_or.reduce(self.facts, initial=0)))}
        unknown = (place < 0) | (self.trust < 1)
        if unknown.any():
            found |= {*self.alone.table(features[unknown]).rows[0]}
        check_tested_messages(len(found), self.n_messages)
        return sorted(found)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Returns the arrays for a file of types: distinct rows of features [U, F], and P(label =
        1) of each row by message set [U, 2^n].

        Raises:
            TooLargeError: more than MAX_TABLE numbers.
        """
        rows, n = self.known.features, self.n_messages
        if len(rows) << n > MAX_TABLE:
            size = f"{len(rows)} × 2^{n}"
            raise TooLargeError(f"types: a table of {size} labels is too large for a file")
        told = np.tile(np.arange(1 << n), len(rows))
        table = self.predict_known(np.repeat(np.arange(len(rows)), 1 << n), told)
        return {"rows": rows, "table": table.reshape(len(rows), 1 << n)}


@dataclass(frozen=True)
class KnownAnswers:
    """The answers of a dataset about transitions that the hypotheses contain.

    Attributes:
        known: the hypotheses.
        dataset: these answers, sorted by observer; its transitions are those of ``known``.
        place: [T] for each transition of the full dataset, the index in ``known`` of the transition
            with the same features; −1 if the hypotheses do not contain it.
    """

    known: KnownTransitions
    dataset: Dataset
    place: NDArray[np.int64]

    @classmethod
    def of(cls, known: KnownTransitions, dataset: Dataset) -> KnownAnswers:
        """Selects the answers of a dataset about known transitions. The dataset must have the
        features and messages of the hypotheses."""
        place = known.find(dataset.features)
        rows = np.concatenate(dataset.rows)
        own = dataset.take(rows[place[dataset.transition[rows]] >= 0])
        features = known.features.astype(np.float64)
        return cls(known, replace(own, features=features, transition=place[own.transition]), place)

    @cached_property
    def grown(self) -> KnownTransitions:
        """The hypotheses, extended by the fact sets that any observer's answers make likely."""
        known = self.known
        for own in map(self.dataset.take, self.dataset.rows):
            known = known.with_sets(self.known.grow(own).find_supported(own))
        return known

    def partition(
        self, concentration: float
    ) -> tuple[NDArray[np.int64], AnswerModel, NDArray[np.float64] | None]:
        """Finds the most likely types, with concentration α of the Chinese restaurant process."""
        return partition(self.grown, self.dataset, concentration)

    def cluster(self, dataset: Dataset, concentration: float) -> Clustering | None:
        """Finds the types of :meth:`partition`, with the expected answers to all transitions of the
        full dataset. None if labels alone predict answers better."""
        facts, _, expected = self.partition(concentration)
        if self.evidence(np.unique(facts, return_inverse=True)[1]).beaten:
            return None
        if surprise := int(np.bitwise_or.reduce(facts & self.grown.unwritten)):
            names = ", ".join(names_of(surprise, dataset.messages))
            said = "some people believe facts incorrectly that no hypothesis has: %s"
            log.warning(said, names)
        if expected is not None:
            place, count = self.place, len(self.place)
            ones = np.bincount(dataset.transition, dataset.label, count)
            mean = (ones + 1) / (np.bincount(dataset.transition, minlength=count) + 2)
            expected = np.where(place >= 0, expected[:, place], mean)
        return Clustering.by_facts(facts, "hypotheses", expected=expected)

    def evidence(self, assignment: NDArray[np.int64]) -> Evidence:
        """Measures how well the hypotheses predict the answers, given the observers' types [O]."""
        data = self.dataset

        ways = (
            lambda train, test: self._fit_labeler(train).log_answered(test),
            lambda train, test: log_likelihood(cheap().fit(train, 0), test),
        )
        rows, own, alone = predict_in_order(data, assignment, ways)
        members = (np.flatnonzero(assignment == t) for t in range(int(assignment.max()) + 1))
        types = [self._fit_labeler(data.of(people)) for people in members]
        doubt, unwritten = np.array([(one.doubt, one.unwritten) for one in types]).T
        return Evidence(own, alone, assignment[data.observer[rows]], doubt, unwritten)

    def _fit_labeler(self, data: Dataset) -> HypothesisLabeler:
        """Fits a labeler to people of one type. All answers are assumed to have the same error
        rate."""
        return HypothesisLabeler.of(self.known, data, partial(cheap().fit, data, 0))


@dataclass(frozen=True, kw_only=True)
class EverythingWrong(TableLabeler):
    """A labeler for a person who believes every fact incorrectly. It predicts from the hypotheses
    alone, and distinguishes transitions with equal features if their states are given.

    Attributes:
        known: hypotheses that contain every set of the facts; there are at most DENSE facts.
    """

    known: KnownTransitions

    def table(
        self, features: NDArray[np.float64], transitions: NDArray[np.int64] | None = None
    ) -> LabelTable:
        """Makes the table of P(label = 1), by the hypotheses; ½ for transitions that the hypotheses
        do not contain."""
        table = super().table(features)
        if transitions is not None:
            exact = self.known.find_exactly(features, transitions[:, [0, 2]])
            labels = self.known.hypotheses.labels[::-1, exact[exact >= 0]]
            table.p[exact >= 0, :, 0] = np.clip(labels.T, EDGE, 1 - EDGE)
        return table


@dataclass(frozen=True)
class HypothesisTrainer(LabelerTrainer):
    """Fits labelers that use hypotheses of what people may believe incorrectly.

    Labels of another task (with other features or messages) and of transitions that the hypotheses
    do not contain are learned without hypotheses. If people of a type disagree with the hypotheses,
    the labeler is a weighted mean of predictions with and without the hypotheses
    (:mod:`xplain.learning.evidence`).

    Attributes:
        classifier: learns from labels alone; any scikit-learn classifier with probabilities.
        holdout: share of the distinct questions held out to measure the accuracy.
        path: an ``.npz`` file of hypotheses with features; None: the hypotheses of the observers'
            domain.
        hypotheses: used instead of ``path`` and of the domain's hypotheses.
        answers: error model of the answers about known transitions; None: all answers have the same
            error rate.
        evidence: how well the dataset's answers were predicted; None: hypotheses are trusted.
        types: [O] types of the dataset's observers, as in ``evidence``.
    """

    classifier: Any = field(default_factory=paper_tree)
    path: str | None = None
    hypotheses: Hypotheses | None = None
    answers: AnswerModel | None = None
    evidence: Evidence | None = None
    types: NDArray[np.int64] | None = None

    def adapt_to(self, observed: Observations) -> LabelerTrainer:
        """Returns a trainer with the hypotheses of the observers' domain, extended by the fact sets
        that their answers made likely. A trainer that already has hypotheses is returned
        unchanged."""
        if self.hypotheses is not None or self.path is not None:
            return self
        return replace(self, hypotheses=observed.hypotheses)

    @cached_property
    def known(self) -> KnownTransitions:
        """The hypotheses, indexed by the features of a transition.

        Raises:
            InputError: no hypotheses, or hypotheses without features.
        """
        hypotheses = self.hypotheses or hypotheses_of(None, self.path)
        if hypotheses.features is None:
            raise InputError("hypotheses.features", None, "needed to match labels with hypotheses")
        return KnownTransitions.of(hypotheses)

    def fit_unmeasured(self, dataset: Dataset, seed: int) -> MeasuredLabeler:
        """Fits a labeler that uses the hypotheses. Labels of another task are learned without
        hypotheses."""
        if not self._is_about(dataset):
            return self._alone.fit_unmeasured(dataset, seed)
        asked, given, trust = KnownAnswers.of(self.known, dataset), None, 1.0
        own = asked.dataset
        if self.answers is not None:
            given = scale_errors(self.answers.log_given(own), own.label)
        if self.evidence is not None and self.types is not None:
            trust = float(self.evidence.trust[self.types[own.observer]].mean())
        trainer = self._alone if dataset.n_messages <= DENSE else cheap()
        alone = partial(trainer.fit, dataset, seed)
        return HypothesisLabeler.of(self.known, own, alone, given, trust)

    @property
    def _alone(self) -> LabelerTrainer:
        """A trainer that learns from labels alone."""
        return LabelerTrainer(self.classifier, self.holdout, "leaf")

    def with_errors(
        self, dataset: Dataset, assignment: NDArray[np.int64]
    ) -> tuple[LabelerTrainer, AnswerModel | None, Evidence | None]:
        """Learns the errors of a dataset's people, and how well the hypotheses predict their
        answers."""
        known = self.select_known_answers(dataset)
        if known is None:
            return self, self.answers, self.evidence
        made = errors_of(known.grown, known.dataset, assignment)
        where = [*known.place, -1]
        answers = replace(made, slip=made.slip[where], guess=made.guess[where])
        ways, observers = learn_ways(known.known, known.dataset)
        answers = replace(answers, ways=ways, observers=observers)
        evidence = known.evidence(assignment)
        return (
            replace(self, answers=made, types=assignment, evidence=evidence),
            answers,
            evidence,
        )

    def everything(self) -> Labeler | None:
        """Returns the labeler of a person who believes every fact incorrectly; None if not all fact
        sets are hypotheses, or if there are too many facts."""
        known, n = self.known, self.known.hypotheses.n_messages
        if n > DENSE or len(known.hypotheses.facts) < 1 << n:
            return None
        # Row R of the table has the labels of people who believe R incorrectly. After the messages
        # H this is the complement of H.
        values = np.clip(known.share[0, ::-1].T, EDGE, 1 - EDGE)
        about: dict[str, Any] = {"n_messages": n, "confidence": np.nan, "n_test": 1}
        return EverythingWrong(known=known, rows=known.features, values=values, **about)

    def thoughts(self, dataset: Dataset) -> NDArray[np.float64] | None:
        """Computes [2^n, T] P(label = 1) of a dataset's transitions by the facts believed
        incorrectly; 1 for transitions that the hypotheses do not contain."""
        asked = self.select_known_answers(dataset)
        if asked is None or self.everything() is None:
            return None
        return np.where(asked.place >= 0, self.known.share[0][:, asked.place], 1.0)

    def select_known_answers(self, dataset: Dataset) -> KnownAnswers | None:
        """Selects the answers about transitions that the hypotheses contain; None if there are no
        such answers."""
        if not self._is_about(dataset):
            return None
        asked = KnownAnswers.of(self.known, dataset)
        return asked if (asked.place >= 0).any() else None

    def cluster(self, dataset: Dataset, concentration: float) -> Clustering | None:
        """Finds the observers' types by the hypotheses; None if no answer is about a known
        transition, or if labels alone predict answers better."""
        asked = self.select_known_answers(dataset)
        return None if asked is None else asked.cluster(dataset, concentration)

    def _is_about(self, dataset: Dataset) -> bool:
        """True if the hypotheses are about the dataset's task."""
        hypotheses = self.known.hypotheses
        names = hypotheses.feature_names or dataset.feature_names
        return names == dataset.feature_names and hypotheses.messages == dataset.messages
