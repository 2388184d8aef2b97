"""Means with intervals over episodes, which are not independent: users share traces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Estimate:
    """A mean and the ends of its interval (NaN where one cluster leaves it unknown)."""

    mean: float
    low: float
    high: float

    def negated(self) -> Estimate:
        """The estimate of minus the quantity: the ends of the interval change places."""
        return Estimate(-self.mean, -self.high, -self.low)


def clustered_ratio(
    above: ArrayLike, below: ArrayLike, clusters: ArrayLike, level: float = 0.95
) -> Estimate:
    """Ratio of two means of numbers ≥ 0, measured on the same episodes.

    The interval is the linearised one: R + (a − R b) / mean(b) has the mean R and, in large
    samples, the ratio's variance. It ends at 0.

    Args:
        above, below: [E], the mean of ``below`` above 0.
        clusters, level: as :func:`clustered_mean`.
    """
    above, below = np.asarray(above, dtype=float), np.asarray(below, dtype=float)
    ratio = above.mean() / below.mean()
    found = clustered_mean(ratio + (above - ratio * below) / below.mean(), clusters, level)
    return Estimate(float(ratio), float(np.maximum(found.low, 0)), found.high)


def clustered_mean(values: ArrayLike, clusters: ArrayLike, level: float = 0.95) -> Estimate:
    """Mean of values with a t interval over cluster means' spread.

    Episodes on one trace share its difficulty, so the trace (in a sweep: seed and trace) is the
    unit that is sampled: the variance of the mean comes from clusters, not from episodes.

    Args:
        values: [E].
        clusters: [E] the same number for values of one cluster.
        level: of the interval.
    """
    from scipy.special import stdtrit

    values, clusters = np.asarray(values, dtype=float), np.asarray(clusters)
    _, index = np.unique(clusters, return_inverse=True)
    counts = np.bincount(index)
    mean = float(values.mean())
    groups = len(counts)
    if groups < 2:
        return Estimate(mean, float("nan"), float("nan"))
    # Residual totals a cluster: exact for equal sizes, the usual ratio estimate otherwise.
    totals = np.bincount(index, weights=values - mean)
    variance = groups / (groups - 1) * float((totals**2).sum()) / len(values) ** 2
    half = float(stdtrit(groups - 1, 0.5 + level / 2)) * variance**0.5
    return Estimate(mean, mean - half, mean + half)
