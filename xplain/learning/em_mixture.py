"""A finite mixture of labelers, fitted by expectation maximisation over observers.

Any classifier can be the labeler of a component; nothing is assumed of how labels come about. A
classifier that has seen an observer's labels predicts them too well, so an observer is always
judged by labelers that were fitted without the points in question (cross-fitting).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.data.dataset import Dataset, inputs
from xplain.errors import InputError
from xplain.learning.clustering import Clustering
from xplain.learning.cross_validation import folds
from xplain.learning.labelers import LabelerTrainer, share_of_ones
from xplain.learning.message_vectors import minimal_message_sets
from xplain.learning.paper_clusterer import Agglomerative, Partition
from xplain.message_sets import bits_of
from xplain.randomness import derived_seed, stream

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Mixture:
    """EM for k = 1, 2, … types; the number is chosen by the held-out likelihood.

    Attributes:
        max_types: largest k tried.
        patience: stop when so many further types have not helped.
        starts: for each k, one from the message-set vectors, the others at random.
        iterations: of EM, at most.
        folds: of the cross-fitting.
        floor: probabilities are kept inside [floor, 1 − floor]: a share of labels is given in
            error, whatever a classifier thinks.
        partition: groups the vectors for the first start.
    """

    max_types: int = 10
    patience: int = 2
    starts: int = 3
    iterations: int = 20
    folds: int = 3
    floor: float = 0.02
    partition: Partition = Agglomerative()  # noqa: RUF009  (frozen)

    def __post_init__(self) -> None:
        for key in ("max_types", "patience", "starts", "iterations"):
            if getattr(self, key) < 1:
                raise InputError(f"clusterer.{key}", getattr(self, key), "a number ≥ 1")
        if self.folds < 2:
            raise InputError("clusterer.folds", self.folds, "a number ≥ 2")
        if not 0 < self.floor < 0.5:
            raise InputError("clusterer.floor", self.floor, "a number inside (0, 0.5)")

    def cluster(
        self,
        dataset: Dataset,
        trainer: LabelerTrainer,
        seed: int,
        truth: NDArray[np.int64] | None,
    ) -> Clustering:
        """Each observer's likeliest component, at the k of the highest held-out likelihood."""
        masks = minimal_message_sets(dataset, trainer, seed)
        bits = bits_of(masks, dataset.n_messages)
        observers = len(dataset.observers)
        data = _Data(dataset, trainer, self.folds, self.floor, derived_seed(seed, "mixture"))
        best, chosen, best_k = -np.inf, np.zeros(observers, dtype=np.int64), 1
        for k in range(1, min(self.max_types, observers) + 1):
            for start in range(self.starts if k > 1 else 1):
                rng = stream(seed, "mixture", k, start)
                first = (
                    self.partition.partition(bits, k, derived_seed(seed, "mixture", k))
                    if start == 0
                    else rng.permutation(np.arange(observers) % k)
                )
                value, assignment = self._em(data, first, k)
                if value > best:
                    best, chosen, best_k = value, assignment, k
            if k >= best_k + self.patience:
                break
        types = len(np.unique(chosen))
        log.info("%d user types by the rule held-out likelihood: %.4f a label", types, best)
        return Clustering(chosen, "mixture", "held-out likelihood", vectors=masks)

    def _em(
        self, data: _Data, assignment: NDArray[np.int64], k: int
    ) -> tuple[float, NDArray[np.int64]]:
        """The held-out log-likelihood a label, and the components [O]."""
        weight = np.eye(k)[assignment]
        value = -np.inf
        for _ in range(self.iterations):
            share = (weight.sum(axis=0) + 1) / (len(weight) + k)
            joint = data.log_likelihood(weight) + np.log(share)
            top = joint.max(axis=1, keepdims=True)
            log_marginal = top[:, 0] + np.log(np.exp(joint - top).sum(axis=1))
            before, value = value, float(log_marginal.sum() / data.size)
            weight = np.exp(joint - log_marginal[:, None])
            if value - before < 1e-4:
                break
        return value, weight.argmax(axis=1)


class _Data:
    """The labels as classifier inputs [P, F + n], split into folds by query: each fold is judged by
    classifiers that were fitted to the others."""

    def __init__(
        self, dataset: Dataset, trainer: LabelerTrainer, count: int, floor: float, seed: int
    ) -> None:
        rows = dataset.features[dataset.transition]
        self.x = inputs(rows, dataset.message_set, dataset.n_messages)
        self.y = dataset.label
        self.observer = dataset.observer
        self.observers = len(dataset.observers)
        self.size = len(dataset)
        self.trainer, self.floor, self.seed = trainer, floor, seed
        self.folds = list(folds(dataset, count, seed))

    def log_likelihood(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """[O, k]: log P of each observer's labels under each component, fitted to the other folds
        with these weights [O, k] of the observers."""
        result = np.zeros(weight.shape)
        for test in self.folds:
            for k in range(weight.shape[1]):
                own = weight[self.observer, k]
                train = ~test & (own > 1e-3)
                if not train.any():
                    one = np.full(int(test.sum()), 0.5)
                else:
                    model = self.trainer.fitted(
                        self.x[train], self.y[train], self.seed, weight=own[train]
                    )
                    one = share_of_ones(model, model.predict_proba(self.x[test]))
                one = np.clip(one, self.floor, 1 - self.floor)
                value = np.log(np.where(self.y[test] == 1, one, 1 - one))
                result[:, k] += np.bincount(self.observer[test], value, self.observers)
        return result
