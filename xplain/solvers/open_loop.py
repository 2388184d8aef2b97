"""Solvers that weigh nothing: references that show what a table of costs is worth.

- *silent* says nothing: its cost is that of all labels 0 under the empty message set;
- *say all* gives every message before the first step: λ Σ_j C_e(j), and what stays inexplicable.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.problem import Problem
from xplain.solvers.base import Knowledge, Policy


@dataclass(frozen=True)
class Silent:
    """Never gives a message."""

    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """See :class:`xplain.solvers.base.Solver`."""
        return OpenLoop(0)


@dataclass(frozen=True)
class SayAll:
    """Gives all messages at once, those too that change nothing."""

    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """See :class:`xplain.solvers.base.Solver`."""
        return OpenLoop((1 << problem.n_messages) - 1)


@dataclass(frozen=True)
class OpenLoop:
    """Gives a set of messages at the first opportunity, whatever the user answers.

    Attributes:
        chosen: the set, a bitmask.
    """

    chosen: int

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """Those of the set that are not yet given."""
        return self.chosen & ~given

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """None: nothing was weighed."""
        return {}
