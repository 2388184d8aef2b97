"""Answers that err: what users click is not always what they think.

A user errs at a rate e of their own: an answer is the opposite of what it would have been with
probability e. Nobody's rate is known, so the hidden part of an explanation is (user type, error
rate), the rate on a small grid. Costs depend on the type alone, evidence on both.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, number

MOST = 5
"""Rates on a grid, at most: beliefs and tables grow by so much."""

Error = float | Literal["learned"]
"""``belief.error``: 0 (the paper's: users answer what they think), a rate that all users share, or
the rates that were learned from the observers' answers."""


@dataclass(frozen=True)
class ErrorRates:
    """How often users err.

    Attributes:
        rates: [E] ascending, each ≥ 0 and below ½: whoever errs more often means the opposite.
        prior: [E] how likely each is; sums to 1.
    """

    rates: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))
    prior: NDArray[np.float64] = field(default_factory=lambda: np.ones(1))

    def __post_init__(self) -> None:
        """Raises InputError for rates that no user has, or no probabilities."""
        rates, prior = np.asarray(self.rates, float), np.asarray(self.prior, float)
        if rates.ndim != 1 or not 1 <= len(rates) <= MOST:
            raise InputError("error rates", rates.tolist(), f"1 to {MOST} rates")
        if not (rates >= 0).all() or not (rates < 0.5).all() or (np.diff(rates) <= 0).any():
            raise InputError("error rates", rates.tolist(), "ascending, each ≥ 0 and < 0.5")
        if prior.shape != rates.shape or not (prior >= 0).all() or abs(prior.sum() - 1) > 1e-6:
            wanted = f"{len(rates)} probabilities that sum to 1"
            raise InputError("prior of error rates", prior.tolist(), wanted)
        object.__setattr__(self, "rates", rates)
        object.__setattr__(self, "prior", prior / prior.sum())

    @property
    def none(self) -> bool:
        """Whether nobody ever errs."""
        return not self.rates.any()

    def answered(self, meant: NDArray[np.float64]) -> NDArray[np.float64]:
        """P(answer is 1) of a table [..., N] of what answers would be without errors: [..., N E],
        the rates side by side within a type."""
        e = np.tile(self.rates, meant.shape[-1])
        a = meant.repeat(len(self.rates), axis=-1)
        return (1 - e) * a + e * (1 - a)


NO_ERRORS = ErrorRates()
UNKNOWN = ErrorRates(np.array([0.0, 0.05, 0.1, 0.2, 0.3]), np.array([0.4, 0.2, 0.2, 0.1, 0.1]))
"""Where no answers were learned from: most people seldom err, some often (mean .08)."""


def error_rates(error: Error, learned: ErrorRates | None = None) -> ErrorRates:
    """The rates that ``belief.error`` asks for.

    Args:
        error: its value.
        learned: from observers' answers; UNKNOWN where there were none.

    Raises:
        InputError: neither ``learned`` nor a rate in [0, ½).
    """
    check_error(error)
    if error == "learned":
        return learned or UNKNOWN
    return ErrorRates(np.array([float(error)]), np.ones(1))


def check_error(error: Error) -> None:
    """Raises InputError: neither ``learned`` nor a rate in [0, ½)."""
    if error != "learned" and not 0 <= number("belief.error", error) < 0.5:
        raise InputError("belief.error", error, "a rate ≥ 0 and < 0.5, or learned")
