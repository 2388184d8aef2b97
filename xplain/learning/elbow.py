"""Where the curve of disagreements bends: the number of user types
(docs/method.md, section 4; docs/choices.md, "no elbow")."""

from __future__ import annotations

import logging
import warnings

import numpy as np
from numpy.typing import NDArray

log = logging.getLogger(__name__)


def elbow(curve: NDArray[np.int64], few: float) -> tuple[int, str]:
    """The number of clusters at the elbow, and the rule that gave it (also logged).

    Kneedle (Satopää et al. 2011, the paper's choice) looks for the bend of a convex, decreasing
    curve. The first drop of the curve is the largest (it parts most pairs of types at once), so
    its knee may come too early; what tells is that almost all disagreements go away later. The
    first rule that applies:

    1. ``flat zero``: nobody ever disagrees, k = 1.
    2. ``kneedle``: its knee, if it leaves at most ``few`` of the disagreements at k = 1, or no k
       does. Only for curves of three points or more that are convex on the whole (lie below their
       chord): of others kneedle reports an end, or nothing.
    3. ``few``: the smallest k that leaves at most that share.
    4. ``lowest``: no k does; the smallest k of the fewest disagreements.

    Args:
        curve: [K] disagreements for k = 1 … K.
        few: a share in [0, 1).
    """
    # A partition into more clusters may be worse by chance; what counts is the best so far.
    lowest = np.minimum.accumulate(curve)
    if curve[0] == 0:
        return _chosen(1, "flat zero", "no two observers disagree on any label")
    reached = np.flatnonzero(lowest <= few * lowest[0])
    knee = None
    if len(curve) >= 3 and lowest.sum() < len(lowest) * (lowest[0] + lowest[-1]) / 2:
        knee = _kneedle(lowest)
    if knee is not None and (not len(reached) or knee > reached[0]):
        return _chosen(
            knee,
            "kneedle",
            f"there the curve of disagreements within types bends, from {curve[0]} with one type "
            f"to {lowest[knee - 1]}",
        )
    why = "the curve of disagreements within types has no knee"
    if knee is not None:
        why = f"at {knee} types, the knee of the curve, {lowest[knee - 1]} of the {curve[0]} "
        why += "disagreements with one type are left"
    if len(reached):
        k = int(reached[0]) + 1
        return _chosen(k, "few", f"{why}; {k} is the first number that leaves at most {few:.2%}")
    k = int(lowest.argmin()) + 1
    return _chosen(k, "lowest", f"{why}; no number of types leaves only {few:.2%}, {k} the fewest")


def _chosen(k: int, rule: str, why: str) -> tuple[int, str]:
    log.info("%d user types by the rule %s: %s", k, rule, why)
    return k, rule


def _kneedle(curve: NDArray[np.int64]) -> int | None:
    from kneed import KneeLocator  # heavy: it imports pyplot

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "no knee" is an answer here, not a warning
        k = range(1, len(curve) + 1)
        found = KneeLocator(k, curve.tolist(), curve="convex", direction="decreasing").knee
    return None if found is None else int(found)
