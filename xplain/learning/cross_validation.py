"""How well labelers predict labels that they have not seen."""

from __future__ import annotations

import numpy as np

from xplain.learning.data.dataset import Dataset, query_index
from xplain.learning.labelers import LabelerTrainer, by_question
from xplain.randomness import derived_seed, stream


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
    fold = (stream(derived_seed(seed, "labelers"), "fresh").permutation(len(told)) % count)[group]
    # What is only asked for its predictions needs no confidence; other trainers may have none else.
    fit = trainer.fit_untested if type(trainer) is LabelerTrainer else trainer.fit
    right = np.zeros(len(dataset), dtype=bool)
    for number in range(count):
        test = dataset.take(np.flatnonzero(fold == number))
        labeler = fit(dataset.take(np.flatnonzero(fold != number)), seed)
        said = labeler.predict(test.features[test.transition], test.message_set)
        right[fold == number] = said == test.label
    return float(by_question(right, query_index(dataset)).mean())
