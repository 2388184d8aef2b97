"""Types as classes of answers, for tables in which nobody was told anything.

Without messages labels say nothing of which facts a person believes incorrectly; all that types can
be is people who answer alike. A class k answers question q with 1 with probability P[k, q] ~ Beta(c
m_q, c (1 − m_q)): m_q is everybody's mean, so a class of few answers is drawn towards it, and by
how much (c) is learned. Observers share classes by a Dirichlet process, drawn in blocks (Ishwaran &
James 2001, "Gibbs sampling methods for stick-breaking priors", section 5). What is expected of an
observer is averaged over all draws: one sharing of classes is surer than answers allow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, gammaln, softmax

from xplain.learning.data.dataset import Dataset
from xplain.learning.types import Clustering, shares_of
from xplain.randomness import stream

MOST = 30
"""Classes at most."""
STARTS = 5
"""Classes that a chain starts with, of observers drawn at random."""
SWEEPS, WARM_UP = 300, 100
"""Draws of a chain, and how many of the first do not count."""
SHRINKAGE = np.array([0.5, 1, 2, 4, 8, 16, 32])
"""c is one of these, as likely each."""


def answer_classes(dataset: Dataset, concentration: float, chains: int, seed: int) -> Clustering:
    """Draws classes of the observers by their answers, whatever they were told: those of the
    likeliest draw, what is expected over all draws, and how likely how many are.

    Args:
        dataset: labels of O observers on T transitions.
        concentration: prior mean of α of the process, which is learned.
        chains: independent runs.
        seed: of every draw.
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
    """The state of a chain: ``assignment`` [O], and what was ``expected`` [O, T] of observers given
    the one before.

    Args:
        ones, total: [O, T] answers 1, and all answers.
        concentration: prior mean of α.
        rng: of every draw.
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
        """Draws everything once; returns the log of the joint probability of the classes before
        and the answers, α at its prior mean, but for a constant."""
        rng = self.rng
        self.assignment = np.unique(self.assignment, return_inverse=True)[1]  # those in use first
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
        """Draws α given the number of classes in use (Escobar & West 1995, section 6), then log
        shares [K]: those of classes in use and of all others are Dirichlet, and what is left for
        others is broken in sticks."""
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
        """Draws c, P[k, q] integrated out; returns the log-likelihood of the answers under it."""
        value = np.empty(len(SHRINKAGE))
        for i, c in enumerate(SHRINKAGE):
            first, second = c * self.mean, c * (1 - self.mean)
            value[i] = (betaln(first + ones, second + zeros) - betaln(first, second)).sum()
        chosen = int(self.rng.choice(len(value), p=softmax(value)))
        self.shrinkage = float(SHRINKAGE[chosen])
        return float(value[chosen])
