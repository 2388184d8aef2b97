"""Deterministic undiscounted tasks that end at a goal. The cheapest plan is best, and a state
without a plan has a given cost (docs/method.md, section 1).

Actions without a cost, *free* actions, may form circles or be useless in a cheapest plan. So a free
action is best only if it reduces the minimum number of free actions that a cheapest plan still
needs. An action with a cost is best if it is on a cheapest plan. So each best action reduces the
cost to go, or the number of free actions still needed.

There is no discount, because a discount would prefer plans with late costs. All beliefs about one
task share its states and edges (:class:`StateSpace`). A belief defines which edges exist, their
costs, and the goal (:class:`GoalTask`). Shortest paths to the goal solve it exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from xplain.domains.mdp import CLEAR, TIE, TaskModel
from xplain.errors import DomainError


@dataclass(frozen=True, eq=False)
class StateSpace:
    """S states, and the E edges between them that exist in at least one belief.

    An action may have different effects in different beliefs. Each version of an action is a
    *variant*; there are V.

    Attributes:
        n_states, n_actions: S and the number A of actions.
        action: [V] index of each variant's action.
        source: [E] start state of each edge, ascending.
        variant: [E] variant of each edge.
        successor: [E] end state of each edge.
    """

    n_states: int
    n_actions: int
    action: NDArray[np.integer]
    source: NDArray[np.integer]
    variant: NDArray[np.integer]
    successor: NDArray[np.integer]

    @cached_property
    def backwards(self) -> NDArray[np.int64]:
        """[E] indices of the edges, sorted by their end state."""
        return np.argsort(self.successor, kind="stable")

    def shortest(
        self, length: NDArray[np.float64], ends: NDArray[np.int64], backwards: bool = False
    ) -> NDArray[np.float64]:
        """Computes [S] the length of the shortest path between each state and the nearest of
        ``ends``.

        Args:
            length: [E] length of each edge; ∞ if it cannot be used.
            ends: some states.
            backwards: True for paths to ``ends``, False for paths from ``ends``.
        """
        order = self.backwards if backwards else slice(None)
        ways = (self.successor, self.source) if backwards else (self.source, self.successor)
        before, after = (way[order] for way in ways)
        first = np.searchsorted(before, np.arange(self.n_states + 1))
        graph = csr_array((length[order], after, first), shape=(self.n_states, self.n_states))
        return np.asarray(dijkstra(graph, indices=ends, min_only=True))


@dataclass(frozen=True, eq=False)
class GoalTask(TaskModel):
    """The task as the robot or a user sees it.

    Attributes:
        space: shared by all beliefs about the task.
        cost: [V] ≥ 0, cost of each variant; ∞ if this belief does not have it.
        terminal: [S] bool, goal states; nothing happens after them.
        dead_end_cost: cost of a state without a plan. Plans with this cost or more do not count.
        start: start state; it must have a plan.
        imagined: [S] for a user who believes in another start: the state that this user imagines
            instead of each true state. None for a user who sees the true states.
    """

    space: StateSpace
    cost: NDArray[np.float64]
    terminal: NDArray[np.bool_]
    dead_end_cost: float
    start: int
    imagined: NDArray[np.int64] | None = None

    discount = 1.0

    @property
    def n_actions(self) -> int:
        """A, the number of actions, whether available in a state or not."""
        return self.space.n_actions

    @property
    def _edge_cost(self) -> NDArray[np.float64]:
        """[E] the cost of each edge; ∞ if this belief does not have the edge, or if the edge begins
        in a goal state."""
        there = ~self.terminal[self.space.source]
        return np.where(there, self.cost[self.space.variant], np.inf)

    @cached_property
    def to_go(self) -> NDArray[np.float64]:
        """[S] cost of the cheapest plan from each state, exact up to rounding; ∞ in dead ends."""
        found = self.space.shortest(self._edge_cost, np.flatnonzero(self.terminal), True)
        return np.where(found < self.dead_end_cost, found, np.inf)

    def _compute_gaps(self) -> NDArray[np.float64]:
        """Computes [E] the gap of each edge.

        Let a plan begin with the edge and then be the cheapest one. The gap is the cost of this
        plan minus the cost of the cheapest plan from the same state, divided by the largest finite
        cost in :attr:`to_go`. The gap is ∞

        - if this belief does not have the edge;
        - if the edge begins or ends in a dead end;
        - if the edge is free and does not reduce the number of free actions still needed.
        """
        cost, source, after = self._edge_cost, self.space.source, self.space.successor
        behind = cost + self.to_go[after]
        behind[~np.isfinite(self.to_go[source])] = np.inf
        more = behind - np.where(np.isfinite(behind), self.to_go[source], 0.0)
        longest = self.to_go[np.isfinite(self.to_go)].max(initial=0.0)
        gap = more / max(longest, 1e-12)
        free = cost == 0
        if free.any():
            length = np.where(gap <= TIE, free.astype(np.float64), np.inf)
            needed = self.space.shortest(length, np.flatnonzero(self.terminal), True)
            gap[free & (needed[after] >= needed[source])] = np.inf
        return np.asarray(gap)

    @cached_property
    def _best(self) -> NDArray[np.int64]:
        """Indices of the edges on cheapest plans, without useless free edges."""
        return np.flatnonzero(self._compute_gaps() <= TIE)

    def on_policy(self, starts: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """Returns [T, 3] all transitions on cheapest plans.

        Args:
            starts: states where the plans begin; None: all states.
        """
        space, best = self.space, self._best
        if starts is not None:
            length = np.full(len(space.source), np.inf)
            length[best] = 1
            best = best[np.isfinite(space.shortest(length, starts))[space.source[best]]]
        action = space.action[space.variant[best]]
        keys = self._number_transitions(space.source[best], action, space.successor[best])
        shape = self.n_states, self.n_actions, self.n_states
        return np.stack(np.unravel_index(np.unique(keys), shape), axis=1)

    def _number_transitions(self, *transitions: NDArray[np.integer]) -> NDArray[np.int64]:
        """Computes [T] one integer for each (state [T], action [T], next state [T])."""
        shape = self.n_states, self.n_actions, self.n_states
        return np.asarray(np.ravel_multi_index(transitions, shape))

    def labels(self, transitions: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Computes [T] the labels of transitions [T, 3], in the states that this user imagines
        instead of the true states: 1 (explicable) if the action is on a cheapest plan and leads to
        the next state, 0 otherwise."""
        s, a, after = transitions.T
        if self.imagined is not None:
            s, after = self.imagined[s], self.imagined[after]
        best = self._number_transitions(*self.on_policy().T)
        return np.isin(self._number_transitions(s, a, after), best).astype(np.uint8)

    def steps_from(self, state: int) -> NDArray[np.float64]:
        """Computes [S] the number of actions on the shortest path from a state; ∞ if there is no
        path."""
        length = np.where(np.isfinite(self._edge_cost), 1.0, np.inf)
        return self.space.shortest(length, np.array([state]))

    @cached_property
    def optimal(self) -> NDArray[np.bool_]:  # type: ignore[override]
        """[S, A] True for actions on a cheapest plan from each state of ``space``."""
        result = np.zeros((self.n_states, self.n_actions), dtype=bool)
        s, a, _ = self.on_policy().T
        result[s, a] = True
        return result

    @cached_property
    def successor(self) -> NDArray[np.int32]:  # type: ignore[override]
        """[S, A, 1] next state of each action, as in :class:`~xplain.domains.mdp.MDP`; computed at
        first use."""
        return self._make_table(self.space.successor, np.int32)

    @cached_property
    def probability(self) -> NDArray[np.float32]:  # type: ignore[override]
        """[S, A, 1] of 0 and 1, as in :class:`~xplain.domains.mdp.MDP`."""
        return self._make_table(np.ones(len(self.space.variant)), np.float32)

    @property
    def reward(self) -> NDArray[np.float64]:
        """[S, A, 1] the costs, negative; as in :class:`~xplain.domains.mdp.MDP`."""
        return -self._make_table(self._edge_cost, np.float64)

    def _make_table(self, of_edges: NDArray[Any], kind: type) -> NDArray[Any]:
        """Converts values of edges to a table [S, A, 1]; 0 where this belief has no edge.

        Args:
            of_edges: [E] the values.
            kind: type of the table's numbers.
        """
        result: NDArray[Any] = np.zeros((self.n_states, self.n_actions, 1), dtype=kind)
        own = np.isfinite(self._edge_cost)
        action = self.space.action[self.space.variant[own]]
        result[self.space.source[own], action, 0] = of_edges[own]
        return result

    def require_solution(self, who: str) -> None:
        """Checks that the task has a plan and unambiguous ties.

        Args:
            who: the person or model with this belief, for errors.

        Raises:
            DomainError: there is no plan, or two actions differ so little that it is unclear
                whether they tie.
        """
        start = self.start if self.imagined is None else int(self.imagined[self.start])
        if not np.isfinite(self.to_go[start]):
            raise DomainError(
                f"domain: unsolvable: {who} has no plan that reaches the goal for less than "
                f"domain.dead_end_cost={self.dead_end_cost:g}"
            )
        gap = self._compute_gaps()
        unclear = np.flatnonzero((gap > TIE) & (gap < CLEAR))
        if len(unclear):
            edge = unclear[0]
            raise DomainError(
                f"domain: ambiguous tie in {who}, state {self.space.source[edge]}, action "
                f"{self.space.action[self.space.variant[edge]]}: its plan costs more than the best "
                f"one by {gap[edge]:.1e} of the most expensive best plan; change a cost so that "
                f"gaps are 0 or above {CLEAR:g}"
            )

    @staticmethod
    def solve(models: Sequence[GoalTask], names: Sequence[str]) -> tuple[GoalTask, ...]:
        """Checks all models by :meth:`require_solution`, and returns them. Each model computes its
        solution at first use."""
        for model, name in zip(models, names, strict=True):
            model.require_solution(name)
        return tuple(models)
