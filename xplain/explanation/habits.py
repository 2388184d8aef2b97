"""Users' habits of listening and answering. The paper's users accept every message, never forget,
and never err.

A user gives the opposite answer with probability e, accepts a given message with probability α, and
forgets a corrected fact with probability φ at each step, after the labels. These *habits* are
unknown, so they belong to the hidden state, like the user type, and have values on a small grid.
Costs depend on what a user thinks; beliefs depend on what the user answers.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, Range

Assumed = float | Mapping[float, float] | Literal["learned"]
"""A rate that all users share; rates with their shares among users; or ``learned``: rates learned
from people's answers, or a documented grid if these give no information."""
MOST = 45
"""Maximum number of habits on a grid; tables and beliefs grow in proportion to this number."""
WAYS = np.array([12 * 0.99, 1, 1, 1, 12 * 0.01]) / 15
"""Assumed shares of people by their way of answering, for the belief about people nobody assumed
(:mod:`xplain.explanation.anybody`). People answer what they think; err in both directions; answer 1
although they think 0; answer at random; or answer what they think, but keep one incorrect belief
until all messages are given."""
RANGES = {"error": Range(0, 0.5, "[)"), "accept": Range(0, 1, "(]"), "forget": Range(0, 1, "[)")}
"""Possible rates. An error rate above ½ would mean that a user's answers are the opposite."""


@dataclass(frozen=True)
class Habits:
    """F habits that a user may have.

    Attributes:
        error: [F] e of each habit, in [0, ½).
        accept: [F] α of each habit, in (0, 1].
        forget: [F] φ of each habit, in [0, 1).
        prior: [F] probability of each habit; sums to 1.
        ways: [5] shares of people by their way of answering, as in WAYS. Only the belief about
            people nobody assumed uses them.
    """

    error: NDArray[np.float64]
    accept: NDArray[np.float64]
    forget: NDArray[np.float64]
    prior: NDArray[np.float64]
    ways: NDArray[np.float64] = field(default_factory=WAYS.copy)

    def __post_init__(self) -> None:
        """Raises InputError for a rate out of its range, or an invalid prior."""
        for key in ("error", "accept", "forget", "prior", "ways"):
            object.__setattr__(self, key, np.asarray(getattr(self, key), float))
        rates = {key: getattr(self, key) for key in RANGES}
        count = self.prior.size
        if not 1 <= count <= MOST or any(own.shape != (count,) for own in rates.values()):
            raise InputError("habits", count, f"1 to {MOST} habits, each with all rates")
        if self.ways.shape != WAYS.shape:
            raise InputError("habits.ways", self.ways.shape, f"{len(WAYS)} shares")
        for key, own in rates.items():
            for rate in own.tolist():
                RANGES[key].check(f"habits.{key}", rate)
        for key in ("prior", "ways"):
            share = getattr(self, key)
            if not (share >= 0).all() or abs(share.sum() - 1) > 1e-6:
                raise InputError(f"habits.{key}", share.tolist(), "probabilities that sum to 1")
        object.__setattr__(self, "prior", self.prior / self.prior.sum())

    def __len__(self) -> int:
        return len(self.prior)

    @cached_property
    def never_err(self) -> bool:
        """True if all users answer what they think."""
        return not self.error.any()

    @cached_property
    def take_all_in(self) -> bool:
        """True if all users accept every message and keep it, so that they know all given
        messages."""
        return bool((self.accept == 1).all()) and not self.forget.any()

    def shares(self, key: str) -> dict[float, float]:
        """Returns the possible rates of ``key`` (``error``, ``accept`` or ``forget``), ascending,
        with their probabilities."""
        rates = getattr(self, key)
        return {rate: float(self.prior[rates == rate].sum()) for rate in np.unique(rates).tolist()}

    def add_errors(self, meant: NDArray[np.float64]) -> NDArray[np.float64]:
        """Computes P(answer is 1) of each type with each habit.

        Args:
            meant: [..., N] P(label is 1) of each type.

        Returns:
            [..., N F] P(answer is 1); the F habits of the first type come first, then those habits
            of the second type, and so on.
        """
        e = np.tile(self.error, meant.shape[-1])
        a = meant.repeat(len(self), axis=-1)
        return (1 - e) * a + e * (1 - a)


PAPER = Habits(np.zeros(1), np.ones(1), np.zeros(1), np.ones(1))
"""The paper's habit: users accept every message, never forget, and answer what they think."""

Grid = tuple[tuple[float, ...], tuple[float, ...]]
UNKNOWN: dict[str, Grid] = {
    "error": ((0.0, 0.04, 0.1, 0.2, 0.35), (0.5, 0.25, 0.15, 0.07, 0.03)),
    "accept": ((1.0, 0.8, 0.6), (0.6, 0.25, 0.15)),
    "forget": ((0.0, 0.05, 0.1), (0.6, 0.25, 0.15)),
}
"""Rates and their probabilities that are assumed if no rates were learned. Half of the people never
err by themselves; the mean error rate is 0.05."""


def habits_of(
    error: Assumed, accept: Assumed, forget: Assumed, learned: Habits | None = None
) -> Habits:
    """Makes the habits that a belief assumes: each rate is given or learned, and the three rates
    are independent.

    Args:
        error, accept, forget: the settings ``belief.error``, ``belief.accept``, ``belief.forget``.
        learned: habits learned from people's answers. The rates of UNKNOWN replace a learned rate
            if ``learned`` is None, or if all people have the paper's rate, because answers to
            questions cannot show which messages were missed.

    Raises:
        InputError: a setting is neither ``learned`` nor has rates in their range.
    """
    grids = []
    for key, assumed in (("error", error), ("accept", accept), ("forget", forget)):
        _check_assumed(key, assumed)
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


def _check_assumed(key: str, assumed: Assumed) -> None:
    """Raises InputError if a setting is not ``learned``, a rate in its range, or a mapping from
    such rates to shares."""
    if assumed == "learned":
        return
    try:
        if not isinstance(assumed, Mapping):
            return RANGES[key].check(f"belief.{key}", assumed)
        for rate, share in assumed.items():
            RANGES[key].check(f"belief.{key}", float(rate))  # a rate is a text in JSON plans
            Range(0).check(f"belief.{key}", share)
        Range(0, ends="()").check(f"belief.{key}", sum(assumed.values()))
    except (InputError, ValueError):
        wanted = f"{RANGES[key].describe()}, learned, or {{rate: share, …}} of such rates"
        raise InputError(f"belief.{key}", assumed, wanted) from None
