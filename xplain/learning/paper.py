"""The paper's method to find user types (docs/method.md, section 4; Soni et al. 2021, section 4.1).

Each observer is a point: the smallest set of messages that makes every transition explicable to
their own labeler. The points are partitioned into k = 1, 2, … groups, and k is at the elbow of the
curve of disagreements (docs/choices.md, "no elbow").

Two labels disagree if they have the same cluster, transition and message set, and differ (paper,
Definition 1). Within a *cell* (transition, message set) a cluster with z zeros and o ones has z · o
such pairs.

The smallest set is exact. It has the fewest inexplicable transitions (0 if possible), then the
fewest messages. Ties follow the order of the messages: {0, 5} comes before {1, 2}, because it has
the first message.
"""

import logging
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Count, Range, checks
from xplain.explanation.message_sets import bits_of, subsets
from xplain.learning.data.dataset import Dataset, inputs, query_index
from xplain.learning.data.observers import Observations
from xplain.learning.labelers import LabelerTrainer, by_sets, find_tested_messages
from xplain.learning.types import Clustering
from xplain.learning.user_types import Clusterer
from xplain.randomness import derive_seed

log = logging.getLogger(__name__)


def elbow(curve: NDArray[np.int64], few: float) -> tuple[int, str]:
    """Returns the number of clusters at the elbow, and the rule that gave it (also logged).

    Kneedle (Satopää et al. 2011, the paper's choice) looks for the knee of a convex, decreasing
    curve: the point where it bends. This knee is used even if it is wrong. It often comes too
    early, because the first split separates most pairs of types and the first drop of the curve is
    the largest. The first rule that applies decides:

    1. ``flat zero``: if one cluster has no disagreements, k = 1.
    2. ``kneedle``: the knee that Kneedle finds, unless it is at an end of the curve (as for concave
       curves).
    3. ``no knee, few``: the smallest k whose disagreements are at most ``few`` times the
       disagreements at k = 1.
    4. ``no knee, lowest``: the smallest k with the fewest disagreements.

    Args:
        curve: [K] disagreements for k = 1 … K.
        few: a share in [0, 1), used if there is no knee.
    """
    # A partition into more clusters may be worse by chance; the best partition so far counts.
    lowest = np.minimum.accumulate(curve)
    if curve[0] == 0:
        return _log_choice(1, "flat zero", "no two observers disagree on any label")
    knee = _find_knee(lowest)
    if knee is not None:
        return _log_choice(
            knee,
            "kneedle",
            f"there the curve of disagreements within types bends, from {curve[0]} with one type "
            f"to {lowest[knee - 1]}",
        )
    why = "the curve of disagreements within types has no knee"
    reached = np.flatnonzero(lowest <= few * lowest[0])
    if len(reached):
        k = int(reached[0]) + 1
        why += f"; {k} is the first number of types that leaves at most {few:.2%}"
        return _log_choice(k, "no knee, few", why)
    k = int(lowest.argmin()) + 1
    why += f"; no number of types leaves at most {few:.2%}; {k} leaves the fewest"
    return _log_choice(k, "no knee, lowest", why)


def _log_choice(k: int, rule: str, why: str) -> tuple[int, str]:
    log.info("%d user types by the rule %s: %s", k, rule, why)
    return k, rule


def _find_knee(curve: NDArray[np.int64]) -> int | None:
    """Finds the knee of a curve that never rises, strictly between its ends; None if there is no
    knee."""
    from kneed import KneeLocator  # heavy: it imports pyplot

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "no knee" is an answer here, not a warning
        k = range(1, len(curve) + 1)
        found = KneeLocator(k, curve.tolist(), curve="convex", direction="decreasing").knee
    return int(found) if found is not None and 1 < found < len(curve) else None


def disagreements(dataset: Dataset, assignments: Iterable[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Counts the disagreements of each of K clusterings [O] of the observers. Returns [K]."""
    cell = query_index(dataset)
    ones, size = np.bincount(cell, weights=dataset.label), np.bincount(cell)
    rows = np.flatnonzero(((ones > 0) & (ones < size))[cell])  # all others agree
    cell, observer, label = cell[rows], dataset.observer[rows], dataset.label[rows]
    found = []
    for assignment in assignments:
        both = cell * len(assignment) + assignment[observer]
        own = np.unique(both, return_inverse=True)[1]
        one = np.bincount(own, weights=label)
        found.append(int(one @ (np.bincount(own) - one)))
    return np.array(found, dtype=np.int64)


def minimal_message_sets(dataset: Dataset, trainer: LabelerTrainer, seed: int) -> NDArray[np.int64]:
    """Finds [O] the smallest message set of each observer.

    Each observer's classifier is fitted to all of the observer's own labels. The classifier
    predicts only these labels, so nothing is held out. All classifiers have the same seed:
    observers with equal answers get the same set. An observer without labels gets the empty set.

    Raises:
        TooLargeError: see :func:`minimal_message_set`.
    """
    found = np.zeros(len(dataset.observers), dtype=np.int64)
    for o, own in enumerate(dataset.rows):
        if len(own):
            classifier = trainer.fit_classifier(dataset.take(own), seed)
            features = dataset.features[np.unique(dataset.transition[own])]
            found[o] = minimal_message_set(classifier, features, dataset.n_messages)
    return found


def minimal_message_set(classifier: Any, features: NDArray[np.float64], n_messages: int) -> int:
    """Finds the smallest message set that makes T transitions explicable (:func:`smallest`), as a
    bitmask.

    Args:
        classifier: fitted on :func:`xplain.learning.data.dataset.inputs`.
        features: [T, F] features of the distinct transitions.
        n_messages: n.

    Raises:
        TooLargeError: the classifier tests too many messages.
    """
    messages = find_tested_messages(classifier, features, n_messages)

    def predict(rows: NDArray[np.float64], message_sets: NDArray[np.int64]) -> NDArray[Any]:
        return np.asarray(classifier.predict(inputs(rows, message_sets, n_messages)))

    labels = by_sets(predict, features, subsets(messages))
    return smallest((labels == 0).sum(axis=0), messages)


def smallest(inexplicable: NDArray[np.int64], messages: Sequence[int]) -> int:
    """Finds the best set of some messages: the set with the fewest inexplicable transitions, then
    the set with the fewest messages.

    Args:
        inexplicable: [2^r] number of inexplicable transitions under each set of the r messages.
        messages: the r messages.

    Returns:
        The set as a bitmask.
    """
    sets = subsets(messages)
    # The first message weighs most: {0, 5} comes before {1, 2}.
    first = bits_of(np.arange(len(sets)), len(messages)) @ (1 << np.arange(len(messages)))[::-1]
    return int(sets[np.lexsort((-first, np.bitwise_count(sets), inexplicable))[0]])


class Partitioner(Protocol):
    """A clustering method of :class:`Elbow`, which divides points into a given number of groups."""

    def partition(self, vectors: NDArray[np.uint8], k: int, seed: int) -> NDArray[np.int64]:
        """Returns [O] the groups of the vectors [O, n]: at most k groups, with equal vectors in one
        group."""
        ...


@checks("clusterer")
@dataclass(frozen=True)
class Elbow(Clusterer):
    """The paper's learner. A minimal message set represents each observer, as a vector of bits. The
    vectors are partitioned into k = 1, 2, … groups, and k is chosen at the elbow of the
    disagreements.

    Attributes:
        partition: clusters these vectors.
        few: share of disagreements that may remain if there is no elbow
            (:func:`xplain.learning.paper.elbow`).
        max_types: largest k that is tried; None is the number of observers (the paper).
    """

    partition: Partitioner
    few: Annotated[float, Range(0, 1, "[)")] = 0.01
    max_types: Count | None = None

    def cluster(self, observed: Observations, seed: int) -> Clustering:
        """Returns the partition at the elbow, with the curve of disagreements and the message sets.

        Raises:
            TooLargeError: see :func:`~xplain.learning.paper.minimal_message_set`.
        """
        seed, dataset = derive_seed(seed, "clusterer"), observed.dataset
        masks = minimal_message_sets(dataset, self.labeler, seed)
        bits = bits_of(masks, dataset.n_messages)
        longest = min(len(masks), self.max_types or len(masks))
        distinct = min(len(np.unique(masks)), longest)
        found = [
            self.partition.partition(bits, k, derive_seed(seed, "partition", k) & 0xFFFFFFFF)
            for k in range(1, distinct + 1)
        ]
        # More groups than distinct vectors are impossible: the last partition stays.
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
        """Returns [O] the groups of the vectors [O, n]."""
        from sklearn.cluster import KMeans as Lloyd
        from threadpoolctl import threadpool_limits

        # Equal vectors are one point with a weight: the same result in less time.
        distinct, where, weight = np.unique(
            vectors, axis=0, return_inverse=True, return_counts=True
        )
        model = Lloyd(min(k, len(distinct)), n_init=self.starts, random_state=seed)
        with threadpool_limits(1):  # for a few points, threads cost more than they save
            groups = model.fit_predict(distinct.astype(np.float64), sample_weight=weight)
        return np.asarray(groups[where.ravel()], dtype=np.int64)


@checks("clusterer.partition")
@dataclass(frozen=True)
class Agglomerative:
    """Hierarchical clustering of the vectors by Hamming distance."""

    linkage: Literal["average", "complete", "single"] = "average"

    def partition(self, vectors: NDArray[np.uint8], k: int, seed: int) -> NDArray[np.int64]:
        """Returns [O] the groups of the vectors [O, n]."""
        from scipy.cluster.hierarchy import fcluster, linkage

        distinct, where = np.unique(vectors, axis=0, return_inverse=True)
        if len(distinct) == 1:
            return np.zeros(len(vectors), dtype=np.int64)
        tree = linkage(distinct.astype(np.float64), method=self.linkage, metric="hamming")
        groups = fcluster(tree, min(k, len(distinct)), criterion="maxclust") - 1
        return np.asarray(groups[where.ravel()], dtype=np.int64)
