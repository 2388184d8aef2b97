"""What agents know of the user types, however they came to know it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, TooLargeError
from xplain.explanation.label_table import LabelTable
from xplain.users.setting import Setting


class Tables(NamedTuple):
    """P(label is 1) of a trace's m transitions under every message set.

    Attributes:
        learned: of N types that solvers plan with.
        everyone: of one labeler for everybody; None where it looks at too many messages.
        perfect: of M true types, what the oracle knows of each; None where there is no oracle.
    """

    learned: LabelTable
    everyone: LabelTable | None
    perfect: LabelTable | None


def unless_too_large(make: Callable[[], LabelTable]) -> LabelTable | None:
    """The table, or None where it would be too large: a labeler for everybody looks at what any
    type looks at, and few runs ask for it."""
    try:
        return make()
    except TooLargeError:
        return None


@dataclass(frozen=True)
class Known:
    """What agents know of the users.

    Attributes:
        names: N of the types.
        matched_true_type: [N] for each the ``distinct`` number of the true type it stands for,
            −1 unknown.
        shares: [N] of the observers.
        figures: of the learning stage, by name.
        curve: disagreements for k = 1 … (empty where there are none).
        rule: what decided the number of types.
        tables: what follows for a trace [m, 3].
    """

    names: tuple[str, ...]
    matched_true_type: NDArray[np.int64]
    shares: NDArray[np.float64]
    figures: dict[str, float]
    curve: NDArray[np.float64]
    rule: str
    tables: Callable[[NDArray[np.int64]], Tables]


def true_types(setting: Setting, truth: NDArray[np.int64] | None) -> Known:
    """The true types with their true labels: what ``labeler=true`` stands for
    (:mod:`xplain.learning.true_labels`). One labeler for everybody is the share of observers whose
    type would label so.

    Args:
        setting: the types.
        truth: [O] each observer's true type.

    Raises:
        InputError: nobody knows the observers' types, as of real people.
    """
    if truth is None:
        raise InputError("labeler", "true", "needs simulated observers, whose type is known")
    observers = np.bincount(truth, minlength=len(setting.types))

    def tables(transitions: NDArray[np.int64]) -> Tables:
        labels = setting.true_labels(transitions)
        weights = observers / len(truth)
        return Tables(labels, unless_too_large(lambda: labels.mixed(weights)), labels)

    distinct = setting.distinct
    count = float(len(np.unique(distinct)))
    return Known(
        names=tuple(user_type.name for user_type in setting.types),
        matched_true_type=distinct,
        shares=observers / len(truth),
        figures={"types_found": count, "true_types": count},
        curve=np.zeros(0),
        rule="truth",
        tables=tables,
    )
