"""Labelers: predict which transitions people of a type find explicable. They are learned from
labels (docs/method.md, section 3)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, Range, TooLargeError, checks
from xplain.explanation.label_table import DENSE, LabelTable
from xplain.explanation.message_sets import subsets
from xplain.learning.answers import AnswerModel
from xplain.learning.data.dataset import (
    Dataset,
    inputs,
    make_labelled_inputs,
    places,
    query_index,
)
from xplain.learning.data.observers import Observations
from xplain.learning.evidence import Evidence
from xplain.learning.types import Clustering, KnownTypes, TablesOf
from xplain.randomness import derive_seed, stream

MOST_LOOKED_AT = 16
"""Maximum number of messages that may change a labeler's predictions about one trace."""
MANY = 10_000
"""If there are more labels than this number, equal rows are fitted as one row with a weight, which
is faster."""
ROWS = 1 << 16
"""Maximum number of rows in one call of a classifier."""


def paper_tree() -> Any:
    """Makes the paper's labeling model: scikit-learn's decision tree, grown until leaves are
    pure."""
    from sklearn.tree import DecisionTreeClassifier

    return DecisionTreeClassifier()


class Labeler(Protocol):
    """Predicts what people of one type find explicable: the interface of every labeler. Your own
    class inherits from it and has ``n_messages`` and :meth:`table`.

    Attributes:
        n_messages: number n of messages in training.
        confidence: P(label = prediction), estimated from held-out questions: (correct predictions +
            1) / (predictions + 2), strictly between 0 and 1; NaN if not measured.
        accuracy: share of correct predictions on held-out questions; NaN if nothing was held out.
        n_train, n_test: numbers of distinct questions (transition, message set) in the training
            part and the held-out part; ``n_test`` is 0 if there were too few questions to hold any
            out.
        means_truth: True if P(label = 1) is what people think, without errors in their answers.
            False if it is what people answer. The confidence is always measured on answers.
        wrong: [n] P(a person of the type believes a fact incorrectly); None if unknown.
    """

    n_messages: int
    confidence: float = math.nan
    accuracy: float = math.nan
    n_train: int = 0
    n_test: int = 1
    means_truth: bool = False

    def table(
        self, features: NDArray[np.float64], transitions: NDArray[np.int64] | None = None
    ) -> LabelTable:
        """Computes P(label = 1) of T transitions for people of one type.

        Args:
            features: [T, F].
            transitions: [T, 3] with these features, if known; a labeler may distinguish transitions
                with equal features.

        Raises:
            TooLargeError: too many messages matter on these transitions.
        """
        ...

    @property
    def wrong(self) -> NDArray[np.float64] | None:
        """[n] P(a person of the type believes a fact incorrectly); None if unknown."""
        return None

    def probability(
        self, features: NDArray[np.float64], message_sets: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Computes [T] P(label = 1) of each pair (transition [T, F], message set [T]), strictly
        between 0 and 1."""
        distinct, where = np.unique(features, axis=0, return_inverse=True)
        table = self.table(distinct)
        return table.p[where.ravel(), table.subset(message_sets[:, None, None])[:, 0], 0]

    def predict(
        self, features: NDArray[np.float64], message_sets: NDArray[np.int64]
    ) -> NDArray[np.uint8]:
        """Predicts [T] the more likely label (0 or 1) of each pair (transition [T, F], message set
        [T])."""
        return (self.probability(features, message_sets) >= 0.5).astype(np.uint8)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Returns arrays for a file of types, by name.

        Raises:
            InputError: the labeler cannot be written.
        """
        raise InputError("types", type(self).__name__, "a labeler with arrays() to write to a file")


@dataclass(frozen=True, kw_only=True)
class MeasuredLabeler(Labeler):
    """A labeler whose accuracy was measured on held-out labels (see the attributes of
    :class:`Labeler`)."""

    n_messages: int
    confidence: float = 0.5
    accuracy: float = math.nan
    n_train: int = 0
    n_test: int = 0


@dataclass(frozen=True, kw_only=True)
class FittedLabeler(MeasuredLabeler):
    """A fitted scikit-learn classifier with its confidence.

    Attributes:
        classifier: fitted; its classes are among 0 and 1.
        calibrated: True if P(label = 1) comes from the classifier's own probabilities (see
            :class:`LabelerTrainer`), False if it comes from the confidence.
    """

    classifier: Any
    calibrated: bool = False

    def predict(
        self, features: NDArray[np.float64], message_sets: NDArray[np.int64]
    ) -> NDArray[np.uint8]:
        """Returns [T] the labels that the classifier predicts."""
        x = inputs(features, message_sets, self.n_messages)
        return np.asarray(self.classifier.predict(x), dtype=np.uint8)

    def probability(
        self, features: NDArray[np.float64], message_sets: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Computes [T] P(label = 1), from the classifier's own probabilities if ``calibrated``,
        otherwise from its prediction and the confidence."""
        if not self.calibrated:
            return self._apply_confidence(self.predict(features, message_sets))
        x = inputs(features, message_sets, self.n_messages)
        found = self.classifier.predict_proba(x)
        one = np.flatnonzero(self.classifier.classes_ == 1)
        share = found[:, one[0]] if len(one) else np.zeros(len(x))
        if not hasattr(self.classifier, "tree_"):
            return self._shrink_shares(share)
        tree = self.classifier.tree_  # scikit-learn's; leaves have weights
        return self._shrink_shares(share, tree.weighted_n_node_samples[self.classifier.apply(x)])

    def table(
        self, features: NDArray[np.float64], transitions: NDArray[np.int64] | None = None
    ) -> LabelTable:
        """Computes the table of P(label = 1). Its relevant messages are all messages if there are
        at most DENSE, otherwise the messages that the classifier tests."""
        n = self.n_messages
        relevant = range(n) if n <= DENSE else find_tested_messages(self.classifier, features, n)
        table = by_sets(self.probability, features, subsets(relevant))
        return LabelTable.join_types([relevant], [table])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Returns the classifier in the format of skops, for a file of types."""
        import skops.io

        classifier = np.frombuffer(skops.io.dumps(self.classifier), dtype=np.uint8)
        return {"skops": classifier, "calibrated": np.array(self.calibrated)}

    def _apply_confidence(self, label: NDArray[Any]) -> NDArray[np.float64]:
        return np.where(label == 1, self.confidence, 1 - self.confidence)

    def _shrink_shares(
        self, share: NDArray[np.float64], weight: NDArray[np.float64] | float = np.inf
    ) -> NDArray[np.float64]:
        """Shrinks ``share``, the share of labels 1 among ``weight`` labels, towards the confidence
        of the majority label, which counts as two further labels. The results are at least
        1 / (n_test + 2) away from 0 and 1."""
        base = self._apply_confidence(share >= 0.5)
        pull = 2 / (np.asarray(weight) + 2)
        edge = 1 / (self.n_test + 2)
        return np.clip((1 - pull) * share + pull * base, edge, 1 - edge)


@dataclass(frozen=True, kw_only=True)
class TableLabeler(MeasuredLabeler):
    """A labeler of known transitions: a table of what people of a type think.

    Attributes:
        rows: [U, F] float32 features of the known transitions.
        values: [U, 2^n] P(label = 1) of these transitions under each message set.
    """

    rows: NDArray[np.float32]
    values: NDArray[np.float64]
    means_truth = True

    def table(
        self, features: NDArray[np.float64], transitions: NDArray[np.int64] | None = None
    ) -> LabelTable:
        """Returns P(label = 1) of T transitions from the table; ½ for transitions that are not in
        it."""
        place = places(features.astype(np.float32), self.rows)
        known = (place >= 0)[:, None]
        return LabelTable.dense([np.where(known, self.values[place], 0.5)])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Returns the rows and the table, for a file of types."""
        return {"rows": self.rows, "table": self.values}


@checks("labeler")
@dataclass(frozen=True)
class LabelerTrainer:
    """Fits a labeler to the labels of some observers.

    The labels are split by distinct questions (transition, message set), so that no question is in
    both parts. The confidence is measured on the held-out part, with a classifier fitted to the
    training part. Each question counts once, because observers who give the same answer are no
    further evidence. If a question has both answers, the share of correct predictions counts. The
    returned labeler is fitted to all labels, so its true accuracy is at least about the measured
    one.

    Attributes:
        classifier: any unfitted scikit-learn classifier; it is cloned for every fit.
        holdout: share of the distinct questions that is held out, strictly between 0 and 1.
        confidence: ``accuracy`` (the paper: one number for a labeler) or ``leaf`` (the classifier's
            own probabilities, shrunk towards the labeler's one number).
    """

    classifier: Any = field(default_factory=paper_tree)
    holdout: Annotated[float, Range(0, 1, "()")] = 0.25
    confidence: Literal["accuracy", "leaf"] = "accuracy"

    def __post_init__(self) -> None:
        for method in ("fit", "predict"):
            if not hasattr(self.classifier, method):
                raise InputError("labeler.classifier", self.classifier, "a scikit-learn classifier")
        if self.confidence == "leaf" and not hasattr(self.classifier, "predict_proba"):
            raise InputError("labeler.classifier", self.classifier, "leaf needs predict_proba")

    def adapt_to(self, observed: Observations) -> LabelerTrainer:
        """Returns a trainer that uses what is known about the observers' task and questions; by
        default, the trainer itself."""
        return self

    def types_of(self, observed: Observations) -> tuple[KnownTypes, TablesOf] | None:
        """Returns the types that are known without labels, and the function that labels a trace;
        None if labels are needed.

        Raises:
            InputError: the types of these observers are unknown.
        """
        return None

    def cluster(self, dataset: Dataset, concentration: float) -> Clustering | None:
        """Finds the observers' types by hypotheses: a Dirichlet process over fact sets with α =
        ``concentration``. None if there are no hypotheses, or if labels alone predict answers
        better."""
        return None

    def everything(self) -> Labeler | None:
        """Returns the labeler of a person who believes every fact incorrectly; None if facts are
        unknown or too many."""
        return None

    def thoughts(self, dataset: Dataset) -> NDArray[np.float64] | None:
        """Computes [2^n, T] P(label = 1) of a dataset's T transitions by the facts believed
        incorrectly; None if facts are unknown or too many."""
        return None

    def with_errors(
        self, dataset: Dataset, assignment: NDArray[np.int64]
    ) -> tuple[LabelerTrainer, AnswerModel | None, Evidence | None]:
        """Learns the errors of a dataset's people, given their types [O].

        Returns the trainer, the error model of the answers, and how well the hypotheses predicted
        the dataset. The last two are None if the trainer does not learn them.
        """
        return self, None, None

    def fit(self, dataset: Dataset, seed: int, measured: bool = True) -> MeasuredLabeler:
        """Fits one labeler to all labels of a dataset. Equal labels in any order and an equal seed
        give an equal labeler.

        If there is only one distinct question, or if ``measured`` is False, no held-out question is
        tested, and the confidence is ½. Without the measurement a fit takes half of the time; the
        predicted labels are the same.

        Raises:
            InputError: no labels.
        """
        if len(dataset) == 0:
            raise InputError("data", 0, "a labeler needs at least one label")
        seed = derive_seed(seed, "labelers")
        # Sorted, because the result of some classifiers depends on the order of rows.
        dataset = dataset.take(np.lexsort((dataset.label, dataset.message_set, dataset.transition)))
        query, test = query_index(dataset), split(dataset, self.holdout, seed)
        train, held = (dataset.take(np.flatnonzero(rows)) for rows in (~test, test))
        labeler = self.fit_unmeasured(dataset, seed)
        tested = len(np.unique(query[test])) if measured else 0
        right = 0.0
        if tested:
            said = self.fit_unmeasured(train, seed).predict(
                held.features[held.transition], held.message_set
            )
            right = float(by_question(said == held.label, query[test]).sum())
        return replace(
            labeler,
            confidence=(right + 1) / (tested + 2),
            accuracy=right / tested if tested else math.nan,
            n_train=len(np.unique(query[~test | (not tested)])),
            n_test=tested,
        )

    def fit_unmeasured(self, dataset: Dataset, seed: int) -> MeasuredLabeler:
        """Fits a labeler to the labels of a dataset, without measuring its accuracy."""
        return FittedLabeler(
            classifier=self.fit_classifier(dataset, seed),
            n_messages=dataset.n_messages,
            calibrated=self.confidence == "leaf",
        )

    def fit_classifier(self, dataset: Dataset, seed: int) -> Any:
        """Fits a clone of the classifier to the labels of a dataset; a constant classifier if all
        labels are equal."""
        from sklearn.base import clone
        from sklearn.tree import DecisionTreeClassifier
        from sklearn.utils.validation import has_fit_parameter

        # Many classifiers cannot be fitted to one class; a stump predicts it.
        torn = dataset.label.min() != dataset.label.max()
        model = clone(self.classifier) if torn else DecisionTreeClassifier()
        state = derive_seed(seed, "labeler", "classifier") & 0xFFFFFFFF
        names = [name for name in model.get_params() if name.split("__")[-1] == "random_state"]
        model.set_params(**dict.fromkeys(names, state))
        if len(dataset) <= MANY or not has_fit_parameter(model, "sample_weight"):
            return model.fit(make_labelled_inputs(dataset), dataset.label)
        answers = 2 * query_index(dataset) + dataset.label
        _, first, count = np.unique(answers, return_index=True, return_counts=True)
        dataset = dataset.take(first)
        x = make_labelled_inputs(dataset)
        order = np.lexsort((dataset.label, *x.T[::-1]))
        return model.fit(x[order], dataset.label[order], sample_weight=count[order])


def cheap() -> LabelerTrainer:
    """Makes a trainer that learns from labels alone at little cost. A pruned tree predicts about as
    well as boosting (benchmarks/README.md)."""
    from sklearn.tree import DecisionTreeClassifier

    return LabelerTrainer(DecisionTreeClassifier(ccp_alpha=0.004), confidence="leaf")


def find_tested_messages(
    classifier: Any, features: NDArray[np.float64], n_messages: int
) -> Sequence[int]:
    """Finds the messages that may change a prediction about transitions [T, F], ascending. For a
    decision tree these are the messages that its paths test; for any other classifier, all
    messages.

    Raises:
        TooLargeError: too many messages for a table of all their sets.
    """
    if not hasattr(classifier, "tree_"):
        if n_messages > DENSE:
            raise TooLargeError(
                f"labeler: a classifier that is no tree may test any of {n_messages} messages, "
                f"more than {DENSE}; labeler=pruned is a tree that tests few"
            )
        return range(n_messages)
    tree, width = classifier.tree_, features.shape[1]
    # The tree compares single precision inputs with double precision thresholds.
    single, found = features.astype(np.float32), set[int]()
    reached = np.zeros((tree.node_count, len(features)), dtype=bool)
    reached[0] = True
    for node, tested in enumerate(tree.feature.tolist()):  # children come after their parent
        low = high = reached[node]
        if tested < 0 or not low.any():
            continue
        if tested < width:
            below = single[:, tested] <= tree.threshold[node]
            low, high = low & below, high & ~below
        else:
            found.add(tested - width)
        reached[[tree.children_left[node], tree.children_right[node]]] = low, high
    check_tested_messages(len(found), n_messages)
    return sorted(found)


def by_sets(
    asked: Callable[[NDArray[np.float64], NDArray[np.int64]], NDArray[Any]],
    features: NDArray[np.float64],
    message_sets: NDArray[np.int64],
) -> NDArray[Any]:
    """Calls a function for each pair of a transition and a message set.

    Args:
        asked: function of transitions [P, F] and message sets [P] that returns [P] results.
        features: [T, F] transitions.
        message_sets: [K] message sets.

    Returns:
        [T, K] the results.
    """
    count = len(message_sets)
    size = max(ROWS // count, 1)
    found = [
        asked(np.repeat(part, count, axis=0), np.tile(message_sets, len(part)))
        for part in np.split(features, np.arange(size, len(features), size))
    ]
    return np.concatenate(found).reshape(len(features), count)


def check_tested_messages(count: int, n_messages: int) -> None:
    """Raises TooLargeError if a labeler tests more messages on a trace than allowed."""
    if count > MOST_LOOKED_AT:
        raise TooLargeError(
            f"labeler: a type's labeler tests {count} of {n_messages} messages on one trace, more "
            f"than {MOST_LOOKED_AT}; use shorter traces, or a pruned tree, which tests fewer "
            "(labeler=pruned)"
        )


def split(dataset: Dataset, holdout: float, seed: int) -> NDArray[np.bool_]:
    """Draws the distinct questions (transition, message set) to hold out. Returns [P] True for the
    labels of these questions.

    If there are several distinct questions, at least one is held out, and at least one is not.
    """
    query = query_index(dataset)
    count = int(query.max()) + 1
    held = min(max(round(holdout * count), 1), count - 1)
    order = stream(seed, "labeler", "split").permutation(count)
    out = np.zeros(count, dtype=bool)
    out[order[:held]] = True
    return np.asarray(out[query])


def by_question(right: NDArray[np.bool_], query: NDArray[np.int64]) -> NDArray[np.float64]:
    """Computes the share of correct predictions for each distinct question.

    Args:
        right: [P] True if the prediction of a label was correct.
        query: [P] index of the label's question.

    Returns:
        The share for each distinct question, by ascending index.
    """
    _, number = np.unique(query, return_inverse=True)
    share: NDArray[np.float64] = np.bincount(number, right) / np.bincount(number)
    return share


def fresh_accuracy(dataset: Dataset, trainer: LabelerTrainer, seed: int) -> float:
    """Measures the share of new questions that a labeler fitted to these labels predicts correctly,
    cross-validated over message sets. Each distinct (transition, message set) counts once. NaN if
    there is only one message set.

    With few labels, :attr:`Labeler.accuracy` is higher, because the training part contains other
    transitions of a held-out question's trace with the same messages. New questions have other
    message sets.
    """
    told, group = np.unique(dataset.message_set, return_inverse=True)
    if len(told) < 2:
        return float("nan")
    count = min(max(round(1 / trainer.holdout), 2), len(told))
    fold = (stream(derive_seed(seed, "labelers"), "fresh").permutation(len(told)) % count)[group]
    right = np.zeros(len(dataset), dtype=bool)
    for number in range(count):
        test = dataset.take(np.flatnonzero(fold == number))
        train = dataset.take(np.flatnonzero(fold != number))
        labeler = trainer.fit(train, seed, measured=False)
        said = labeler.predict(test.features[test.transition], test.message_set)
        right[fold == number] = said == test.label
    return float(by_question(right, query_index(dataset)).mean())
