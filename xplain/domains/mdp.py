"""Tabular Markov decision processes, solved in batches (docs/method.md, section 1).

A robot's task and each user's belief about it are models over the same states and actions. They are
solved in one batch, so accurately that it is certain whether an action is optimal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import DomainError

TIE = 1e-10
"""Two actions tie if their values differ by less than this number, relative to the model's
scale."""
CLEAR = 2e-10
"""Two actions differ if the gap between their values is at least this number. It is ten times the
error that :data:`SOLVED` allows in a gap. A gap between TIE and CLEAR is ambiguous."""
SOLVED = 1e-11
"""Maximum error of values, relative to the model's scale."""
MOST_SWEEPS = 20_000
LARGEST_BATCH = 1 << 17
"""Maximum number of outcomes (of all states, actions and models) in one sweep."""


class TaskModel:
    """A model of the task, the robot's or a user's: an :class:`MDP`, or a
    :class:`~xplain.domains.goal_task.GoalTask`.

    Attributes:
        successor, probability, terminal: as in :class:`MDP`.
        optimal: [S, A] the optimal actions, once the model is solved.
    """

    successor: NDArray[Any]
    probability: NDArray[Any]
    terminal: NDArray[np.bool_]
    optimal: NDArray[np.bool_]

    @property
    def n_states(self) -> int:
        """S, the number of states, including terminal states."""
        return len(self.terminal)

    @property
    def n_actions(self) -> int:
        """A, the number of actions, whether available in a state or not."""
        return int(self.successor.shape[1])

    def labels(self, transitions: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Computes [T] the labels of transitions [T, 3] once the model is solved: 1 (explicable)
        for an optimal action with a possible outcome, 0 otherwise."""
        raise NotImplementedError

    @staticmethod
    def solve(models: Any, names: Sequence[str]) -> tuple[Any, ...]:
        """Solves models of this class over the same states and actions.

        Raises:
            DomainError: ties of a model are ambiguous. The error contains the model's name from
                ``names``.
        """
        raise NotImplementedError


def find_reached(
    starts: NDArray[np.int64], states: int, after: Callable[[NDArray[np.int64]], NDArray[Any]]
) -> NDArray[np.bool_]:
    """Finds the states that can be reached from the starts, in any number of steps (0 is allowed).

    Args:
        starts: indices of states.
        states: S, the number of states.
        after: returns the successors of an array of states, in any order, possibly repeated.

    Returns:
        [S] True for reached states.
    """
    seen = np.zeros(states, dtype=bool)
    frontier = starts
    while len(frontier):
        seen[frontier] = True
        new = np.unique(after(frontier))
        frontier = new[~seen[new]]
    return seen


@dataclass(frozen=True)
class MDP(TaskModel):
    """A finite discounted MDP, sparse: K outcome slots for each state and action.

    Attributes:
        successor: [S, A, K] int64, the next state of each outcome.
        probability: [S, A, K] float64; unused slots have 0. An action that is not available in a
            state has 0 in every slot; otherwise the slots sum to 1.
        reward: [S, A, K] float64, R(s, a, s').
        discount: γ in [0, 1).
        terminal: [S] bool; nothing happens after a terminal state, its value is 0.
        optimal: [S, A] the optimal actions; empty until :meth:`solve` finds them.
    """

    successor: NDArray[np.int64]
    probability: NDArray[np.float64]
    reward: NDArray[np.float64]
    discount: float
    terminal: NDArray[np.bool_]
    optimal: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))

    def __post_init__(self) -> None:
        """Checks shapes and probabilities.

        Raises:
            DomainError: a shape or a value contradicts the attributes' description.
        """
        shape = self.successor.shape
        if len(shape) != 3 or self.probability.shape != shape or self.reward.shape != shape:
            raise DomainError(f"MDP: successor {shape}, probability, reward must all be [S, A, K]")
        if self.terminal.shape != shape[:1]:
            raise DomainError(f"MDP: terminal must be [S] = [{shape[0]}]")
        total = self.probability.sum(axis=2)
        for broken, reason in (
            (not 0 <= self.discount < 1, f"discount={self.discount}: a number in [0, 1)"),
            (not np.isfinite(self.reward).all(), "every reward must be a finite number"),
            (
                (self.probability < 0).any() or not np.all((total == 0) | np.isclose(total, 1)),
                "outcome probabilities of an action must sum to 1 (or all be 0)",
            ),
            (
                ((total == 0).all(axis=1) & ~self.terminal).any(),
                "every state that is not terminal needs an action",
            ),
            (
                (self.successor < 0).any() or (self.successor >= shape[0]).any(),
                "successor names a state that does not exist",
            ),
        ):
            if broken:
                raise DomainError(f"MDP: {reason}")

    def labels(self, transitions: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Computes labels as :meth:`TaskModel.labels` describes."""
        s, a, after = transitions.T
        possible = (self.successor[s, a] == after[:, None]) & (self.probability[s, a] > 0)
        return np.asarray(self.optimal[s, a] & possible.any(axis=1), dtype=np.uint8)

    @staticmethod
    def solve(models: Sequence[MDP], names: Sequence[str]) -> tuple[MDP, ...]:
        """Solves all models together.

        Raises:
            DomainError: the gap between two actions is too small to tell whether they tie, or a
                discount is too close to 1.
        """
        q = q_values(models)
        best = q.max(axis=2, keepdims=True)
        scale = np.array([_compute_scale(model) for model in models])[:, None, None]
        gap = np.where(np.isfinite(q), best - q, np.inf) / scale
        for b, s, a in np.argwhere((gap > TIE) & (gap < CLEAR)):
            raise DomainError(
                f"domain: ambiguous tie in {names[b]}, state {s}, action {a}: its value is below "
                f"the best by {gap[b, s, a]:.1e} of the largest possible value; change a reward or "
                f"the discount so that gaps are 0 or above {CLEAR:g}"
            )
        return tuple(
            replace(model, optimal=(own <= TIE) & ~model.terminal[:, None])
            for model, own in zip(models, gap, strict=True)
        )


def q_values(models: Sequence[MDP]) -> NDArray[np.float64]:
    """Computes the optimal action values of B models over the same states and actions.

    The error |Q − Q*| of a model is at most SOLVED · max |R| / (1 − γ), where max |R| is the
    model's largest absolute reward.

    Returns:
        [B, S, A]; −inf for unavailable actions, 0 in terminal states.

    Raises:
        DomainError: a discount is so close to 1 that rounding errors hide the optimum.
    """
    together = max(1, LARGEST_BATCH // models[0].successor.size)
    batches = range(0, len(models), together)
    return np.concatenate([_solve_batch(models[first : first + together]) for first in batches])


def _solve_batch(models: Sequence[MDP]) -> NDArray[np.float64]:
    """Computes [B, S, A] the optimal action values of B models together, by modified policy
    iteration (Puterman & Shin 1978).

    A Bellman sweep is a γ-contraction in the max norm with fixed point V*. Let δ be the largest
    change of a value in a sweep. Then the new values differ from V* by at most δ γ / (1 − γ), and
    the action values computed from the new values differ from Q* by at most δ γ² / (1 − γ). The
    loop ends when δ γ² / (1 − γ) is at most the error that :func:`q_values` allows.

    Between two Bellman sweeps, sweeps with the greedy policy move the values towards the values of
    this policy. A sweep with one policy needs 1 / A of the time. These sweeps make the loop faster,
    and do not change when it ends.
    """
    slots = max(model.successor.shape[2] for model in models)

    def stack(name: str) -> NDArray[Any]:
        """Stacks an array [S, A, K] of each model into one array [B, S, A, K]. Models with fewer
        outcome slots than K have 0 in the missing slots."""
        arrays = [getattr(model, name) for model in models]
        return np.stack([np.pad(a, [(0, 0), (0, 0), (0, slots - a.shape[2])]) for a in arrays])

    successor, probability = stack("successor"), stack("probability")
    gain = (probability * stack("reward")).sum(axis=3)
    gain[probability.sum(axis=3) == 0] = -np.inf
    terminal = np.stack([model.terminal for model in models])
    gain[terminal], probability[terminal] = 0.0, 0.0
    discount = np.array([model.discount for model in models])
    allowed = SOLVED * np.array([_compute_scale(model) for model in models])
    allowed *= (1 - discount) / np.maximum(discount**2, 1e-300)
    probability *= discount[:, None, None, None]
    b, s = np.ogrid[: len(models), : models[0].n_states]
    successor += b[..., None, None] * models[0].n_states  # an index into the values of all models
    value = np.zeros(terminal.shape)
    for _ in range(MOST_SWEEPS):
        q = gain + np.einsum("bsak,bsak->bsa", probability, value.take(successor))
        swept, greedy = q.max(axis=2), q.argmax(axis=2)
        done = (np.abs(swept - value).max(axis=1) <= allowed).all()
        value = swept
        if done:
            return np.asarray(
                gain + np.einsum("bsak,bsak->bsa", probability, value.take(successor))
            )
        own, chance, after = (array[b, s, greedy] for array in (gain, probability, successor))
        for _ in range(100):
            before = value
            value = own + np.einsum("bsk,bsk->bs", chance, value.take(after))
            if (np.abs(value - before).max(axis=1) <= 0.1 * allowed).all():
                break
    raise DomainError(
        f"domain: a model with discount {discount.max():g} cannot be solved accurately "
        "enough to decide whether actions tie; use a smaller discount"
    )


def _compute_scale(model: MDP) -> float:
    largest = float(np.abs(model.reward[model.probability > 0]).max(initial=0.0))
    return max(largest, 1e-12) / (1 - model.discount)
