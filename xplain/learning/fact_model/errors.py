"""How answers err, by a state of the sampler."""

from __future__ import annotations

import numpy as np

from xplain.learning.answer_model import AnswerModel, CellAnswers, learned
from xplain.learning.data.dataset import Dataset
from xplain.learning.fact_model.model import NOISE, Prior, State


def errors_of(dataset: Dataset, prior: Prior, state: State) -> AnswerModel:
    """Slips, guesses and error rates, were the cells of all answers those of ``state``.

    The sampler itself has one rate of errors a transition: an observer's own would make labels of a
    cell differ in weight, where its tables know their difference alone.
    """
    held = state.facts[dataset.observer] & ~dataset.message_set
    matters = held & prior.members[state.subset[dataset.transition]]
    both = np.stack([dataset.transition, matters])
    cells, cell = np.unique(both, axis=1, return_inverse=True)
    label = dataset.label.astype(np.int64)
    about = CellAnswers(cell.ravel(), dataset.transition, dataset.observer, label)
    wrong = float(np.exp(state.log_noise) @ NOISE)
    # How many cells are 1 is seen in the answers: where few answers share a cell, a share that is
    # too low would pass for guesses.
    kind = (matters > 0).astype(np.int64)
    ones = np.bincount(kind, label, 2) / np.bincount(kind, minlength=2).clip(1)
    one = ((ones - wrong) / (1 - 2 * wrong)).clip(0.02, 0.98)[(cells[1] > 0).astype(np.int64)]
    return learned(about, one, len(dataset.features), len(dataset.observers), wrong)
