"""Beliefs over user types (docs/method.md §5, paper's belief update).

A belief is an array [N] that sums to 1. A *belief update* is a function of what the user was
shown and answered; which labels count as evidence is the choice made here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.answer_errors import Error, check_error
from xplain.explanation.problem import Problem


class BeliefUpdate(Protocol):
    """How labels change the belief."""

    @property
    def error(self) -> Error:
        """How often users are taken to err."""
        ...

    def evidence(self, message_set: int, previous: int | None, count: int) -> slice:
        """Which of the ``count`` labels just given are new evidence.

        Args:
            message_set: H, all messages given when the labels were asked for.
            previous: H at the step before; None at the first step.
            count: k + 1, the transitions shown.
        """
        ...


@dataclass(frozen=True)
class Independent:
    """The paper: at every step all labels of the prefix are drawn afresh, all are evidence.

    Attributes:
        error: how often users are taken to err; 0 in the paper.
    """

    error: Error = 0.0

    def __post_init__(self) -> None:
        """Raises InputError for a setting out of its range."""
        check_error(self.error)

    def evidence(self, message_set: int, previous: int | None, count: int) -> slice:
        """All labels of an answer are evidence."""
        return slice(0, count)


@dataclass(frozen=True)
class Persistent:
    """A label of (transition, message set) given before is no new evidence: people who learned
    nothing new repeat themselves. Messages only accumulate, so only the newest transition's
    label is news unless the message set has changed.

    Attributes:
        error: how often users are taken to err. Asked again they err again.
    """

    error: Error = 0.0

    def __post_init__(self) -> None:
        """Raises InputError for a setting out of its range."""
        check_error(self.error)

    def evidence(self, message_set: int, previous: int | None, count: int) -> slice:
        """Every label after a message, the newest otherwise."""
        return slice(count - 1, count) if message_set == previous else slice(0, count)


def update(
    problem: Problem,
    belief: NDArray[np.float64],
    message_set: int,
    labels: NDArray[np.uint8],
    evidence: slice = slice(None),
) -> NDArray[np.float64]:
    """b'(t) ∝ b(t) · Π_i P(l_i | τ_i, H, t) over the answers that are evidence.

    Args:
        problem: of N hidden types.
        belief: [N].
        message_set: H, all messages given so far.
        labels: [k + 1] of 0 and 1, the user's labels of the prefix.
        evidence: which of them count.

    Returns:
        [N]. Labels that no type with positive belief can give (only with probabilities of
        exactly 0 or 1) tell nothing about the type: the belief stays as it was.
    """
    p = problem.answer_probabilities(len(labels), message_set)[:, evidence]
    likelihood = np.where(labels[evidence] == 1, p, 1 - p)
    with np.errstate(divide="ignore"):
        log_posterior = np.log(belief) + np.log(likelihood).sum(axis=1)
    top = log_posterior.max()
    if top == -np.inf:
        return belief.copy()
    posterior = np.exp(log_posterior - top)
    normalised: NDArray[np.float64] = posterior / posterior.sum()
    return normalised


def rounded(belief: NDArray[np.float64]) -> NDArray[np.float64]:
    """The belief to 12 decimals, its zeros without a sign: the same evidence in another order gives
    the same bytes."""
    return np.round(belief, 12) + 0.0
