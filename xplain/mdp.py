"""Tabular Markov decision processes, solved many at a time (SPEC §1).

A robot's task and each user's idea of it are models over the same states and actions; they are
solved in one batch, to an accuracy at which "is this action optimal?" has a safe answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from xplain.errors import DomainError

TIE = 1e-7
"""Two actions tie when their values differ by less than this, relative to the model's scale."""
CLEAR = 1e-5
"""They differ when the gap is at least this; a gap between TIE and CLEAR is ambiguous."""
SOLVED = 1e-10
"""Values are solved to within this of the optimum, relative to the model's scale."""


@dataclass(frozen=True)
class MDP:
    """A finite discounted MDP, sparse: K outcome slots for each state and action.

    Attributes:
        successor: [S, A, K] int64, the next state of each outcome.
        probability: [S, A, K] float64; unused slots have 0. An action that is not available in a
            state has 0 in every slot; otherwise the slots sum to 1.
        reward: [S, A, K] float64, R(s, a, s').
        discount: γ in [0, 1).
        terminal: [S] bool; nothing happens after a terminal state, its value is 0.
    """

    successor: NDArray[np.int64]
    probability: NDArray[np.float64]
    reward: NDArray[np.float64]
    discount: float
    terminal: NDArray[np.bool_]

    def __post_init__(self) -> None:
        """Checks shapes and probabilities.

        Raises:
            DomainError: they contradict the description above.
        """
        shape = self.successor.shape
        if len(shape) != 3 or self.probability.shape != shape or self.reward.shape != shape:
            raise DomainError(f"MDP: successor, probability, reward must share [S, A, K]: {shape}")
        if self.terminal.shape != shape[:1]:
            raise DomainError(f"MDP: terminal must be [S] = [{shape[0]}]")
        if not 0 <= self.discount < 1:
            raise DomainError(f"MDP: discount={self.discount}: a number in [0, 1)")
        if not np.isfinite(self.reward).all():
            raise DomainError("MDP: every reward must be a finite number")
        total = self.probability.sum(axis=2)
        if (self.probability < 0).any() or not np.all((total == 0) | np.isclose(total, 1)):
            raise DomainError("MDP: outcome probabilities of an action must sum to 1 (or all be 0)")
        if ((total == 0).all(axis=1) & ~self.terminal).any():
            raise DomainError("MDP: every state that is not terminal needs an action")
        if (self.successor < 0).any() or (self.successor >= shape[0]).any():
            raise DomainError("MDP: successor names a state that does not exist")

    @property
    def n_states(self) -> int:
        """S."""
        return int(self.successor.shape[0])

    @property
    def n_actions(self) -> int:
        """A."""
        return int(self.successor.shape[1])

    def possible(self, transitions: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which transitions [T, 3] of (s, a, s') have positive probability: [T]."""
        s, a, after = transitions.T
        reached = (self.successor[s, a] == after[:, None]) & (self.probability[s, a] > 0)
        return np.asarray(reached.any(axis=1))


def q_values(models: Sequence[MDP]) -> NDArray[np.float64]:
    """Optimal action values of many models over the same states and actions.

    Value iteration in place (Gauss–Seidel), each model to |Q − Q*| ≤ SOLVED × scale, where scale
    is the largest reward in size over 1 − γ.

    Returns:
        [B, S, A]; −inf where an action is not available, 0 in terminal states.
    """
    result = np.empty((len(models), models[0].n_states, models[0].n_actions))
    for b, model in enumerate(models):
        _value_iteration(
            model.successor,
            model.probability,
            model.reward,
            model.discount,
            model.terminal,
            SOLVED * _scale(model) * (1 - model.discount),
            result[b],
        )
    return result


def optimal_actions(models: Sequence[MDP], names: Sequence[str] = ()) -> NDArray[np.bool_]:
    """Which actions are optimal: [B, S, A].

    Args:
        models: solved together.
        names: of the models, for the error's text.

    Raises:
        DomainError: the gap between two actions is neither clearly a tie nor clearly none.
    """
    q = q_values(models)
    best = q.max(axis=2, keepdims=True)
    scale = np.array([_scale(model) for model in models])[:, None, None]
    gap = np.where(np.isfinite(q), best - q, np.inf) / scale
    for b, s, a in np.argwhere((gap > TIE) & (gap < CLEAR)):
        if not models[b].terminal[s]:
            who = names[b] if names else f"model {b}"
            raise DomainError(
                f"domain: ambiguous tie in {who}, state {s}, action {a}: its value is "
                f"{gap[b, s, a]:.1e} of the largest possible value below the best; change a reward "
                f"or the discount so that gaps are 0 or above {CLEAR:g}"
            )
    terminal = np.array([model.terminal for model in models])
    return np.asarray((gap <= TIE) & ~terminal[:, :, None])


def labels(
    models: Sequence[MDP], optimal: NDArray[np.bool_], transitions: NDArray[np.int64]
) -> NDArray[np.uint8]:
    """Explicable (1) or not (0), by model: an optimal action, and an outcome that can happen.

    Args:
        models: B of them.
        optimal: [B, S, A] of :func:`optimal_actions`.
        transitions: [T, 3] of (s, a, s').

    Returns:
        [B, T].
    """
    s, a, _ = transitions.T
    possible = np.array([model.possible(transitions) for model in models])
    return np.asarray(optimal[:, s, a] & possible, dtype=np.uint8)


def _scale(model: MDP) -> float:
    largest = float(np.abs(model.reward[model.probability > 0]).max(initial=0.0))
    return max(largest, 1e-12) / (1 - model.discount)


@njit(cache=True, nogil=True)
def _value_iteration(successor, probability, reward, discount, terminal, tolerance, q):  # type: ignore[no-untyped-def]
    """Fills q [S, A]. A sweep that changes no value by more than tolerance/γ·(1−γ)-ish ends it:
    the distance to the optimum is at most change · γ / (1 − γ), and callers pass tolerance
    already multiplied by (1 − γ)."""
    states, actions, slots = successor.shape
    value = np.zeros(states)
    change = tolerance + 1.0
    # Rounding keeps the change above any tolerance below ~1e-16 of the values; the bound on
    # sweeps only guards against that.
    for _ in range(1_000_000):
        if change <= tolerance:
            break
        change = 0.0
        # Alternating directions carry values both ways through the grid.
        for index in range(2 * states):
            s = index if index < states else 2 * states - 1 - index
            if terminal[s]:
                continue
            best = -np.inf
            for a in range(actions):
                total = 0.0
                mass = 0.0
                for k in range(slots):
                    p = probability[s, a, k]
                    if p > 0.0:
                        mass += p
                        total += p * (reward[s, a, k] + discount * value[successor[s, a, k]])
                if mass > 0.0 and total > best:
                    best = total
            change = max(change, abs(best - value[s]))
            value[s] = best
    for s in range(states):
        for a in range(actions):
            total = 0.0
            mass = 0.0
            for k in range(slots):
                p = probability[s, a, k]
                if p > 0.0:
                    mass += p
                    total += p * (reward[s, a, k] + discount * value[successor[s, a, k]])
            if terminal[s]:
                q[s, a] = 0.0
            elif mass > 0.0:
                q[s, a] = total
            else:
                q[s, a] = -np.inf
