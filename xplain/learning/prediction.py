"""Predictions of answers: P(answer 1) of observers to questions, and how well types and labelers
predict held-out answers."""

import logging
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from xplain.learning.answers import truth
from xplain.learning.data.dataset import Dataset, places, query_index
from xplain.learning.data.observers import Observations
from xplain.learning.labelers import Labeler, LabelerTrainer, split
from xplain.learning.user_types import Single, TypeFinder, UserTypes
from xplain.randomness import derive_seed, stream

log = logging.getLogger(__name__)

EDGE = 0.002
"""Minimum distance of P(f = 1) from 0 and 1."""
SURE = 1.96
"""Half of a 95 % interval, in standard errors."""


def predict(dataset: Dataset, types: UserTypes, questions: Dataset) -> NDArray[np.float64]:
    """Computes [P] P(answer 1) of each row of ``questions``.

    The first method that applies is used:

    1. Answers after messages are predicted from answers before the messages
       (:mod:`xplain.learning.landing`), if the dataset has such answers.
    2. Answers without messages are predicted by the clustering, if it predicts answers. If the
       labelers predict what people think, the prediction is the mean of the clustering's
       prediction and of the labelers' prediction (method 3).
    3. All other answers are predicted by the types' labelers. Their weights for an observer come
       from the shares of the types and the observer's own labels; without labels, from the shares
       alone.

    Args:
        dataset: the labels that the types were found in.
        types: the types.
        questions: transitions and message sets, with the features and messages of ``dataset``, and
            the names of observers, who may be new. Its labels are not used.
    """
    place = {name: o for o, name in enumerate(dataset.observers)}
    known = np.array([place.get(name, -1) for name in questions.observers], dtype=np.int64)
    who = known[questions.observer]
    transition = places(questions.features, dataset.features)[questions.transition]
    weight = _compute_posterior(dataset, types)[who]
    one = _predict_answers(types, questions, transition)
    result = np.einsum("pne,pne->p", weight, one)
    expected = types.clustering.expected
    if expected is not None:
        everyone = np.vstack([expected, expected.mean(axis=0)])  # last row: a new observer
        plain = (transition >= 0) & (questions.message_set == 0)
        own = everyone[who, transition]
        if all(one.means_truth for one in types.labelers):
            own = (own + result) / 2
        result = np.where(plain, own, result)
    if types.landing is not None:
        told = np.flatnonzero(questions.message_set)
        about = who[told], transition[told], questions.message_set[told]
        result[told] = types.landing.predict(*about)
    return np.asarray(result)


def _compute_posterior(dataset: Dataset, types: UserTypes) -> NDArray[np.float64]:
    """Computes [O + 1, N, E] P(type, error rate) of each observer given their own labels; the last
    row is for a person without labels."""
    one = _predict_answers(types, dataset, dataset.transition)
    value = np.log(np.where(dataset.label[:, None, None] == 1, one, 1 - one))
    rate = np.ones(1) if types.answers is None else types.answers.prior
    joint = np.zeros((len(dataset.observers) + 1, *one.shape[1:]))
    np.add.at(joint, dataset.observer, value)
    return np.asarray(softmax(joint + np.log(types.prior)[:, None] + np.log(rate), axis=(1, 2)))


def _predict_answers(
    types: UserTypes, asked: Dataset, transition: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Computes [P, N, E] P(answer 1) by type and error rate.

    Without an answer model, labelers predict answers directly, and there is one error rate.

    Args:
        types: types that were learned from a dataset.
        asked: P questions.
        transition: [P] index of each question's transition in that dataset; −1 for transitions that
            the dataset does not contain.
    """
    one = _predict_by_type(types.labelers, asked)
    if types.answers is None:
        return one[:, :, None]
    given = types.answers.predict(transition)  # [P, 2, E]
    low, high = (given @ types.answers.prior).T
    for k, labeler in enumerate(types.labelers):
        if not labeler.means_truth:
            one[:, k] = truth(one[:, k], low, high).clip(EDGE, 1 - EDGE)
    return np.asarray((1 - one[..., None]) * given[:, None, 0] + one[..., None] * given[:, None, 1])


def _predict_by_type(labelers: tuple[Labeler, ...], asked: Dataset) -> NDArray[np.float64]:
    """Computes [P, N] P(answer 1) of P questions by type."""
    features = asked.features[asked.transition]
    return np.stack([one.probability(features, asked.message_set) for one in labelers], axis=1)


class CalibrationBin(NamedTuple):
    """One tenth of the held-out labels, in the order of the predicted P(label = 1).

    Attributes:
        said: mean predicted P(label = 1).
        ones: share of labels 1.
        low, high: Wilson's 95 % interval of this share.
        labels: number of labels.
    """

    said: float
    ones: float
    low: float
    high: float
    labels: int


def calibration(one: NDArray[np.float64], label: NDArray[np.uint8]) -> tuple[CalibrationBin, ...]:
    """Compares predictions with labels, in ten groups of equal size: the labels are sorted by their
    predictions and then divided. Fewer than ten labels give one group for each label.

    Args:
        one: [P] predicted P(label = 1).
        label: [P] the labels.
    """
    from scipy.stats import binomtest

    found = []
    for own in np.array_split(np.argsort(one, kind="stable"), min(10, len(one))):
        ones, count, said = int(label[own].sum()), len(own), float(one[own].mean())
        interval = binomtest(ones, count).proportion_ci(method="wilson")
        found.append(CalibrationBin(said, ones / count, interval.low, interval.high, count))
    return tuple(found)


@dataclass(frozen=True)
class HeldOut:
    """Mean log P of held-out labels, in nats per label. Higher is better.

    Attributes:
        types: prediction by the types that were found in the other labels.
        one_type: prediction by one labeler for all observers.
        question_mean: prediction by the mean of all observers' answers to the same question.
        gain: [2] 95 % interval of ``types`` minus the better of the other two predictions, by
            resampling observers.
        calibration: calibration of ``types``.
    """

    types: float
    one_type: float
    question_mean: float
    gain: tuple[float, float]
    calibration: tuple[CalibrationBin, ...]

    @property
    def verdict(self) -> str:
        """A sentence that says whether these answers support several types."""
        low, high = self.gain
        than = "than one type and the questions' means do"
        if low > 0:
            return f"types predict held-out answers better {than}"
        if high < 0:
            return f"types are not supported by these answers: they predict worse {than}"
        return f"not decided whether types predict held-out answers better {than}"


def predict_held_out(
    dataset: Dataset, finder: TypeFinder, trainer: LabelerTrainer, seed: int
) -> HeldOut:
    """Measures how well labels are predicted from the other labels.

    Some labels are held out, and types are found in the rest. The held-out labels are a share
    (``trainer.holdout``) of the distinct pairs (transition, message set), with all labels of a
    pair. If the data have no messages, this share of the labels is drawn instead, because the
    questions are then independent items. At least one label is held out, and at least one is kept.

    Args:
        dataset: all labels.
        finder: finds the types.
        trainer: fits the labeler for all observers, with which the types are compared.
        seed: seed of every draw.
    """
    if dataset.message_set.any():
        test = split(dataset, trainer.holdout, derive_seed(seed, "held out"))
    else:
        drawn = stream(seed, "held out").random(len(dataset))
        test = drawn < trainer.holdout
        test[drawn.argmin()], test[drawn.argmax()] = True, False  # at least one of each
    rest, held = dataset.take(np.flatnonzero(~test)), dataset.take(np.flatnonzero(test))
    log.info("the types are found again without the held-out labels")
    of_types, of_one = (
        log_likelihoods(rest, held, one.find(Observations(rest), seed))
        for one in (finder, Single(labeler=trainer))
    )
    others = [of_one, _predict_by_means(dataset, test)]
    best = max(others, key=lambda one: float(one.mean()))
    more = np.bincount(held.observer, of_types - best)
    count = np.bincount(held.observer)
    gain = float(more.sum() / count.sum())
    off = SURE * float(np.sqrt(((more - gain * count) ** 2).sum())) / count.sum()
    one_type, question_mean = (float(one.mean()) for one in others)
    said = np.where(held.label == 1, np.exp(of_types), -np.expm1(of_types))
    ends, tenths = (gain - off, gain + off), calibration(said, held.label)
    return HeldOut(float(of_types.mean()), one_type, question_mean, ends, tenths)


def log_likelihoods(train: Dataset, test: Dataset, types: UserTypes) -> NDArray[np.float64]:
    """Computes [P] log P of each label of ``test``, by the types that were found in ``train``. The
    predictions come from :func:`predict` if labelers predict what people think, or if answers after
    messages are predicted from earlier answers. Otherwise the predictions come from the clustering,
    if it predicts answers, or from the labeler of the observer's type."""
    found, rows = types.clustering, np.arange(len(test))
    if types.landing is not None or all(one.means_truth for one in types.labelers):
        one = predict(train, types, test)
    elif found.expected is not None:
        one = found.expected[test.observer, test.transition]
    else:
        one = _predict_by_type(types.labelers, test)[rows, found.assignment[test.observer]]
    return _log_label(one, test.label)


def log_likelihood(labeler: Labeler, dataset: Dataset) -> NDArray[np.float64]:
    """Computes [P] log P of each label by one labeler."""
    return _log_label(_predict_by_type((labeler,), dataset)[:, 0], dataset.label)


def _predict_by_means(dataset: Dataset, test: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Computes log P of the held-out labels. P(label = 1) is the mean of the other answers to the
    same question, with one pseudo-answer 0 and one pseudo-answer 1.

    Args:
        dataset: all labels.
        test: for each label, True if it is held out.

    Returns:
        One value for each held-out label.
    """
    query = query_index(dataset)
    count = int(query.max()) + 1
    ones = np.bincount(query[~test], dataset.label[~test], count)
    mean = (ones + 1) / (np.bincount(query[~test], minlength=count) + 2)
    return _log_label(mean[query[test]], dataset.label[test])


def _log_label(one: NDArray[np.float64], label: NDArray[np.uint8]) -> NDArray[np.float64]:
    return np.asarray(np.log(np.where(label == 1, one, 1 - one)))
