"""QHR: the best set of messages if nothing could be said after the next step.

Q_t(b, a) = −(λ C_e(a) + Σ_{j > k}^{m} Σ_{i ≤ j} C_inexp (1 − P[t, i, H ∪ a])) for every set a of
messages not yet given, and Q = Σ_t b(t) Q_t (the paper, "Myopic Approximation: QHR", after Fern et
al. 2014). The sum over j begins with the prefix that the next *explain* shows, k + 1 transitions
where k were shown so far. As in the paper nothing is discounted, whatever the problem's γ.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.message_sets import subsets
from xplain.explanation.problem import Problem
from xplain.solvers.base import Knowledge, Policy
from xplain.solvers.model import Model, best_of, model_of
from xplain.solvers.restriction import Restricted, coupled
from xplain.solvers.value_of_information import asks_by_value


@dataclass(frozen=True)
class QHR:
    """No options: a closed form, computed when asked. Needs no tables."""

    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation, as :class:`xplain.solvers.base.Solver` says.

        Raises:
            TooLargeError: more than MAX_RELEVANT messages matter to some type.
        """
        return asks_by_value(self._plan(problem), problem, seed)

    def _plan(self, problem: Problem) -> Policy:
        if problem.is_dense:
            return QHRPolicy(model_of(problem))
        small, kept = coupled(problem, "qhr")
        return Restricted(QHRPolicy(model_of(small.dense())), kept)


@dataclass(frozen=True)
class QHRPolicy:
    """Maximises QHR's closed form. Ties: fewest messages first, then message order."""

    model: Model

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """The messages to give before the next *explain*, as
        :class:`xplain.solvers.base.Policy` says."""
        return best_of(*self._all(step, given, belief))

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """Of *explain* (0), of each message alone, and of the set chosen."""
        masks, values = self._all(step, given, belief)
        shown = np.flatnonzero((np.bitwise_count(masks) <= 1) | (values == values.max()))
        return {int(masks[s]): float(values[s]) for s in shown}

    def _all(
        self, step: int, given: int, belief: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Every set of messages not given, ascending, and its value."""
        model = self.model
        m = model.n_steps
        # Transition i is in the prefixes of max(k, i) + 1 to m transitions (i counted from 0).
        times = m - np.maximum(step, np.arange(m))
        masks = subsets(j for j in range(len(model.price)) if not given >> j & 1)
        zeros = (times @ (belief.sum() - model.p @ belief))[masks | given]
        price = np.zeros(len(masks))
        for j, cost in enumerate(model.price):
            price += cost * (masks >> j & 1)
        return masks, -(price + model.inexplicability * zeros)
