"""Compares hypotheses with labels alone: how well does each method predict answers before it learns
from these answers (prequential: Dawid 1984, "Statistical theory: the prequential approach")?

Answers are in the order in which each observer gave them, and are split into quarters. Each quarter
is predicted from the earlier quarters of observers of the same type.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.learning.data.dataset import Dataset

PARTS = 4
"""Parts of each observer's answers; the first part is not predicted."""
BEFORE = 10.0
"""Prior weight of the hypotheses, in answers."""
LEAST = 0.01
"""Minimum weight of hypotheses."""
WORSE, BEATEN = float(np.log(20)), 20.0
"""Two limits of the log evidence against hypotheses: above the first a warning is logged, above the
second labels alone replace the hypotheses. The second is larger, because a wrong replacement costs
more than a wrong hypothesis."""
DOUBTED = 0.5
"""Hypotheses of a type are doubted if P(the hypotheses are often wrong) exceeds this value."""
COIN = float(np.log(2))

Predict = Callable[[Dataset, Dataset], NDArray[np.float64]]
"""Returns [Q] log P of each label of the second dataset, learned from the first."""


@dataclass(frozen=True)
class Evidence:
    """Predictions of Q answers by observers of N types. Each answer was predicted by hypotheses,
    and by a labeler that learned from labels alone.

    Attributes:
        hypotheses: [Q] log of the probability that the hypotheses gave to the observed answer.
        labels: [Q] log of the probability that the labeler without hypotheses gave to the answer.
        of_type: [Q] type of the observer who gave the answer.
        doubt: [N] P(people of a type disagree with the hypotheses at one transition in twenty, or
            more).
        unwritten: [N] P(people of a type believe a fact incorrectly that no hypothesis contains).
    """

    hypotheses: NDArray[np.float64]
    labels: NDArray[np.float64]
    of_type: NDArray[np.int64]
    doubt: NDArray[np.float64]
    unwritten: NDArray[np.float64]

    @property
    def nats(self) -> tuple[float, float]:
        """The mean of −log P(answer) by hypotheses, and the mean of −log P(answer) by labels alone.
        Both are log 2 if no answer was predicted."""
        if not len(self.of_type):
            return COIN, COIN
        return -float(self.hypotheses.mean()), -float(self.labels.mean())

    @property
    def trust(self) -> NDArray[np.float64]:
        """[N] weight of the hypotheses in predictions for each type; labels alone have the
        remaining weight. The weight is 1 unless the type's hypotheses are doubted (DOUBTED); then
        it is :func:`stacking_weight`."""
        types = (np.flatnonzero(self.of_type == t) for t in range(len(self.doubt)))
        weight = [stacking_weight(self.hypotheses[own], self.labels[own]) for own in types]
        return np.where(self.doubt > DOUBTED, weight, 1.0)

    @property
    def against(self) -> float:
        """The log evidence against the hypotheses: the log probability that they gave to all
        answers, subtracted from the log probability by labels alone or by a fair coin, whichever is
        larger."""
        own, others = self.nats
        return (own - min(others, COIN)) * len(self.of_type)

    @property
    def otherwise(self) -> int:
        """Number of types that disagree with the hypotheses, or believe a fact incorrectly that no
        hypothesis contains."""
        return int((np.maximum(self.doubt, self.unwritten) > DOUBTED).sum())

    @property
    def lost(self) -> bool:
        """True if the hypotheses do not fit: people of a type disagree with the hypotheses, or the
        hypotheses predict worse than labels alone or a fair coin."""
        return self.otherwise > 0 or self.against > WORSE

    @property
    def beaten(self) -> bool:
        """True if labels alone predict so much better that they replace the hypotheses.

        A fair coin may predict better than both, because after few answers with many errors both
        are overconfident. Then the hypotheses stay: the only replacement would be labels alone.
        """
        own, others = self.nats
        return (own - others) * len(self.of_type) > BEATEN

    def __str__(self) -> str:
        own, others = self.nats
        fit = "the hypotheses fit people's answers"
        if self.lost:
            fit = "the hypotheses do not fit people's answers"
            if self.otherwise:
                fit += (
                    f" (people of {self.otherwise} of {len(self.doubt)} types disagree with them)"
                )
        return (
            f"{fit}: the mean loss of predicted answers is {own:.2f} nats by hypotheses, "
            f"{others:.2f} by labels alone, {COIN:.2f} by a fair coin (less is better)"
        )


def stacking_weight(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Computes the weight w in [LEAST, 1] of the first of two prediction methods in a weighted
    mean.

    The weight maximises Σ log(w P₁ + (1 − w) P₂) + BEFORE log w, where P₁ and P₂ are the
    probabilities that the methods gave to an answer (Yao et al. 2018, "Using stacking to average
    Bayesian predictive distributions").

    Args:
        first, second: [Q] log P₁ and log P₂ of each answer.
    """
    from scipy.optimize import brentq

    ratio = np.exp(np.clip(second - first, -50, 50))

    def slope(w: float) -> float:
        return float(((1 - ratio) / (w + (1 - w) * ratio)).sum() + BEFORE / w)

    if slope(1.0) >= 0:
        return 1.0
    return LEAST if slope(LEAST) <= 0 else float(brentq(slope, LEAST, 1.0))


def predict_in_order(
    dataset: Dataset, assignment: NDArray[np.int64], ways: tuple[Predict, ...]
) -> tuple[NDArray[Any], ...]:
    """Predicts the answers of a dataset, one type at a time. Each quarter of the answers is
    predicted from the earlier quarters.

    Args:
        dataset: answers of O observers, in the order in which each observer gave them.
        assignment: [O] type of each observer.
        ways: prediction methods. A method receives earlier answers of one type, and the answers of
            this type to predict.

    Returns:
        The indices [Q] of the predicted answers in the dataset; then, for each method, [Q] the log
        of the probability that the method gave to each answer.
    """
    part, kind = number_parts(dataset.observer), assignment[dataset.observer]
    found: list[tuple[NDArray[Any], ...]] = [(np.zeros(0, np.int64), *[np.zeros(0)] * len(ways))]
    for number in range(1, PARTS):
        for one in np.unique(kind).tolist():
            before, rows = (
                np.flatnonzero((kind == one) & chosen) for chosen in (part < number, part == number)
            )
            if len(before) and len(rows):
                train, test = dataset.take(before), dataset.take(rows)
                found.append((rows, *(way(train, test) for way in ways)))
    return tuple(np.concatenate(column) for column in zip(*found, strict=True))


def number_parts(observer: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns [P] the number of each answer's part, from 0 to PARTS − 1. The answers of each
    observer, in order, are split into PARTS parts of nearly equal size."""
    order, count = np.argsort(observer, kind="stable"), np.bincount(observer)
    rank = np.empty(len(observer), dtype=np.int64)
    rank[order] = np.arange(len(observer)) - (np.cumsum(count) - count)[observer[order]]
    return np.asarray(rank * PARTS // count[observer])
