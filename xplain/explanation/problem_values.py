"""What an explanation problem may be given; all of these raise InputError for anything else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, Range, number
from xplain.explanation.label_table import MAX_MESSAGES

RANGES = {"inexplicability_cost": Range(0), "lambda": Range(0), "discount": Range(0, 1, "(]")}


def numbers(key: str, value: ArrayLike) -> NDArray[np.float64]:
    """A float64 copy without NaN or infinities."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(key, value, "numbers") from None
    if not np.isfinite(array).all():
        raise InputError(key, array[~np.isfinite(array)].flat[0].item(), "finite numbers")
    return array


def one_number(key: str, value: Any) -> float:
    """A finite number in its range."""
    if not isinstance(value, float):  # most are, and a problem is often made of another
        array = numbers(key, value)
        if array.ndim != 0:
            raise InputError(key, value, "one number")
        value = float(array)
    return number(key, value, RANGES[key])


def distribution(given: ArrayLike, types: int) -> NDArray[np.float64]:
    """[N] a prior; of none all types are as likely."""
    prior = np.asarray(given)
    prior = np.full(types, 1 / types) if prior.size == 0 else numbers("prior", prior)
    if prior.shape != (types,) or (prior < 0).any() or abs(prior.sum() - 1) > 1e-6:
        raise InputError("prior", prior.tolist(), f"{types} probabilities that sum to 1")
    # A prior that sums to 1 but for rounding stays to the last bit, however often a problem is
    # made of another: decisions and replays must not hang on it.
    return prior / prior.sum() if abs(prior.sum() - 1) > 1e-12 else prior


def each_cost(given: ArrayLike, count: int | None) -> NDArray[np.float64]:
    """[n] the costs of so many messages, of one for all or one for each; where nobody says how many
    there are, of as many as costs. Read-only."""
    cost = numbers("message_cost", given)
    if cost.ndim == 0 and count is None:
        raise InputError("message_cost", cost.tolist(), "one cost a message, or message_names")
    n = len(cost) if count is None else count
    if n > MAX_MESSAGES:
        raise InputError("message_cost", n, f"at most {MAX_MESSAGES} messages")
    cost = np.full(n, float(cost)) if cost.ndim == 0 else cost
    if cost.shape != (n,) or (cost < 0).any():
        raise InputError("message_cost", cost.tolist(), f"{n} costs ≥ 0, one a message")
    cost.flags.writeable = False
    return cost


def named(key: str, given: Sequence[str], count: int, kind: str) -> tuple[str, ...]:
    """So many names; numbered where there are none."""
    names = tuple(given) or tuple(f"{kind}_{i}" for i in range(count))
    if len(names) != count:
        raise InputError(key, names, f"{count} names")
    return names
