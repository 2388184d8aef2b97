"""How well labelers predict labels that they, and the clustering, have not seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xplain.data.dataset import Dataset, query_index
from xplain.learning.clustering import Clusterer
from xplain.learning.labelers import Labeler, LabelerTrainer, by_question, split
from xplain.randomness import derived_seed, stream


def held_out_log_likelihood(
    dataset: Dataset, clusterer: Clusterer, trainer: LabelerTrainer, seed: int
) -> float:
    """Mean log P(label) in nats a label, on points that neither the clusterer nor the labelers saw.

    A share of the distinct (transition, message set) is put aside (``trainer.holdout``); types are
    found and labelers fitted without it.
    """
    test = split(dataset, trainer.holdout, derived_seed(seed, "held out"))
    rest, held = dataset.take(np.flatnonzero(~test)), dataset.take(np.flatnonzero(test))
    found = clusterer.cluster(rest, trainer, seed, None)
    return float(np.mean(log_likelihoods(rest, held, found.assignment, trainer, seed)))


def log_likelihoods(
    train: Dataset,
    test: Dataset,
    assignment: NDArray[np.int64],
    trainer: LabelerTrainer,
    seed: int,
) -> NDArray[np.float64]:
    """log P of each label of ``test`` under the labeler of its observer's cluster, fitted to
    ``train``: [P]. A cluster without labels in ``train`` is predicted by everybody's."""
    result = np.empty(len(test))
    for cluster in np.unique(assignment):
        members = np.flatnonzero(assignment == cluster)
        own = train.of(members)
        labeler = trainer.fit(own if len(own) else train, seed)
        rows = np.flatnonzero(np.isin(test.observer, members))
        result[rows] = log_likelihood(labeler, test.take(rows))
    return result


def log_likelihood(labeler: Labeler, dataset: Dataset) -> NDArray[np.float64]:
    """log P of each label under one labeler: [P]."""
    if not len(dataset):
        return np.zeros(0)
    one = labeler.probability(dataset.features[dataset.transition], dataset.message_set)
    return np.asarray(np.log(np.where(dataset.label == 1, one, 1 - one)))


def fresh_accuracy(dataset: Dataset, trainer: LabelerTrainer, seed: int) -> float:
    """What a labeler fitted to these labels gets right of fresh questions: cross-validated over
    message sets, each distinct (transition, message set) once. NaN where there is one message set.

    Where labels are few, :attr:`Labeler.accuracy` says more than fresh questions would show: a
    held-out (transition, message set) comes from a trace whose other transitions, under the same
    messages, are trained with. Fresh questions come with messages of their own.
    """
    told, group = np.unique(dataset.message_set, return_inverse=True)
    if len(told) < 2:
        return float("nan")
    count = min(max(round(1 / trainer.holdout), 2), len(told))
    fold = (stream(seed, "fresh").permutation(len(told)) % count)[group]
    # What is only asked for its predictions needs no confidence; other trainers may have none else.
    fit = trainer.fit_untested if type(trainer) is LabelerTrainer else trainer.fit
    right = np.zeros(len(dataset), dtype=bool)
    for number in range(count):
        test = dataset.take(np.flatnonzero(fold == number))
        labeler = fit(dataset.take(np.flatnonzero(fold != number)), seed)
        said = labeler.predict(test.features[test.transition], test.message_set)
        right[fold == number] = said == test.label
    return float(by_question(right, query_index(dataset)).mean())
