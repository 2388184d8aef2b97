"""Candidates that grow with the answers, where facts are so many that not all sets can be listed.

At first the sets of very few facts are candidates. Whichever set the answers make likely brings
in all sets of one fact more, so that the list holds the sets that are likely, and those next to
them; what it leaves out would need several facts more than any likely set.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from xplain.domains.users.hypotheses import Hypotheses
from xplain.errors import DomainError, TooLargeError

log = logging.getLogger(__name__)

ERROR = 0.05
"""Probability of a wrong answer, where it is not known."""
LIKELY = 0.2
"""Posterior of a set that brings in those next to it. More than a set gets by its prior alone that
has one fact more than another, and was never asked about."""


def grown(
    hypotheses: Hypotheses, posterior: Callable[[Hypotheses], NDArray[np.float64]]
) -> Hypotheses:
    """With all sets next to likely ones, until no likely set lacks any.

    Args:
        hypotheses: the candidates so far; returned as they are where labels of further sets are
            not known, or cannot be worked out.
        posterior: [C] of candidates.
    """
    while hypotheses.further is not None:
        new = _next_to(hypotheses, hypotheses.facts[posterior(hypotheses) >= LIKELY])
        if not len(new):
            break
        try:
            hypotheses = hypotheses.with_sets(new)
        except (DomainError, TooLargeError) as error:
            log.info("no further hypotheses: %s", error)
            break
    return hypotheses


def posterior_by(
    hypotheses: Hypotheses,
    transitions: NDArray[np.int64],
    told: NDArray[np.int64],
    labels: NDArray[np.int64],
) -> NDArray[np.float64]:
    """[C] of candidates given the answers of one type: transitions, message sets and labels,
    [P] each. One answer in twenty is taken to be wrong."""
    agree = (hypotheses.label(transitions, told) == labels).sum(axis=2)
    with np.errstate(divide="ignore"):
        joint = agree * np.log((1 - ERROR) / ERROR) + np.log(hypotheses.prior)
    joint += np.log(hypotheses.variant_prior)[:, None]
    return np.asarray(np.exp(joint - logsumexp(joint)).sum(axis=0))


def _next_to(hypotheses: Hypotheses, likely: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sets of one fact more than one of these, which are no candidates yet."""
    more = likely[:, None] | 1 << np.arange(hypotheses.n_messages)
    return np.setdiff1d(more, hypotheses.facts)
