"""How users listen and answer: the paper's take in every message for ever, and never err.

A user answers the opposite of what they would have with probability e; takes a message in with
probability α when it is said; and loses a corrected fact with probability φ at each step, after
their labels. Nobody's *habits* are known, so they are a hidden part of the explanation beside the
user type, on a small grid. Costs depend on what a user thinks, evidence on what they answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, Range

Assumed = float | Mapping[float, float] | Literal["learned"]
"""A rate that all users share; rates with their shares among users; or ``learned``: the rates that
people's answers tell, and where they tell nothing of it a documented grid."""
MOST = 45
"""Habits on a grid, at most: tables and beliefs grow by so much."""


RANGES = {"error": Range(0, 0.5, "[)"), "accept": Range(0, 1, "(]"), "forget": Range(0, 1, "[)")}
"""Rates that users may have. Whoever errs more often than not means the opposite."""


@dataclass(frozen=True)
class Habits:
    """F habits.

    Attributes:
        error: [F] e, each ≥ 0 and below ½: whoever errs more often means the opposite.
        accept: [F] α in (0, 1].
        forget: [F] φ in [0, 1).
        prior: [F] how likely each is; sums to 1.
    """

    error: NDArray[np.float64]
    accept: NDArray[np.float64]
    forget: NDArray[np.float64]
    prior: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Raises InputError for a rate that no user has, or no probabilities."""
        for key in ("error", "accept", "forget", "prior"):
            object.__setattr__(self, key, np.asarray(getattr(self, key), float))
        rates = {key: getattr(self, key) for key in RANGES}
        count = self.prior.size
        if not 1 <= count <= MOST or any(own.shape != (count,) for own in rates.values()):
            raise InputError("habits", count, f"1 to {MOST} of them, each with all rates")
        for key, own in rates.items():
            for rate in own.tolist():
                RANGES[key].check(f"habits.{key}", rate)
        if not (self.prior >= 0).all() or abs(self.prior.sum() - 1) > 1e-6:
            raise InputError("habits.prior", self.prior.tolist(), "probabilities that sum to 1")
        object.__setattr__(self, "prior", self.prior / self.prior.sum())

    def __len__(self) -> int:
        return len(self.prior)

    @cached_property
    def never_err(self) -> bool:
        """Whether everybody answers what they think."""
        return not self.error.any()

    @cached_property
    def take_all_in(self) -> bool:
        """Whether everybody takes every message in and keeps it: what was said is what a user
        knows."""
        return bool((self.accept == 1).all()) and not self.forget.any()

    def shares(self, key: str) -> dict[float, float]:
        """How likely each rate of a kind (``error``, ``accept``, ``forget``) is, ascending."""
        rates = getattr(self, key)
        return {rate: float(self.prior[rates == rate].sum()) for rate in np.unique(rates).tolist()}

    def answered(self, meant: NDArray[np.float64]) -> NDArray[np.float64]:
        """P(answer is 1) of a table [..., N] of what answers would be without errors: [..., N F],
        the habits side by side within a type."""
        e = np.tile(self.error, meant.shape[-1])
        a = meant.repeat(len(self), axis=-1)
        return (1 - e) * a + e * (1 - a)


PAPER = Habits(np.zeros(1), np.ones(1), np.zeros(1), np.ones(1))
"""Users take every message in for ever, and answer what they think."""

Grid = tuple[tuple[float, ...], tuple[float, ...]]
UNKNOWN: dict[str, Grid] = {
    "error": ((0.0, 0.04, 0.1, 0.2, 0.35), (0.5, 0.25, 0.15, 0.07, 0.03)),
    "accept": ((1.0, 0.8, 0.6), (0.6, 0.25, 0.15)),
    "forget": ((0.0, 0.05, 0.1), (0.6, 0.25, 0.15)),
}
"""Where no answers were learned from: rates and how likely they are. Half of the people
make no mistake of their own; the mean error rate is .05."""


def habits_of(
    error: Assumed, accept: Assumed, forget: Assumed, learned: Habits | None = None
) -> Habits:
    """The habits that a belief assumes: each rate as told, or learned; independent of each other.

    Args:
        error, accept, forget: the settings ``belief.error``, ``belief.accept``, ``belief.forget``.
        learned: from people's answers. UNKNOWN where there were none, or where everybody has the
            paper's rate: answers to questions alone tell nothing of messages that do not land.

    Raises:
        InputError: neither ``learned`` nor a rate in its range.
    """
    grids = []
    for key, assumed in (("error", error), ("accept", accept), ("forget", forget)):
        check_assumed(key, assumed)
        if isinstance(assumed, Mapping):
            whole = sum(assumed.values())
            grids.append([(float(rate), share / whole) for rate, share in assumed.items()])
        elif assumed != "learned":
            grids.append([(float(assumed), 1.0)])
        elif learned is None or (getattr(learned, key) == getattr(PAPER, key)).all():
            grids.append(list(zip(*UNKNOWN[key], strict=True)))
        else:
            grids.append(list(learned.shares(key).items()))
    ways = list(product(*grids))
    e, a, f = np.array([[rate for rate, _ in way] for way in ways]).T
    prior = np.array([[share for _, share in way] for way in ways]).prod(axis=1)
    return Habits(e, a, f, prior)


def check_assumed(key: str, assumed: Assumed) -> None:
    """Raises InputError: neither ``learned`` nor rates in their range."""
    if assumed == "learned":
        return
    try:
        if not isinstance(assumed, Mapping):
            return RANGES[key].check(f"belief.{key}", assumed)
        for rate, share in assumed.items():
            RANGES[key].check(f"belief.{key}", float(rate))  # a text in a plan, which is JSON
            Range(0).check(f"belief.{key}", share)
        Range(0, ends="()").check(f"belief.{key}", sum(assumed.values()))
    except (InputError, ValueError):
        wanted = f"{RANGES[key].allowed()}, learned, or {{rate: share, …}} of such rates"
        raise InputError(f"belief.{key}", assumed, wanted) from None
