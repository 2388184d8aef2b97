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
    curve. Its knee stands, also where it is wrong: the first drop of the curve is the largest (it
    parts most pairs of types at once), so that the knee often comes too early. The first rule that
    applies:

    1. ``flat zero``: nobody ever disagrees, k = 1.
    2. ``kneedle``: its knee. Where it reports an end of the curve, as of concave ones, it found
       none: a curve cannot bend at its end.
    3. ``no knee, few``: the smallest k that leaves at most ``few`` of the disagreements at k = 1.
    4. ``no knee, lowest``: no k does; the smallest k of the fewest disagreements.

    Args:
        curve: [K] disagreements for k = 1 … K.
        few: a share in [0, 1), for where there is no knee.
    """
    # A partition into more clusters may be worse by chance; what counts is the best so far.
    lowest = np.minimum.accumulate(curve)
    if curve[0] == 0:
        return _chosen(1, "flat zero", "no two observers disagree on any label")
    knee = _kneedle(lowest)
    if knee is not None:
        return _chosen(
            knee,
            "kneedle",
            f"there the curve of disagreements within types bends, from {curve[0]} with one type "
            f"to {lowest[knee - 1]}",
        )
    why = "the curve of disagreements within types has no knee"
    reached = np.flatnonzero(lowest <= few * lowest[0])
    if len(reached):
        k = int(reached[0]) + 1
        why += f"; {k} is the first number of types that leaves at most {few:.2%}"
        return _chosen(k, "no knee, few", why)
    k = int(lowest.argmin()) + 1
    why += f"; no number of types leaves only {few:.2%}, {k} the fewest"
    return _chosen(k, "no knee, lowest", why)


def _chosen(k: int, rule: str, why: str) -> tuple[int, str]:
    log.info("%d user types by the rule %s: %s", k, rule, why)
    return k, rule


def _kneedle(curve: NDArray[np.int64]) -> int | None:
    """The knee of a curve that never rises, strictly between its ends; None where it has none."""
    from kneed import KneeLocator  # heavy: it imports pyplot

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "no knee" is an answer here, not a warning
        k = range(1, len(curve) + 1)
        found = KneeLocator(k, curve.tolist(), curve="convex", direction="decreasing").knee
    return int(found) if found is not None and 1 < found < len(curve) else None
