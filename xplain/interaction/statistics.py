"""Means with intervals over episodes, which are not independent: users share traces."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

Range = tuple[float, float]
"""The least and the largest value that a quantity can have."""

ANY: Range = (-np.inf, np.inf)


@dataclass(frozen=True)
class Estimate:
    """A mean and the ends of its interval (NaN where one cluster leaves it unknown)."""

    mean: float
    low: float
    high: float


def half_width(error: float, freedom: int, level: float = 0.95) -> float:
    """What stands behind ±: half of Student's interval of a mean.

    Args:
        error: standard error of the mean.
        freedom: degrees of freedom of that error, ≥ 1.
        level: of the interval.
    """
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.5 + level / 2)) * error


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


def clustered_mean(
    values: ArrayLike, clusters: ArrayLike, level: float = 0.95, possible: Range = ANY
) -> Estimate:
    """Mean of values with a t interval over cluster means' spread.

    Episodes on one trace share its difficulty, so the trace (in a sweep: seed and trace) is the
    unit that is sampled: the variance of the mean comes from clusters, not from episodes.

    Args:
        values: [E].
        clusters: [E] the same number for values of one cluster.
        level: of the interval.
        possible: values of the quantity; the interval is cut where the mean cannot be. (A value
            outside that was seen is possible.)
    """
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
    half = half_width(variance**0.5, groups - 1, level)
    least = min(possible[0], float(values.min()))
    most = max(possible[1], float(values.max()))
    return Estimate(mean, max(mean - half, least), min(mean + half, most))


def clustered_share(right: ArrayLike, clusters: ArrayLike) -> Estimate:
    """A share with Wilson's 95 % score interval (1927), which never leaves [0, 1], for cases that
    come in clusters.

    Cases of one cluster may be alike. So the interval is computed for Kish's effective sample size
    (at most the number of cases): so many independent cases would leave the share as uncertain as
    the clusters do. Student's quantile corrects for few clusters. Where all cases of each cluster
    agree, each cluster counts as one case.

    Args:
        right: [E] of bool.
        clusters: [E] the same number for cases of one cluster; with one cluster only, the interval
            is unknown.
    """
    from scipy.special import ndtri, stdtrit

    right = np.asarray(right, dtype=float)
    _, index = np.unique(np.asarray(clusters), return_inverse=True)
    sizes, ones = np.bincount(index), np.bincount(index, weights=right)
    share, groups = float(right.mean()), len(sizes)
    if groups < 2:
        return Estimate(share, float("nan"), float("nan"))
    cases, agree = float(len(right)), bool(((ones == 0) | (ones == sizes)).all())
    if agree:
        cases *= cases / float((sizes**2).sum())
    elif (variance := float(((ones - share * sizes) ** 2).sum()) / cases**2) > 0:
        cases = min(cases, share * (1 - share) / variance)
    z = float(ndtri(0.975) if agree else stdtrit(groups - 1, 0.975))
    centre = (share + z * z / (2 * cases)) / (1 + z * z / cases)
    spread = math.sqrt(share * (1 - share) / cases + (z / (2 * cases)) ** 2)
    half = z / (1 + z * z / cases) * spread
    return Estimate(share, min(share, max(0.0, centre - half)), max(share, min(1.0, centre + half)))
