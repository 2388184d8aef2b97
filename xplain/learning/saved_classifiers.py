"""Classifiers as arrays of numbers, never a pickle.

A decision tree is kept as its arrays and works again without scikit-learn. Any other classifier is
kept in the format of skops, which builds none but known classes; without skops it is refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.learning.data.dataset import places
from xplain.learning.labelers import OfTruth

NODES = ("feature", "threshold", "children_left", "children_right", "weighted_n_node_samples")
"""Arrays [nodes] of scikit-learn's trees that a labeler reads, besides ``value``."""


@dataclass(frozen=True)
class SavedTree:
    """A decision tree of arrays, with what a labeler asks of scikit-learn's.

    Attributes:
        feature, threshold, children_left, children_right, weighted_n_node_samples: [nodes].
        value: [nodes, 1, classes] shares of the classes.
        classes_: the labels.
        max_depth: longest path.
    """

    feature: NDArray[np.int64]
    threshold: NDArray[np.float64]
    children_left: NDArray[np.int64]
    children_right: NDArray[np.int64]
    weighted_n_node_samples: NDArray[np.float64]
    value: NDArray[np.float64]
    classes_: NDArray[np.int64]
    max_depth: int

    @property
    def tree_(self) -> SavedTree:
        """Scikit-learn keeps the arrays apart from the classifier; here they are one."""
        return self

    def apply(self, x: NDArray[np.float32]) -> NDArray[np.int64]:
        """The leaf of each row [P, F + n]: [P]."""
        node = np.zeros(len(x), dtype=np.int64)
        for _ in range(self.max_depth):
            inner = self.children_left[node] >= 0
            below = x[np.arange(len(x)), np.where(inner, self.feature[node], 0)]
            after = np.where(
                below <= self.threshold[node], self.children_left[node], self.children_right[node]
            )
            node = np.where(inner, after, node)
        return node

    def predict(self, x: NDArray[np.float32]) -> NDArray[np.int64]:
        """The label of each row [P, F + n]: [P]."""
        labels: NDArray[np.int64] = self.classes_[self.value[self.apply(x), 0].argmax(axis=1)]
        return labels


class SavedTable(OfTruth):
    """Probabilities of known transitions as a table, in scikit-learn's shape.

    Args:
        rows: [U, F] float32 features.
        table: [U, 2^n] P(label = 1); of other transitions nothing is known, ½.
    """

    def __init__(self, rows: NDArray[np.float32], table: NDArray[np.float64]) -> None:
        self.rows, self.table = rows, table

    def tabulated(self) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """What it was made of."""
        return self.rows, self.table

    def predict_proba(self, x: NDArray[np.float32]) -> NDArray[np.float64]:
        """P(label = 0) and P(label = 1) of rows [P, F + n]: [P, 2]."""
        width = self.rows.shape[1]
        told = x[:, width:].astype(np.int64) @ (1 << np.arange(x.shape[1] - width))
        place = places(x[:, :width], self.rows)
        one = np.where(place >= 0, self.table[place, told], 0.5)
        return np.stack([1 - one, one], axis=1)


def arrays_of(classifier: Any) -> dict[str, NDArray[Any]]:
    """What to write of a classifier, by name.

    Raises:
        InputError: it is no tree, and skops is not installed.
    """
    if hasattr(classifier, "tree_"):
        tree = classifier.tree_
        nodes = {key: getattr(tree, key) for key in NODES}
        return nodes | {"value": tree.value[:, 0, :], "classes": classifier.classes_}
    if hasattr(classifier, "tabulated"):
        return dict(zip(("rows", "table"), classifier.tabulated(), strict=True))
    name = type(classifier).__name__
    written = _skops("labeler.classifier", name, "a decision tree; others need").dumps(classifier)
    return {"skops": np.frombuffer(written, dtype=np.uint8)}


def classifier_of(
    arrays: Mapping[str, NDArray[Any]], t: int, features: int, messages: int, trusted: Sequence[str]
) -> Any:
    """The classifier of type t in a file that was written by :func:`arrays_of`.

    Args:
        arrays: of the file, those of type t named ``t/…``.
        t: number of the type.
        features, messages: how many there are.
        trusted: classes besides scikit-learn's own that skops may build, by full name.

    Raises:
        InputError: its arrays contradict each other, or skops may not build it.
    """
    if f"{t}/table" in arrays:
        rows, table = arrays[f"{t}/rows"], arrays[f"{t}/table"]
        if rows.shape != (len(rows), features) or table.shape != (len(rows), 1 << messages):
            raise InputError("types", f"table of type {t}", "arrays of a table, as saved")
        if not ((table > 0) & (table < 1)).all():
            raise InputError("types", f"table of type {t}", "probabilities inside (0, 1)")
        return SavedTable(rows.astype(np.float32), table.astype(np.float64))
    if f"{t}/skops" in arrays:
        return _from_skops(arrays[f"{t}/skops"].tobytes(), trusted)
    feature, left, right = (
        np.asarray(arrays[f"{t}/{key}"], dtype=np.int64)
        for key in ("feature", "children_left", "children_right")
    )
    threshold, weight, value = (
        np.asarray(arrays[f"{t}/{key}"], dtype=np.float64)
        for key in ("threshold", "weighted_n_node_samples", "value")
    )
    classes = np.asarray(arrays[f"{t}/classes"], dtype=np.int64)
    nodes = np.arange(len(feature))
    inner = left >= 0
    # The kernels that walk trees trust them: children come after their parents and exist.
    sound = (
        all(a.shape == nodes.shape for a in (threshold, weight, left, right))
        and len(nodes) > 0
        and value.shape == (len(nodes), len(classes))
        and np.isfinite(value).all()
        and np.isin(classes, (0, 1)).all()
        and len(classes) > 0
        and np.array_equal(inner, right >= 0)
        and (np.minimum(left, right)[inner] > nodes[inner]).all()
        and (np.maximum(left, right) < len(nodes)).all()
        and ((feature[inner] >= 0) & (feature[inner] < features + messages)).all()
    )
    if not sound:
        raise InputError("types", f"tree of type {t}", "arrays of a decision tree, as saved")
    depth = np.zeros(len(nodes), dtype=np.int64)
    for node in np.flatnonzero(inner):
        depth[[left[node], right[node]]] = depth[node] + 1
    return SavedTree(
        feature, threshold, left, right, weight, value[:, None], classes, int(depth.max())
    )


def _skops(key: str, value: str, allowed: str) -> Any:
    """The module that reads and writes classifiers.

    Raises:
        InputError: it is not installed.
    """
    try:
        import skops.io
    except ImportError:
        raise InputError(key, value, f"{allowed} pip install 'xplain-hri[skops]'") from None
    return skops.io


def _from_skops(data: bytes, trusted: Sequence[str]) -> Any:
    skops = _skops("types", "a classifier that is no tree", "needs")
    unknown = set(skops.get_untrusted_types(data=data)) - set(trusted)
    if unknown:
        raise InputError(
            "types", ", ".join(sorted(unknown)), "classes to name in trusted=, if you trust them"
        )
    return skops.loads(data, trusted=list(trusted))
