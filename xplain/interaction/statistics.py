"""Means with intervals over episodes. Episodes are not independent, because users share traces."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

Range = tuple[float, float]
"""The smallest and the largest possible value of a quantity."""

ANY: Range = (-np.inf, np.inf)


@dataclass(frozen=True)
class Estimate:
    """A mean, and the lower and upper end of its interval (NaN if there is only one cluster)."""

    mean: float
    low: float
    high: float


def half_width(error: float, freedom: int) -> float:
    """Computes the number after ±: half the width of Student's 95 % interval of a mean.

    Args:
        error: standard error of the mean.
        freedom: degrees of freedom of that error, ≥ 1.
    """
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.975)) * error


def clustered_ratio(above: ArrayLike, below: ArrayLike, clusters: ArrayLike) -> Estimate:
    """Estimates the ratio R of two means of numbers ≥ 0, measured on the same episodes.

    The interval is linearised: it is the interval of the mean of R + (a − R b) / mean(b) over
    episodes. This quantity has the mean R and, in large samples, the variance of the ratio. A lower
    end below 0 is replaced by 0.

    Args:
        above, below: [E] values a of the numerator and b of the denominator; mean(b) > 0.
        clusters: see :func:`clustered_mean`.
    """
    above, below = np.asarray(above, dtype=float), np.asarray(below, dtype=float)
    ratio = above.mean() / below.mean()
    found = clustered_mean(ratio + (above - ratio * below) / below.mean(), clusters)
    return Estimate(float(ratio), float(np.maximum(found.low, 0)), found.high)


def clustered_mean(values: ArrayLike, clusters: ArrayLike, possible: Range = ANY) -> Estimate:
    """Estimates the mean of values, with a 95 % t interval from the spread of cluster means.

    Episodes on one trace share its difficulty, so the trace (in a sweep: seed and trace) is the
    sampled unit: the variance of the mean comes from clusters, not from episodes.

    Args:
        values: [E].
        clusters: [E] the same number for values of one cluster.
        possible: least and largest possible value of the quantity. An end of the interval outside
            this range is moved to the nearest possible value. If a value was observed outside the
            range, the range is extended to that value.
    """
    values, clusters = np.asarray(values, dtype=float), np.asarray(clusters)
    _, index = np.unique(clusters, return_inverse=True)
    counts = np.bincount(index)
    mean = float(values.mean())
    groups = len(counts)
    if groups < 2:
        return Estimate(mean, float("nan"), float("nan"))
    # Total residual of each cluster: exact for equal sizes, the usual ratio estimate otherwise.
    totals = np.bincount(index, weights=values - mean)
    variance = groups / (groups - 1) * float((totals**2).sum()) / len(values) ** 2
    half = half_width(variance**0.5, groups - 1)
    least = min(possible[0], float(values.min()))
    most = max(possible[1], float(values.max()))
    return Estimate(mean, max(mean - half, least), min(mean + half, most))


def clustered_share(right: ArrayLike, clusters: ArrayLike) -> Estimate:
    """Estimates a share of clustered cases, with Wilson's 95 % score interval (1927), which stays
    within [0, 1].

    Cases of one cluster may be similar. So the interval uses Kish's effective sample size (at most
    the number of cases): the number of independent cases with the same uncertainty. Student's
    quantile corrects for few clusters. If all cases of each cluster agree, each cluster counts as
    one case.

    Args:
        right: [E] of bool.
        clusters: [E] the same number for cases of one cluster; with one cluster the interval is
            unknown.
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
