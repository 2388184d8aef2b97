"""Two independent groups compared: the paper's t test, and what should stand beside it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize, special, stats

PERMUTATIONS = 10_000


NAN = float("nan")


@dataclass(frozen=True)
class Group:
    """Size, mean and sample standard deviation."""

    n: int
    mean: float
    sd: float

    @classmethod
    def of(cls, values: NDArray[np.float64]) -> Group:
        """NaN where the group is too small."""
        n = len(values)
        mean = float(values.mean()) if n else NAN
        return cls(n, mean, float(values.std(ddof=1)) if n > 1 else NAN)


@dataclass(frozen=True)
class TTest:
    """A two-sided t test."""

    t: float = NAN
    df: float = NAN
    p: float = NAN


@dataclass(frozen=True)
class Comparison:
    """Group a against group b; NaN where the groups are too small or without any spread.

    Attributes:
        a, b: the groups.
        student: equal variances (the paper's test).
        welch: unequal variances.
        g, g_low, g_high: Hedges' g of a − b with its 95 % interval.
        permutation_p: two-sided, labels shuffled within strata.
    """

    a: Group
    b: Group
    student: TTest
    welch: TTest
    g: float
    g_low: float
    g_high: float
    permutation_p: float


def compare(
    a: ArrayLike, b: ArrayLike, strata_a: Sequence[str], strata_b: Sequence[str], seed: int
) -> Comparison:
    """All figures of one measure.

    Args:
        a, b: values of the groups.
        strata_a, strata_b: stratum (user type) of each value.
        seed: of the permutations.
    """
    x, y = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    student, welch, g = TTest(), TTest(), (NAN, NAN, NAN)
    if len(x) > 1 and len(y) > 1 and (np.ptp(x) > 0 or np.ptp(y) > 0):
        with warnings.catch_warnings():
            # Of a group without spread: messages of a policy that tells everybody the same.
            warnings.filterwarnings("ignore", "Precision loss", RuntimeWarning)
            student, welch = (
                TTest(float(found.statistic), float(found.df), float(found.pvalue))
                for found in (stats.ttest_ind(x, y, equal_var=equal) for equal in (True, False))
            )
        g = hedges(student.t, len(x), len(y))
    p = stratified_permutation(x, y, np.array(strata_a), np.array(strata_b), seed)
    return Comparison(Group.of(x), Group.of(y), student, welch, *g, permutation_p=p)


def student_p(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two-sided Student's p of many studies at once; 1 where nothing varies.

    Args:
        x, y: [studies, participants, measures].

    Returns:
        [studies, measures].
    """
    n, m = x.shape[1], y.shape[1]
    within = ((n - 1) * x.var(axis=1, ddof=1) + (m - 1) * y.var(axis=1, ddof=1)) / (n + m - 2)
    error = np.sqrt(within * (1 / n + 1 / m))
    difference = np.abs(x.mean(axis=1) - y.mean(axis=1))
    t = np.divide(difference, error, out=np.zeros_like(error), where=error > 1e-12)
    p: NDArray[np.float64] = 2 * special.stdtr(n + m - 2, -t)
    return p


def hedges(t: float, n_a: int, n_b: int, level: float = 0.95) -> tuple[float, float, float]:
    """Hedges' g from Student's t, with the exact interval by the noncentral t distribution.

    The small-sample factor is exact, J = Γ(ν/2) / (√(ν/2) Γ((ν − 1)/2)) (Hedges 1981).
    """
    df, scale = n_a + n_b - 2, np.sqrt(1 / n_a + 1 / n_b)
    correction = np.exp(special.gammaln(df / 2) - special.gammaln((df - 1) / 2)) / np.sqrt(df / 2)
    tail = (1 - level) / 2

    # Of t, nearly normal; wide enough for any level in use.
    reach = 8 * np.sqrt(1 + t**2 / (2 * df))

    def noncentrality(probability: float) -> float:
        def excess(nc: float) -> float:
            value = float(stats.nct.cdf(abs(t), df, nc))
            # Far out in the tails the library gives up; there the answer is plain.
            return (float(nc < abs(t)) if np.isnan(value) else value) - probability

        return float(optimize.brentq(excess, abs(t) - reach, abs(t) + reach))

    # Computed for |t|, where the distribution function is accurate, and mirrored.
    to_g = float(correction * scale)
    low, high = noncentrality(1 - tail) * to_g, noncentrality(tail) * to_g
    return (t * to_g, low, high) if t >= 0 else (t * to_g, -high, -low)


def holm(p: ArrayLike) -> NDArray[np.float64]:
    """Holm's step-down adjusted p values along the last axis, in the order given.

    Args:
        p: [..., tests]; NaN stays, and does not count as a test.
    """
    values = np.asarray(p, dtype=float)
    order = np.argsort(values, axis=-1)  # NaN last
    ranked = np.take_along_axis(values, order, axis=-1)
    tests = (~np.isnan(values)).sum(axis=-1, keepdims=True)
    steps = ranked * (tests - np.arange(values.shape[-1]))
    adjusted = np.minimum(1.0, np.maximum.accumulate(steps, axis=-1))
    found: NDArray[np.float64] = np.take_along_axis(adjusted, np.argsort(order, axis=-1), axis=-1)
    return found


def stratified_permutation(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    strata_x: NDArray[np.str_],
    strata_y: NDArray[np.str_],
    seed: int,
    permutations: int = PERMUTATIONS,
) -> float:
    """Two-sided p of the difference in means when labels are shuffled within strata.

    The test that assignment in blocks justifies: within a type, who got which condition was drawn
    by lot. (1 + as extreme) / (1 + permutations), so never 0.
    """
    if not len(x) or not len(y):
        return float("nan")
    values, strata = np.concatenate([x, y]), np.concatenate([strata_x, strata_y])
    in_x = np.arange(len(values)) < len(x)
    rng = np.random.default_rng(seed)
    shuffled = np.tile(in_x, (permutations, 1))
    for stratum in np.unique(strata):
        where = np.flatnonzero(strata == stratum)
        shuffled[:, where] = rng.permuted(shuffled[:, where], axis=1)
    total = values.sum()

    def difference(masks: NDArray[np.bool_]) -> NDArray[np.float64]:
        sums = masks @ values
        result: NDArray[np.float64] = sums / len(x) - (total - sums) / len(y)
        return result

    observed = abs(difference(in_x[None])[0])
    # Equal differences count as extreme, whatever the order of summation made of them.
    slack = 1e-9 * (1 + np.abs(values).max())
    extreme = int((np.abs(difference(shuffled)) >= observed - slack).sum())
    return (1 + extreme) / (1 + permutations)


def d_from_p(p: float, n: int) -> float:
    """The standardized difference behind a two-sided Student's p of two groups of n."""
    return float(stats.t.isf(p / 2, 2 * n - 2) * np.sqrt(2 / n))


def t_power(d: float, n: int, alpha: float = 0.05) -> float:
    """Power of the two-sided Student's t test at n a group."""
    df, nc = 2 * n - 2, d * np.sqrt(n / 2)
    critical = stats.t.isf(alpha / 2, df)
    return float(stats.nct.sf(critical, df, nc) + stats.nct.cdf(-critical, df, nc))
