"""Learned user types in a file: arrays of numbers and text, never a pickle.

A decision tree is kept as its arrays and works again without scikit-learn. Any other classifier is
kept in the format of skops, which builds none but known classes; without skops it is refused.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.learning.answer_model import ErrorRates, QuestionErrors
from xplain.learning.data.dataset import Dataset, places
from xplain.learning.data.encoding import encoded
from xplain.learning.data.label_file import MAX_MASK
from xplain.learning.labelers import Labeler, OfTruth
from xplain.learning.user_types import UserTypes, label_table

FORMAT = 1
NODES = ("feature", "threshold", "children_left", "children_right", "weighted_n_node_samples")
"""Arrays [nodes] of scikit-learn's trees that a labeler reads, besides ``value``."""
FIGURES = ("confidence", "accuracy", "n_train", "n_test", "calibrated")


@dataclass(frozen=True)
class LearnedTypes:
    """User types as an :class:`~xplain.Explainer` wants them.

    A transition is a row of F features, as the labelers were trained on.

    Attributes:
        labelers: one a type.
        names: of the types.
        prior: [N] P(type) of the next user.
        messages: n names; bit j of a message set is message j.
        feature_names: F names.
        sentences: what to say for each message, by its name; may be empty.
        errors: how people err when they answer; None where nobody learned it.
    """

    labelers: tuple[Labeler, ...]
    names: tuple[str, ...]
    prior: NDArray[np.float64]
    messages: tuple[str, ...]
    feature_names: tuple[str, ...]
    sentences: Mapping[str, str] = field(default_factory=dict)
    errors: QuestionErrors | None = None

    @classmethod
    def of(
        cls, types: UserTypes, dataset: Dataset, sentences: Mapping[str, str] | None = None
    ) -> LearnedTypes:
        """The types that were learned from a dataset.

        Args:
            types: of :func:`xplain.learning.user_types.learn_types`.
            dataset: what they were learned from.
            sentences: what to say for each message.
        """
        learned = types.answers
        return cls(
            types.labelers,
            types.names,
            types.prior,
            dataset.messages,
            dataset.feature_names,
            dict(sentences or {}),
            None
            if learned is None
            else QuestionErrors(learned.slip, learned.guess, learned.errors, dataset.features),
        )

    @property
    def habits(self) -> Habits | None:
        """How people err, as an explainer takes it; None where nobody learned it."""
        return None if self.errors is None else self.errors.habits

    def encode(self, transition: Mapping[str, float | str]) -> tuple[float, ...]:
        """A transition as sessions take it, from its columns in the table of labels:
        ``types.encode({"zone": "river", "load": 2})``.

        Raises:
            InputError: a column is missing or unknown, or has a text that no label was given on.
        """
        return encoded(transition, self.feature_names)

    def label_table(self, transitions: Sequence[Any]) -> LabelTable:
        """P(label is 1 | type, message set) of T rows of features.

        Raises:
            InputError: the rows are not F finite numbers each.
        """
        wanted = f"rows of {len(self.feature_names)} numbers: {', '.join(self.feature_names)}"
        try:
            rows = np.asarray(transitions, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError("trace", transitions, wanted) from None
        if rows.ndim != 2 or rows.shape[1] != len(self.feature_names):
            raise InputError("trace", rows.shape, wanted)
        if not np.isfinite(rows).all():
            raise InputError("trace", "NaN or infinite", wanted)
        return label_table(self.labelers, rows)

    def save(self, path: str | Path) -> None:
        """Writes an ``.npz`` file.

        Raises:
            InputError: a labeler is no tree, and skops is not installed or cannot write it.
        """
        arrays: dict[str, Any] = {
            "format": FORMAT,
            "names": np.array(self.names, dtype=np.str_),
            "prior": self.prior,
            "messages": np.array(self.messages, dtype=np.str_),
            "feature_names": np.array(self.feature_names, dtype=np.str_),
            "sentences": np.array([self.sentences.get(m, "") for m in self.messages], np.str_),
        }
        if self.errors is not None:
            found = self.errors
            arrays |= {"errors/features": found.features, "errors/prior": found.errors.prior}
            arrays |= {"errors/slip": found.slip, "errors/guess": found.guess}
            arrays["errors/rates"] = found.errors.rates
        for key in FIGURES:
            arrays[key] = np.array([getattr(labeler, key) for labeler in self.labelers])
        for t, labeler in enumerate(self.labelers):
            classifier = labeler.classifier
            if hasattr(classifier, "tree_"):
                tree = classifier.tree_
                arrays |= {f"{t}/{key}": getattr(tree, key) for key in NODES}
                arrays |= {f"{t}/value": tree.value[:, 0, :], f"{t}/classes": classifier.classes_}
            elif hasattr(classifier, "tabulated"):
                arrays[f"{t}/rows"], arrays[f"{t}/table"] = classifier.tabulated()
            else:
                arrays[f"{t}/skops"] = np.frombuffer(_skops_bytes(classifier), dtype=np.uint8)
        with Path(path).open("wb") as file:  # an open file keeps its name as it is
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: str | Path, trusted: Sequence[str] = ()) -> LearnedTypes:
        """Reads a file of :meth:`save`. Nothing in it is run.

        Args:
            path: of the file.
            trusted: classes besides scikit-learn's own that skops may build, by full name.

        Raises:
            InputError: no such file, no file of :meth:`save`, or one that contradicts itself.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {key: file[key] for key in file.files}
            if int(arrays["format"]) != FORMAT:
                raise InputError("types", int(arrays["format"]), f"a file of format {FORMAT}")
            names, messages, features, sentences = (
                tuple(str(name) for name in arrays[key].tolist())
                for key in ("names", "messages", "feature_names", "sentences")
            )
            if len(messages) > MAX_MASK:
                raise InputError("types", len(messages), f"at most {MAX_MASK} messages")
            labelers = tuple(
                Labeler(
                    _classifier(arrays, t, len(features), len(messages), trusted),
                    len(messages),
                    **{key: arrays[key][t].item() for key in FIGURES},
                )
                for t in range(len(names))
            )
            prior = np.asarray(arrays["prior"], dtype=np.float64)
            errors = _errors(arrays, len(features)) if "errors/rates" in arrays else None
        except InputError:
            raise
        except (OSError, KeyError, ValueError, IndexError, AttributeError, TypeError,
                EOFError, zipfile.BadZipFile) as error:  # fmt: skip
            reason = (str(error).splitlines() or [""])[0] or type(error).__name__
            raise InputError(
                "types", str(path), f"a file of LearnedTypes.save ({reason})"
            ) from None
        if not labelers or prior.shape != (len(labelers),):
            raise InputError("types", str(path), "one prior and one labeler a type")
        said = {m: text for m, text in zip(messages, sentences, strict=True) if text}
        return cls(labelers, names, prior, messages, features, said, errors)


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


def _errors(arrays: Mapping[str, NDArray[Any]], features: int) -> QuestionErrors:
    rates = ErrorRates.of(arrays["errors/rates"], arrays["errors/prior"])
    rows, slip, guess = (
        np.asarray(arrays[f"errors/{key}"], dtype=np.float64)
        for key in ("features", "slip", "guess")
    )
    if rows.ndim != 2 or rows.shape[1] != features:
        raise InputError("types", "errors/features", f"rows of {features} features")
    return QuestionErrors(slip, guess, rates, rows)


def _classifier(
    arrays: Mapping[str, NDArray[Any]], t: int, features: int, messages: int, trusted: Sequence[str]
) -> Any:
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


def _skops_bytes(classifier: Any) -> bytes:
    name = type(classifier).__name__
    try:
        import skops.io
    except ImportError:
        raise InputError(
            "labeler.classifier",
            name,
            "a decision tree; others need pip install 'xplain-hri[skops]'",
        ) from None
    return bytes(skops.io.dumps(classifier))


def _from_skops(data: bytes, trusted: Sequence[str]) -> Any:
    try:
        import skops.io
    except ImportError:
        raise InputError(
            "types", "a classifier that is no tree", "needs pip install 'xplain-hri[skops]'"
        ) from None
    unknown = set(skops.io.get_untrusted_types(data=data)) - set(trusted)
    if unknown:
        raise InputError(
            "types", ", ".join(sorted(unknown)), "classes to name in trusted=, if you trust them"
        )
    return skops.io.loads(data, trusted=list(trusted))
