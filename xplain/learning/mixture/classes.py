"""Types as classes of answers, for data without messages.

Labels given without messages do not show which facts a person believes incorrectly. A type can then
only be a class: people who answer alike. P[k, q] is the probability that a member of class k
answers 1 to question q, with the prior Beta(c m_q, c (1 − m_q)). m_q is the mean answer of all
people. A class with few answers is shrunk towards m_q; the strength c is learned. A Dirichlet
process assigns observers to classes; its variables are drawn in blocks (Ishwaran & James 2001,
"Gibbs sampling methods for stick-breaking priors", section 5). The expected answers of an observer
are averaged over all draws, because a single draw shows too little uncertainty.
"""

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
    ones, total = np.zeros(shape), np.zeros(shape)
    np.add.at(ones, (dataset.observer, dataset.transition), dataset.label)
    np.add.at(total, (dataset.observer, dataset.transition), 1)
    expected, drawn = np.zeros(shape), []
    best, chosen = -np.inf, np.zeros(shape[0], dtype=np.int64)
    for chain in range(chains):
        state = _Chain(ones, total, concentration, stream(seed, "answer classes", chain))
        for sweep in range(SWEEPS):
            before, score = state.assignment, state.sweep()
            if sweep >= WARM_UP:
                expected += state.expected
                drawn.append(len(np.unique(before)))
                best, chosen = max((score, before), (best, chosen), key=lambda one: one[0])
    expected /= len(drawn)
    return Clustering(
        chosen, "dirichlet", "posterior", posterior=shares_of(drawn), expected=expected
    )


class _Chain:
    """The state of a chain of draws.

    Args:
        ones, total: [O, T] number of answers 1, and of all answers.
        concentration: prior mean of α.
        rng: random stream of every draw.

    Attributes:
        assignment: [O] class of each observer.
        expected: [O, T] probability that the observer answers 1, computed with the assignment
            before the last sweep.
    """

    def __init__(
        self,
        ones: NDArray[np.float64],
        total: NDArray[np.float64],
        concentration: float,
        rng: np.random.Generator,
    ) -> None:
        self.ones, self.zeros, self.rng = ones, total - ones, rng
        self.mean = (ones.sum(axis=0) + 1) / (total.sum(axis=0) + 2)
        self.rate = 1 / concentration
        self.alpha, self.shrinkage = concentration, float(np.median(SHRINKAGE))
        self.assignment = rng.integers(0, STARTS, len(ones))

    def sweep(self) -> float:
        """Draws all variables once. Returns the log of the joint probability of the previous
        classes and the answers, up to a constant, with α at its prior mean."""
        rng = self.rng
        self.assignment = np.unique(self.assignment, return_inverse=True)[1]  # classes in use first
        member = np.eye(MOST)[self.assignment]
        size, ones, zeros = member.sum(axis=0), member.T @ self.ones, member.T @ self.zeros
        own = size[size > 0]
        score = self._draw_shrinkage(ones, zeros)
        score += float(gammaln(own).sum() - len(own) * np.log(self.rate))
        share = self._draw_shares(own)
        c = self.shrinkage
        first, second = c * self.mean + ones, c * (1 - self.mean) + zeros
        one = rng.beta(first, second).clip(1e-9, 1 - 1e-9)  # [K, T]
        joint = self.ones @ np.log(one).T + self.zeros @ np.log1p(-one).T + share
        self.expected = (first / (first + second))[self.assignment]
        below = softmax(joint, axis=1).cumsum(axis=1) < rng.random((len(joint), 1))
        self.assignment = below.sum(axis=1).clip(0, MOST - 1)
        return score

    def _draw_shares(self, size: NDArray[np.float64]) -> NDArray[np.float64]:
        """Draws α given the number of classes in use (Escobar & West 1995, section 6). Then draws
        the shares of K classes given α, and returns their logs [K].

        The shares of the classes in use, and the total share of all unused classes, have a
        Dirichlet distribution. The total share of the unused classes is divided among them by stick
        breaking.
        """
        rng, n, k = self.rng, float(size.sum()), len(size)
        rate = self.rate - np.log(rng.beta(self.alpha + 1, n))
        more = rng.random() * (k + n * rate) < k
        self.alpha = float(rng.gamma(k + more, 1 / rate))
        drawn = rng.gamma(np.append(size, self.alpha))
        drawn /= drawn.sum()
        stick = rng.beta(1, self.alpha, MOST - k)
        stick[1:] *= np.cumprod(1 - stick[:-1])
        return np.asarray(np.log(np.append(drawn[:-1], drawn[-1] * stick) + 1e-300))

    def _draw_shrinkage(self, ones: NDArray[np.float64], zeros: NDArray[np.float64]) -> float:
        """Draws the strength c, with P[k, q] integrated out. Returns the log likelihood of the
        answers given the drawn c."""
        value = np.empty(len(SHRINKAGE))
        for i, c in enumerate(SHRINKAGE):
            first, second = c * self.mean, c * (1 - self.mean)
            value[i] = (betaln(first + ones, second + zeros) - betaln(first, second)).sum()
        chosen = int(self.rng.choice(len(value), p=softmax(value)))
        self.shrinkage = float(SHRINKAGE[chosen])
        return float(value[chosen])
