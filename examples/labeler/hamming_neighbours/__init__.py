"""A classifier in which the most similar examples vote: examples that differ in the fewest columns.

Any classifier with scikit-learn's interface can be a labeler. This classifier is a full example.
"""

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, ClassifierMixin

from xplain import InputError


class HammingNeighbours(ClassifierMixin, BaseEstimator):
    """Args:
    neighbours: number of examples that vote. Examples at the distance of the last of these also
        vote.
    """

    def __init__(self, neighbours: int = 3) -> None:
        self.neighbours = neighbours

    def fit(self, x: NDArray[np.float32], y: NDArray[np.uint8]) -> "HammingNeighbours":
        """Stores the examples [P, columns] and their labels [P]."""
        if self.neighbours < 1:
            raise InputError("labeler.classifier.neighbours", self.neighbours, "a number ≥ 1")
        self.classes_, self.label_ = np.unique(y, return_inverse=True)
        self.x_ = np.asarray(x)
        return self

    def predict_proba(self, x: NDArray[np.float32]) -> NDArray[np.float64]:
        """Computes shares of the votes, [Q, classes]; an example that differs in d columns has 4^−d
        votes."""
        shares = np.empty((len(x), len(self.classes_)))
        for q, row in enumerate(np.asarray(x)):
            differs = (self.x_ != row).sum(axis=1)
            limit = np.sort(differs)[min(self.neighbours, len(differs)) - 1]
            votes = np.where(differs <= limit, 0.25**differs, 0.0)
            shares[q] = np.bincount(self.label_, weights=votes, minlength=len(self.classes_))
        return shares / shares.sum(axis=1, keepdims=True)

    def predict(self, x: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Returns the label with most votes, [Q]."""
        return self.classes_[self.predict_proba(x).argmax(axis=1)]
