"""Learned user types in a file: arrays of numbers and text, never a pickle.

Classifiers are stored in the format of skops, which creates objects of known classes only. A
labeler of hypotheses is stored as a table of its probabilities.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.explanation.belief import OPEN, fact_sets
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.label_file import MAX_MASK, encode_transition
from xplain.learning.labelers import FittedLabeler, Labeler, TableLabeler
from xplain.learning.user_types import UserTypes, label_table
from xplain.storage import decode, encode

TREE = "sklearn.tree._tree.Tree"
"""A class that skops does not trust, because its arrays may not form a tree. This module checks the
arrays."""


FIGURES = {"confidence": float, "accuracy": float, "n_train": int, "n_test": int}
"""The measured attributes of a labeler, with their types."""


def _collect_values(labeler: Labeler) -> dict[str, Any]:
    """Collects the values of a labeler for a file."""
    return {key: getattr(labeler, key) for key in FIGURES} | labeler.arrays()


def _make_labeler(
    kept: Mapping[str, Any], t: int, features: int, messages: int, trusted: Sequence[str]
) -> Labeler:
    """Makes the labeler of type t from its values in a file.

    Args:
        kept: the values, as :func:`_collect_values` returned them.
        t: index of the type.
        features, messages: number of features, and of messages.
        trusted: classes outside scikit-learn that skops may create, by full name.

    Raises:
        InputError: the arrays contradict each other, or skops may not create the labeler.
    """
    figures: dict[str, Any] = {key: kind(kept[key]) for key, kind in FIGURES.items()}
    if "table" in kept:
        rows, table = kept["rows"], kept["table"]
        if rows.shape != (len(rows), features) or table.shape != (len(rows), 1 << messages):
            raise InputError("types", f"table of type {t}", "arrays of a table, as saved")
        if not ((table > 0) & (table < 1)).all():
            raise InputError("types", f"table of type {t}", "probabilities inside (0, 1)")
        rows, table = rows.astype(np.float32), table.astype(np.float64)
        return TableLabeler(rows=rows, values=table, n_messages=messages, **figures)
    import skops.io  # takes long, and tables do not need it

    data = kept["skops"].tobytes()
    unknown = {*skops.io.get_untrusted_types(data=data)} - {TREE, *trusted}
    if unknown:
        allowed = "classes to name in trusted=, if you trust them"
        raise InputError("types", ", ".join(sorted(unknown)), allowed)
    classifier = skops.io.loads(data, trusted=[TREE, *trusted])
    inputs = features + messages
    trees = [classifier, *np.ravel(getattr(classifier, "estimators_", []))]
    sound = (_is_sound(one.tree_, inputs) for one in trees if hasattr(one, "tree_"))
    if getattr(classifier, "n_features_in_", inputs) != inputs or not all(sound):
        raise InputError("types", f"classifier of type {t}", "a fitted classifier, as saved")
    calibrated = bool(kept["calibrated"])
    return FittedLabeler(
        classifier=classifier, n_messages=messages, calibrated=calibrated, **figures
    )


def _is_sound(tree: Any, inputs: int) -> bool:
    """True if every path from the root of a scikit-learn tree stays inside its arrays."""
    left, right, node = tree.children_left, tree.children_right, np.arange(tree.node_count)
    inner = left != -1
    ends = np.minimum(left, right)[inner] > node[inner], np.maximum(left, right) < len(node)
    asked = (tree.feature[inner] >= 0) & (tree.feature[inner] < inputs)
    whole = len(node) > 0 and np.array_equal(inner, right != -1) and np.isfinite(tree.value).all()
    return bool(whole and all(map(np.all, (*ends, asked))))


WHOLE = "types"
"""Name of the text in a file that says which array belongs to which field."""
NAMES = ("names", "messages", "feature_names")
"""Arrays of names in a file, which other programs may read."""


@dataclass(frozen=True)
class LearnedTypes:
    """User types in the form that :class:`~xplain.Explainer` needs.

    A transition is a row of F features, as in the labelers' training.

    Attributes:
        labelers: one for each type.
        names: names of the types.
        prior: [N] P(type) of the next user.
        messages: n names; bit j of a message set is message j.
        feature_names: F names.
        sentences: text of each message, by its name; may be empty.
        habits: error model of people's answers, as explainers use it; None if unknown.
        wrong: [N] bitmasks of the facts that each type believes incorrectly; None if unknown.
        about_everything: the labeler of a person who believes every fact incorrectly, if known.
        new: P(a user has none of the types).
    """

    labelers: tuple[Labeler, ...]
    names: tuple[str, ...]
    prior: NDArray[np.float64]
    messages: tuple[str, ...]
    feature_names: tuple[str, ...]
    sentences: Mapping[str, str] = field(default_factory=dict)
    habits: Habits | None = None
    wrong: tuple[int, ...] | None = None
    about_everything: Labeler | None = None
    new: float = OPEN

    @classmethod
    def of(
        cls, types: UserTypes, dataset: Dataset, sentences: Mapping[str, str] | None = None
    ) -> LearnedTypes:
        """Collects the types that were learned from a dataset.

        Args:
            types: result of :func:`xplain.learning.user_types.learn_types`.
            dataset: the dataset that the types were learned from.
            sentences: text of each message.
        """
        wrong, everything = types.wrong, types.everything
        return cls(
            types.labelers,
            types.names,
            types.prior,
            dataset.messages,
            dataset.feature_names,
            dict(sentences or {}),
            types.habits,
            None if wrong is None or everything is None else fact_sets(wrong),
            None if wrong is None else everything,
            types.clustering.new,
        )

    def encode(self, transition: Mapping[str, float | str]) -> tuple[float, ...]:
        """Converts a transition to the row of features that sessions need. The transition is given
        by its columns in the table of labels, as in ``types.encode({"zone": "river", "load": 2})``.

        Raises:
            InputError: a column is missing or unknown, or contains a text that no row of the table
                of labels has in this column.
        """
        return encode_transition(transition, self.feature_names)

    def label_table(self, transitions: Sequence[Any]) -> LabelTable:
        """Computes P(label = 1 | type, message set) of T rows of features.

        Raises:
            InputError: a row does not consist of F finite numbers.
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

    def everything(self, transitions: Sequence[Any]) -> LabelTable | None:
        """Computes P(label = 1 | message set) for a person who believes every fact incorrectly;
        None if facts are unknown."""
        if self.about_everything is None:
            return None
        return self.about_everything.table(np.asarray(transitions, dtype=np.float64))

    def save(self, path: str | Path) -> None:
        """Writes an ``.npz`` file: the arrays ``names``, ``messages``, ``feature_names``; all other
        arrays as ``array_0``, ``array_1``, …; and ``types``, a text in JSON with everything else.

        Raises:
            InputError: skops cannot write a classifier.
        """
        arrays: dict[str, Any] = {}
        kept = {own.name: getattr(self, own.name) for own in fields(self)}
        kept["labelers"] = [_collect_values(labeler) for labeler in self.labelers]
        kept["about_everything"] = self.about_everything and _collect_values(self.about_everything)
        names = {key: np.array(kept.pop(key), dtype=np.str_) for key in NAMES}
        arrays[WHOLE] = np.array(json.dumps(encode(kept, arrays)))
        with Path(path).open("wb") as file:  # for a path, numpy would add .npz to the name
            np.savez_compressed(file, **arrays | names)

    @classmethod
    def load(cls, path: str | Path, trusted: Sequence[str] = ()) -> LearnedTypes:
        """Reads a file of :meth:`save`. No code in it is executed.

        Args:
            path: path of the file.
            trusted: classes outside scikit-learn that skops may create, by full name.

        Raises:
            InputError: no such file, no file of :meth:`save`, or a file that contradicts itself.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {key: file[key] for key in file.files}
            names = {key: arrays[key].tolist() for key in NAMES}
            kept = decode(cls, json.loads(arrays[WHOLE].item()) | names, arrays)
            size = len(kept.feature_names), len(kept.messages)
            if size[1] > MAX_MASK:
                raise InputError("types", size[1], f"at most {MAX_MASK} messages")
            *labelers, everything = (
                own
                and _make_labeler({k: arrays.get(x, x) for k, x in own.items()}, t, *size, trusted)
                for t, own in enumerate([*kept.labelers, kept.about_everything])
            )
            prior = np.asarray(kept.prior, dtype=np.float64)
        except InputError:
            raise
        except (OSError, KeyError, ValueError, IndexError, AttributeError, TypeError,
                EOFError, zipfile.BadZipFile) as error:  # fmt: skip
            reason = (str(error).splitlines() or [""])[0] or type(error).__name__
            raise InputError(
                "types", str(path), f"a file of LearnedTypes.save ({reason})"
            ) from None
        each = [kept.names, prior, *([] if kept.wrong is None else [kept.wrong])]
        if not labelers or prior.ndim != 1 or any(len(own) != len(labelers) for own in each):
            raise InputError(
                "types", str(path), "one name, one prior and one labeler for each type"
            )
        every = tuple(labelers)
        return replace(kept, labelers=every, prior=prior, about_everything=everything)
