"""Labelers: what people of a type would find explicable, learned from their labels
(docs/method.md, section 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, Range, TooLargeError, checks
from xplain.explanation.label_table import DENSE, MAX_RELEVANT, LabelTable
from xplain.explanation.message_sets import indices
from xplain.learning.data.dataset import Dataset, inputs, query_index
from xplain.learning.data.observers import Observed
from xplain.learning.tree_leaves import cubes
from xplain.randomness import derived_seed, stream


def paper_tree() -> Any:
    """The paper's labeling model: scikit-learn's decision tree, grown until leaves are pure."""
    from sklearn.tree import DecisionTreeClassifier

    return DecisionTreeClassifier()


class OfTruth:
    """A classifier of labels 0 and 1 that says how likely people are to think so, errors in answers
    left out: its probabilities are taken as they are."""

    classes_ = np.array([0, 1])

    def predict_proba(self, x: NDArray[np.float32]) -> NDArray[np.float64]:
        """P(label = 0) and P(label = 1) of rows [P, F + n]: [P, 2]."""
        raise NotImplementedError

    def predict(self, x: NDArray[np.float32]) -> NDArray[np.int64]:
        """The likelier label of rows [P, F + n]: [P]."""
        return (self.predict_proba(x)[:, 1] >= 0.5).astype(np.int64)


@dataclass(frozen=True)
class Labeler:
    """A fitted labeling model L(τ, H) with its confidence P(label = prediction).

    Attributes:
        classifier: fitted, scikit-learn's shape, classes among 0 and 1. Those :class:`OfTruth`
            need no confidence.
        n_messages: n of the message bits it was fitted with.
        confidence: (right + 1) / (tested + 2) on questions held out of training, in (0, 1).
        accuracy: right / tested; NaN where nothing was tested.
        n_train, n_test: distinct questions (transition, message set) in either part.
        calibrated: P(label = 1) comes from the classifier's own probabilities (see
            :class:`LabelerTrainer`), not from the one confidence.
    """

    classifier: Any
    n_messages: int
    confidence: float
    accuracy: float
    n_train: int
    n_test: int
    calibrated: bool = False

    @property
    def means_truth(self) -> bool:
        """Whether P(label = 1) is what people think; else it is what they answer, as the confidence
        is measured on answers."""
        return isinstance(self.classifier, OfTruth)

    @property
    def wrong(self) -> NDArray[np.float64] | None:
        """[n] P(a person of the type holds a fact wrong); None where that is unknown."""
        return None

    def predict(
        self, features: NDArray[np.float64], message_sets: NDArray[np.int64]
    ) -> NDArray[np.uint8]:
        """The label of each (transition [T, F], message set [T]): [T] of 0 and 1."""
        x = inputs(features, message_sets, self.n_messages)
        return np.asarray(self.classifier.predict(x), dtype=np.uint8)

    def probability(
        self, features: NDArray[np.float64], message_sets: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """P(label = 1) of each (transition [T, F], message set [T]): [T], inside (0, 1)."""
        return self._probability(inputs(features, message_sets, self.n_messages))

    def table(
        self, features: NDArray[np.float64], transitions: NDArray[np.int64] | None = None
    ) -> LabelTable:
        """P(label = 1) of T transitions, of people of one type.

        A tree fills it leaf by leaf (n = 20 takes tenths of a second); any other classifier is
        asked for each entry.

        Args:
            features: [T, F].
            transitions: [T, 3] with these features, where they are known; a labeler may tell
                transitions apart that share their features.

        Raises:
            TooLargeError: too many messages matter on these transitions.
        """
        relevant, table = self._looked_at(features)
        return LabelTable.joined_types([relevant], [table])

    def _looked_at(
        self, features: NDArray[np.float64]
    ) -> tuple[Sequence[int], NDArray[np.float64]]:
        """The messages that matter, r of them ascending: all where they are few, else those that
        the labeler looks at; and P(label = 1) under every subset of them, [T, 2^r]."""
        n = self.n_messages
        if hasattr(self.classifier, "tree_"):
            found = cubes(self.classifier.tree_, features, n)
            relevant: Sequence[int] = range(n)
            if n > DENSE:
                relevant = indices(int(np.bitwise_or.reduce(found.ones | found.zeros, initial=0)))
                check_looked_at(len(relevant), n)
            shape = len(features), 1 << len(relevant)
            return relevant, found.over(relevant).table(self._of_leaves(), shape)
        if n > DENSE:
            raise TooLargeError(
                f"labeler: a classifier that is no tree may look at any of {n} messages, more "
                f"than {DENSE}; labeler=pruned is a tree that looks at few"
            )
        return range(n), self._by_sets(features, np.arange(1 << n))

    def _by_sets(
        self, features: NDArray[np.float64], message_sets: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """P(label = 1) of each transition [T, F] under each of the message sets [K]: [T, K]."""
        shape = len(message_sets), features.shape[1]
        every = [self.probability(np.broadcast_to(row, shape), message_sets) for row in features]
        return np.reshape(every, (len(features), len(message_sets)))

    def _probability(self, x: NDArray[np.float32]) -> NDArray[np.float64]:
        if hasattr(self.classifier, "tree_"):
            return np.asarray(self._of_leaves()[self.classifier.apply(x)])
        if self.means_truth:
            return share_of_ones(self.classifier, self.classifier.predict_proba(x))
        if not self.calibrated:
            return self._of_labels(self.classifier.predict(x))
        return self._shrunk(share_of_ones(self.classifier, self.classifier.predict_proba(x)))

    def _of_leaves(self) -> NDArray[np.float64]:
        """[nodes] P(label = 1) in each node of the tree."""
        share = share_of_ones(self.classifier, self.classifier.tree_.value[:, 0, :])
        if not self.calibrated:
            largest = self.classifier.tree_.value[:, 0, :].argmax(axis=1)
            return self._of_labels(self.classifier.classes_[largest])
        return self._shrunk(share, self.classifier.tree_.weighted_n_node_samples)

    def _of_labels(self, label: NDArray[Any]) -> NDArray[np.float64]:
        return np.where(label == 1, self.confidence, 1 - self.confidence)

    def _shrunk(
        self, share: NDArray[np.float64], weight: NDArray[np.float64] | float = np.inf
    ) -> NDArray[np.float64]:
        """Shares of ones among ``weight`` labels, drawn to the confidence of their majority as by
        two more labels; never closer to 0 or 1 than the number of tested labels can show."""
        base = self._of_labels(share >= 0.5)
        pull = 2 / (np.asarray(weight) + 2)
        edge = 1 / (self.n_test + 2)
        return np.clip((1 - pull) * share + pull * base, edge, 1 - edge)


@checks("labeler")
@dataclass(frozen=True)
class LabelerTrainer:
    """Fits a labeler to the labels of some observers.

    The labels are split by distinct (transition, message set): duplicates on both sides would
    leak. The confidence is measured on the held-out part by a classifier that saw only the
    training part, and counts each question once: observers who repeat each other are no further
    evidence. Of a question answered both ways the share that agrees counts as right. With ``refit``
    the labeler returned is then fitted on all labels: it has seen more than the one measured, so
    the confidence errs, if at all, on the modest side.

    Attributes:
        classifier: any scikit-learn classifier, unfitted; it is cloned for every fit.
        holdout: share of the distinct points that is held out, in (0, 1).
        confidence: ``accuracy`` (the paper: one number a labeler) or ``leaf`` (the classifier's
            own probabilities, drawn to that number).
        refit: fit on all labels once the confidence is measured.
    """

    classifier: Any = field(default_factory=paper_tree)
    holdout: Annotated[float, Range(0, 1, "()")] = 0.25
    confidence: Literal["accuracy", "leaf"] = "accuracy"
    refit: bool = True

    def __post_init__(self) -> None:
        for method in ("fit", "predict"):
            if not hasattr(self.classifier, method):
                raise InputError("labeler.classifier", self.classifier, "a scikit-learn classifier")
        if self.confidence == "leaf" and not hasattr(self.classifier, "predict_proba"):
            raise InputError("labeler.classifier", self.classifier, "leaf needs predict_proba")

    def given(self, observed: Observed) -> LabelerTrainer:
        """With what can be used of the observers' task, and of what they were asked, beside their
        labels."""
        return self

    def fit(self, dataset: Dataset, seed: int, measured: bool = True) -> Labeler:
        """Fits one labeler to all labels of a dataset. The same labels, in whatever order, and the
        same seed give the same labeler.

        A single distinct point cannot be split: nothing is tested, the confidence is ½. So it is
        where it is not to be ``measured``: predictions are the same, for half of the work.

        Raises:
            InputError: no labels.
        """
        if len(dataset) == 0:
            raise InputError("data", 0, "a labeler needs at least one label")
        seed = derived_seed(seed, "labelers")
        # Sorted: who answered first must not matter to a classifier that looks at the order.
        dataset = dataset.take(np.lexsort((dataset.label, dataset.message_set, dataset.transition)))
        x = inputs(dataset.features[dataset.transition], dataset.message_set, dataset.n_messages)
        query, test = query_index(dataset), split(dataset, self.holdout, seed)

        def fitted(rows: NDArray[np.bool_]) -> Any:
            return self.fitted_to(dataset.take(np.flatnonzero(rows)), x[rows], seed)

        classifier = fitted(~test | self.refit)
        tested = len(np.unique(query[test])) if measured else 0
        right = 0.0
        if tested:
            trained = fitted(~test) if self.refit else classifier
            agrees = trained.predict(x[test]) == dataset.label[test]
            right = float(by_question(agrees, query[test]).sum())
        return Labeler(
            classifier=classifier,
            n_messages=dataset.n_messages,
            confidence=(right + 1) / (tested + 2),
            accuracy=right / tested if tested else float("nan"),
            n_train=len(np.unique(query[~test | (self.refit and not tested)])),
            n_test=tested,
            calibrated=self.confidence == "leaf",
        )

    def fitted_to(self, dataset: Dataset, x: NDArray[np.float32], seed: int) -> Any:
        """A classifier fitted to the labels of a dataset, whose rows are x [P, F + n]; for those
        who look at more of an answer than its row."""
        return self.fitted(x, dataset.label, seed)

    def fitted(self, x: NDArray[np.float32], y: NDArray[np.uint8], seed: int) -> Any:
        """A fitted clone of the classifier; a constant one where all labels are equal."""
        from sklearn.base import clone
        from sklearn.tree import DecisionTreeClassifier

        # A stump predicts the only label it saw; many classifiers refuse to be fitted to it.
        model = clone(self.classifier) if y.min() != y.max() else DecisionTreeClassifier()
        state = derived_seed(seed, "labeler", "classifier") & 0xFFFFFFFF
        names = [name for name in model.get_params() if name.split("__")[-1] == "random_state"]
        model.set_params(**dict.fromkeys(names, state))
        return model.fit(x, y)


def check_looked_at(count: int, n_messages: int) -> None:
    """Raises TooLargeError where a labeler looks at more than MAX_RELEVANT messages on a trace."""
    if count > MAX_RELEVANT:
        raise TooLargeError(
            f"labeler: a type's labeler looks at {count} of {n_messages} messages on one trace, "
            f"more than {MAX_RELEVANT}; shorter traces, or a pruned tree (labeler=pruned), look "
            "at fewer"
        )


def split(dataset: Dataset, holdout: float, seed: int) -> NDArray[np.bool_]:
    """Which labels are held out, by distinct (transition, message set): [P].

    Both parts get at least one distinct point where there are two.
    """
    query = query_index(dataset)
    count = int(query.max()) + 1
    held = round(holdout * count) if count < 2 else min(max(round(holdout * count), 1), count - 1)
    order = stream(seed, "labeler", "split").permutation(count)
    out = np.zeros(count, dtype=bool)
    out[order[: held if count > 1 else 0]] = True
    return np.asarray(out[query])


def by_question(right: NDArray[np.bool_], query: NDArray[np.int64]) -> NDArray[np.float64]:
    """The share of right labels [P] of each distinct question: [distinct]."""
    _, number = np.unique(query, return_inverse=True)
    share: NDArray[np.float64] = np.bincount(number, right) / np.bincount(number)
    return share


def share_of_ones(classifier: Any, shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """The column of class 1 in shares [*, classes]; 0 where no such class was seen."""
    where = np.flatnonzero(classifier.classes_ == 1)
    return shares[:, where[0]] if len(where) else np.zeros(len(shares))
