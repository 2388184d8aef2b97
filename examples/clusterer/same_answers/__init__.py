"""A clusterer: observers who give the same answers to the same questions have one type."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from xplain import Clusterer, Clustering, InputError
from xplain.learning.data.dataset import query_index
from xplain.learning.data.observers import Observations


@dataclass(frozen=True)
class SameAnswers(Clusterer):
    """Attributes:
    tolerance: share of the common questions that two observers of one type may answer
        differently, in [0, 1).
    common: minimum number of questions that two observers of one type must have in common.
    """

    tolerance: float = 0.0
    common: int = 20

    def __post_init__(self) -> None:
        if not 0 <= self.tolerance < 1:
            raise InputError("clusterer.tolerance", self.tolerance, "a share in [0, 1)")

    def cluster(self, observed: Observations, seed: int) -> Clustering:
        """Makes a graph of observers who agree; each connected part is a type."""
        dataset = observed.dataset
        question = query_index(dataset)
        answers = np.zeros((2, len(dataset.observers), question.max() + 1))  # answers 0, answers 1
        answers[dataset.label, dataset.observer, question] = 1
        asked = answers.max(axis=0)
        common = asked @ asked.T
        same = answers[0] @ answers[0].T + answers[1] @ answers[1].T
        alike = (common >= self.common) & (same >= (1 - self.tolerance) * common)
        count, found = connected_components(alike)
        rule = f"{count} groups that differ in at most {self.tolerance:.0%} of their answers"
        return Clustering(found.astype(np.int64), "same answers", rule)
