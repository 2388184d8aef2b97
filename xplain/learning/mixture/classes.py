"""Types as classes of answers, for data without messages.

Labels given without messages do not show which facts a person believes incorrectly. A type can then
only be a class: people who answer alike. P[k, q] is the probability that a member of class k
answers 1 to question q, with the prior Beta(c m_q, c (1 − m_q)). m_q is the mean answer of all
people. A class with few answers is shrunk towards m_q; the strength c is learned. A Dirichlet
process assigns observers to classes; its variables are drawn in blocks (Ishwaran & James 2001,
"Gibbs sampling methods for stick-breaking priors", section 5). The expected answers of an observer
are averaged over all draws, because a single draw shows too little uncertainty.
"""

from collections.abc import Iterator
from itertools import islice

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, gammaln, softmax

from xplain.learning.data.dataset import Dataset
from xplain.learning.types import Clustering, shares_of
from xplain.randomness import stream

MOST = 30
"""Maximum number of classes."""
STARTS = 5
"""Number of classes at the start of a chain; their observers are drawn at random."""
SWEEPS, WARM_UP = 300, 100
"""Sweeps of a chain, and the number of first sweeps that are discarded."""
SHRINKAGE = np.array([0.5, 1, 2, 4, 8, 16, 32])
"""The possible values of c, equally likely."""


def answer_classes(dataset: Dataset, concentration: float, chains: int, seed: int) -> Clustering:
    """Finds classes of observers by their answers alone; messages are ignored.

    Args:
        dataset: labels of O observers on T transitions.
        concentration: prior mean of α of the Dirichlet process; α is learned.
        chains: number of independent chains of draws.
        seed: seed of every draw.

    Returns:
        The classes of the most likely draw, the expected answers averaged over all draws, and the
        posterior over the number of classes.
    """
    shape = len(dataset.observers), len(dataset.features)
    zeros, ones = counts = np.zeros((2, *shape))
    np.add.at(counts, (dataset.label, dataset.observer, dataset.transition), 1)
    expected, drawn = np.zeros(shape), []
    best, chosen = -np.inf, np.zeros(shape[0], dtype=np.int64)
    for chain in range(chains):
        rng = stream(seed, "answer classes", chain)
        for score, classes, one in islice(_sweep(ones, zeros, concentration, rng), WARM_UP, SWEEPS):
            expected += one
            drawn.append(int(classes.max()) + 1)
            best, chosen = max((score, classes), (best, chosen), key=lambda own: own[0])
    expected /= len(drawn)
    return Clustering(
        chosen, "dirichlet", "posterior", posterior=shares_of(drawn), expected=expected
    )


def _sweep(
    ones: NDArray[np.float64],
    zeros: NDArray[np.float64],
    concentration: float,
    rng: np.random.Generator,
) -> Iterator[tuple[float, NDArray[np.int64], NDArray[np.float64]]]:
    """Draws all variables again and again.

    Args:
        ones, zeros: [O, T] number of answers 1, and of answers 0.
        concentration: prior mean of α.
        rng: random stream of every draw.

    Yields:
        For each sweep: the log of the joint probability of the classes and the answers, up to a
        constant, with α at its prior mean; [O] the class of each observer, numbered from 0; [O, T]
        the probability that the observer answers 1.
    """
    mean = (ones.sum(axis=0) + 1) / ((ones + zeros).sum(axis=0) + 2)
    alpha, assignment = concentration, rng.integers(0, STARTS, len(ones))
    while True:
        assignment = np.unique(assignment, return_inverse=True)[1]  # classes in use first
        member = np.eye(MOST)[assignment]
        size, one, zero = member.sum(axis=0), member.T @ ones, member.T @ zeros
        own = size[size > 0]
        c, score = _draw_shrinkage(mean, one, zero, rng)
        score += float(gammaln(own).sum() - len(own) * np.log(1 / concentration))
        alpha, share = _draw_shares(own, alpha, 1 / concentration, rng)
        first, second = c * mean + one, c * (1 - mean) + zero
        p = rng.beta(first, second).clip(1e-9, 1 - 1e-9)  # [K, T]
        yield score, assignment, (first / (first + second))[assignment]
        joint = ones @ np.log(p).T + zeros @ np.log1p(-p).T + share
        below = softmax(joint, axis=1).cumsum(axis=1) < rng.random((len(joint), 1))
        assignment = below.sum(axis=1).clip(0, MOST - 1)


def _draw_shares(
    size: NDArray[np.float64], alpha: float, rate: float, rng: np.random.Generator
) -> tuple[float, NDArray[np.float64]]:
    """Draws α given the number of classes in use (Escobar & West 1995, section 6), and then the
    shares of K classes given α.

    The shares of the classes in use, and the total share of all unused classes, have a Dirichlet
    distribution. The total share of the unused classes is divided among them by stick breaking.

    Args:
        size: [classes in use] number of observers.
        alpha: the previous α.
        rate: 1 / the prior mean of α.
        rng: random stream.

    Returns:
        The new α, and the logs of the shares [K].
    """
    n, k = float(size.sum()), len(size)
    rate = rate - np.log(rng.beta(alpha + 1, n))
    more = rng.random() * (k + n * rate) < k
    alpha = float(rng.gamma(k + more, 1 / rate))
    drawn = rng.gamma(np.append(size, alpha))
    drawn /= drawn.sum()
    stick = rng.beta(1, alpha, MOST - k)
    stick[1:] *= np.cumprod(1 - stick[:-1])
    return alpha, np.asarray(np.log(np.append(drawn[:-1], drawn[-1] * stick) + 1e-300))


def _draw_shrinkage(
    mean: NDArray[np.float64],
    ones: NDArray[np.float64],
    zeros: NDArray[np.float64],
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Draws the strength c, with P[k, q] integrated out.

    Args:
        mean: [T] prior mean of each question.
        ones, zeros: [K, T] number of answers 1, and of answers 0, of each class.
        rng: random stream.

    Returns:
        c, and the log likelihood of the answers given c.
    """
    first, second = SHRINKAGE[:, None, None] * mean, SHRINKAGE[:, None, None] * (1 - mean)
    value = (betaln(first + ones, second + zeros) - betaln(first, second)).sum(axis=(1, 2))
    chosen = int(rng.choice(len(value), p=softmax(value)))
    return float(SHRINKAGE[chosen]), float(value[chosen])
