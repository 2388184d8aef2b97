"""The paper's way to the user types (docs/method.md, section 4; Soni et al. 2021, section 4.1).

Each observer is a point: the minimal set of messages that makes all transitions explicable to their
own labeler. The points are partitioned into k = 1, 2, … groups, and k is where the curve of
disagreements bends.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Count, Range, checks
from xplain.explanation.message_sets import bits_of
from xplain.learning.clustering import Clustering
from xplain.learning.data.dataset import Dataset
from xplain.learning.disagreements import disagreements
from xplain.learning.elbow import elbow
from xplain.learning.labelers import LabelerTrainer
from xplain.learning.message_vectors import minimal_message_sets
from xplain.randomness import derived_seed


class Partitioner(Protocol):
    """The plug-in of :class:`Elbow`: any clustering into a given number of groups."""

    def partition(self, vectors: NDArray[np.uint8], k: int, seed: int) -> NDArray[np.int64]:
        """Groups [O] of the vectors [O, n], at most k of them, equal vectors together."""
        ...


@checks("clusterer")
@dataclass(frozen=True)
class Elbow:
    """The paper's learner: observers as minimal message sets, partitioned into k = 1, 2, …
    groups, k at the elbow of the disagreements.

    Attributes:
        partition: how the vectors are grouped.
        few: what may be left where there is no elbow (:func:`xplain.learning.elbow.elbow`).
        max_types: largest k tried; None is the number of observers (the paper).
    """

    partition: Partitioner
    few: Annotated[float, Range(0, 1, "[)")] = 0.01
    max_types: Count | None = None

    def cluster(
        self,
        dataset: Dataset,
        trainer: LabelerTrainer,
        seed: int,
        truth: NDArray[np.int64] | None,
    ) -> Clustering:
        """The partition at the elbow, with the curve of disagreements and the message sets.

        Raises:
            TooLargeError: as :func:`~xplain.learning.message_vectors.minimal_message_set`.
        """
        seed = derived_seed(seed, "clusterer")
        masks = minimal_message_sets(dataset, trainer, seed)
        bits = bits_of(masks, dataset.n_messages)
        longest = min(len(masks), self.max_types or len(masks))
        distinct = min(len(np.unique(masks)), longest)
        found = [
            self.partition.partition(bits, k, derived_seed(seed, "partition", k) & 0xFFFFFFFF)
            for k in range(1, distinct + 1)
        ]
        # More groups than distinct vectors cannot be told apart: the last partition stays.
        curve = disagreements(dataset, found)
        curve = np.concatenate([curve, np.full(longest - distinct, curve[-1])])
        k, rule = elbow(curve, self.few)
        name = type(self.partition).__name__.lower()
        return Clustering(found[min(k, distinct) - 1], name, rule, curve, masks)


@checks("clusterer.partition")
@dataclass(frozen=True)
class KMeans:
    """Lloyd's k-means on the vectors (the paper), best of several starts."""

    starts: Count = 10

    def partition(self, vectors: NDArray[np.uint8], k: int, seed: int) -> NDArray[np.int64]:
        """Groups [O] of the vectors [O, n]."""
        from sklearn.cluster import KMeans as Lloyd
        from threadpoolctl import threadpool_limits

        # Equal vectors are one point with a weight: the same answer at the size of the distinct.
        distinct, where, weight = np.unique(
            vectors, axis=0, return_inverse=True, return_counts=True
        )
        model = Lloyd(min(k, len(distinct)), n_init=self.starts, random_state=seed)
        with threadpool_limits(1):  # a few points: threads would cost more than the work
            groups = model.fit_predict(distinct.astype(np.float64), sample_weight=weight)
        return np.asarray(groups[where.ravel()], dtype=np.int64)


@checks("clusterer.partition")
@dataclass(frozen=True)
class Agglomerative:
    """Hierarchical clustering of the vectors by Hamming distance."""

    linkage: Literal["average", "complete", "single"] = "average"

    def partition(self, vectors: NDArray[np.uint8], k: int, seed: int) -> NDArray[np.int64]:
        """Groups [O] of the vectors [O, n]."""
        from scipy.cluster.hierarchy import fcluster, linkage

        distinct, where = np.unique(vectors, axis=0, return_inverse=True)
        if len(distinct) == 1:
            return np.zeros(len(vectors), dtype=np.int64)
        tree = linkage(distinct.astype(np.float64), method=self.linkage, metric="hamming")
        groups = fcluster(tree, min(k, len(distinct)), criterion="maxclust") - 1
        return np.asarray(groups[where.ravel()], dtype=np.int64)
