"""Two independent groups compared: the paper's t test, and what should stand beside it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy import special, stats

PERMUTATIONS = 10_000


def compare(
    a: ArrayLike,
    b: ArrayLike,
    strata_a: Sequence[str],
    strata_b: Sequence[str],
    seed: int,
    names: tuple[str, str] = ("a", "b"),
) -> dict[str, float]:
    """Group a against group b.

    Args:
        a, b: the measure of each participant.
        strata_a, strata_b: their user types, within which labels are shuffled.
        seed: of the permutations.
        names: of the groups.

    Returns:
        ``n_…``, ``mean_…`` and ``sd_…`` of each group; t, df and p of Student's test (the paper's)
        and of Welch's, two-sided; Hedges' g of a − b with its 95 % interval; the permutation test's
        p. NaN where the groups are too small or without any spread.
    """
    x, y = (pd.Series(np.asarray(values, dtype=float)) for values in (a, b))
    student = welch = g = (float("nan"),) * 3
    if min(len(x), len(y)) > 1 and (np.ptp(x) > 0 or np.ptp(y) > 0):
        with warnings.catch_warnings():
            # Of a group without spread: messages of a policy that tells everybody the same.
            warnings.filterwarnings("ignore", "Precision loss", RuntimeWarning)
            student, welch = (
                (float(test.statistic), float(test.df), float(test.pvalue))
                for test in (stats.ttest_ind(x, y, equal_var=equal) for equal in (True, False))
            )
        g = hedges(student[0], len(x), len(y))
    strata = np.array(strata_a), np.array(strata_b)
    p = stratified_permutation(x.to_numpy(), y.to_numpy(), *strata, seed)
    first, second = names
    return {
        **{f"n_{first}": len(x), f"mean_{first}": x.mean(), f"sd_{first}": x.std()},
        **{f"n_{second}": len(y), f"mean_{second}": y.mean(), f"sd_{second}": y.std()},
        **dict(zip(("student_t", "student_df", "student_p"), student, strict=True)),
        **dict(zip(("welch_t", "welch_df", "welch_p"), welch, strict=True)),
        **dict(zip(("hedges_g", "g_low", "g_high"), g, strict=True)),
        "permutation_p": p,
    }


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
    return 2 * special.stdtr(n + m - 2, -t)


def hedges(t: float, n_a: int, n_b: int, level: float = 0.95) -> tuple[float, float, float]:
    """Hedges' g from Student's t, with the exact interval by the noncentral t distribution.

    The small-sample factor is exact, J = Γ(ν/2) / (√(ν/2) Γ((ν − 1)/2)) (Hedges 1981).
    """
    df, scale = n_a + n_b - 2, np.sqrt(1 / n_a + 1 / n_b)
    correction = np.exp(special.gammaln(df / 2) - special.gammaln((df - 1) / 2)) / np.sqrt(df / 2)
    tail = (1 - level) / 2
    to_g = float(correction * scale)
    # Computed for |t|, where the function is accurate, and mirrored.
    low, high = (to_g * special.nctdtrinc(df, [1 - tail, tail], abs(t))).tolist()
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
    return np.take_along_axis(adjusted, np.argsort(order, axis=-1), axis=-1)


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
        return sums / len(x) - (total - sums) / len(y)

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
