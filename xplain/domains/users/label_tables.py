"""What tables of labels, and priors over their rows, have to be."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.domains.users.setting import MAX_MODELS
from xplain.errors import InputError, TooLargeError

SUM = 1e-6
"""A prior sums to 1 within this."""


def prior_over(prior: ArrayLike | None, count: int, key: str) -> NDArray[np.float64]:
    """[count] probabilities; None is uniform.

    Raises:
        InputError: of another shape, negative, or not summing to 1.
    """
    if prior is None:
        return np.full(count, 1 / count)
    try:
        weight = np.asarray(prior, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(key, prior, f"{count} probabilities") from None
    if weight.shape != (count,):
        raise InputError(key, weight.shape, f"{count} probabilities, one a candidate")
    if not (weight >= 0).all() or not abs(weight.sum() - 1) < SUM:
        raise InputError(key, float(weight.sum()), "probabilities that sum to 1")
    return np.asarray(weight / weight.sum())


def table_of_labels(labels: ArrayLike) -> NDArray[np.uint8]:
    """[C, T] labels of 0 and 1, checked."""
    try:
        table = np.asarray(labels)
    except ValueError:
        table = np.zeros(0)
    if table.ndim != 2 or 0 in table.shape or table.dtype.kind not in "biuf":
        raise InputError("hypotheses.labels", table.shape, "a table [2^n, transitions]")
    if not np.isin(table, (0, 1)).all():
        other = table[~np.isin(table, (0, 1))][0]
        raise InputError("hypotheses.labels", other.item(), "labels 0 and 1")
    if len(table) > MAX_MODELS:
        raise TooLargeError(
            f"hypotheses: {len(table)} candidates are more than {MAX_MODELS}; leave out sets of "
            "many facts"
        )
    return table.astype(np.uint8)
