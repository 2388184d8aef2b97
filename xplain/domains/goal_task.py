"""Deterministic undiscounted tasks that end at a goal: the cheapest plan is best, and a state
without a plan costs a given number (docs/method.md, section 1).

Actions may cost nothing. Then some of them lead round in circles on cheapest plans, or do no good.
So an action that costs nothing is best only if it lowers the number of such actions that a cheapest
plan still needs at least. Actions that cost something are best if they are on a cheapest plan, as
in tasks where everything costs. Each best action brings the goal nearer: either the cost to go or
that number falls.

A discount would prefer plans whose costs come late. Many beliefs about one task share its states
and edges (:class:`StateSpace`). A belief says which edges exist, what they cost, and where the goal
is (:class:`GoalTask`). Shortest paths to the goal solve it exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from xplain.domains.mdp import CLEAR, TIE
from xplain.errors import DomainError


@dataclass(frozen=True, eq=False)
class StateSpace:
    """S states and all E edges between them that anybody believes in.

    An action may have different effects in different beliefs: each is a variant of the action.

    Attributes:
        n_states, n_actions: S and A.
        action: [V] int32, the action that each variant is one of.
        first: [S + 1] int64, the edges of state s are first[s] to first[s + 1].
        variant: [E] int32, rising within a state.
        successor: [E] int32.
    """

    n_states: int
    n_actions: int
    action: NDArray[np.int32]
    first: NDArray[np.int64]
    variant: NDArray[np.int32]
    successor: NDArray[np.int32]

    @cached_property
    def source(self) -> NDArray[np.int32]:
        """[E] the state that each edge leaves."""
        return np.repeat(np.arange(self.n_states, dtype=np.int32), np.diff(self.first))

    @cached_property
    def backwards(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The edges by the state they reach: [S + 1] first of each state, [E] their numbers."""
        order = np.argsort(self.successor, kind="stable")
        count = np.bincount(self.successor, minlength=self.n_states)
        return np.concatenate([[0], np.cumsum(count)]).astype(np.int64), order

    def edges(self, states: NDArray[np.int64], variants: NDArray[np.int64]) -> NDArray[np.int64]:
        """The edge of each (state [T], variant [T]); −1 where there is none, as of the state −1 and
        of the variant −1."""
        keys = self._keys
        wanted = states.astype(np.int64) * len(self.action) + variants
        at = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
        found = (keys[at] == wanted) if len(keys) else np.zeros(len(wanted), dtype=bool)
        return np.where(found & (variants >= 0), at, -1)  # no edge leaves the state −1

    @cached_property
    def _keys(self) -> NDArray[np.int64]:
        return self.source.astype(np.int64) * len(self.action) + self.variant


@dataclass(frozen=True, eq=False)
class GoalTask:
    """The task as the robot or a user sees it.

    Attributes:
        space: shared by all beliefs about the task.
        chosen: [A] the variant of each action; −1 where the action is never available.
        cost: [A] ≥ 0, of each action.
        terminal: [S] bool, where the goal holds; nothing happens there.
        dead_end_cost: of a state without a plan. A plan that costs as much does not count.
        start: where the task starts; it must have a plan.
        imagined: [S] for a user who believes in another start: the state that they see instead of
            each state; −1 if it is not in ``space``. None: they see the states as they are.
    """

    space: StateSpace
    chosen: NDArray[np.int64]
    cost: NDArray[np.float64]
    terminal: NDArray[np.bool_]
    dead_end_cost: float
    start: int
    imagined: NDArray[np.int64] | None = None

    discount = 1.0

    @property
    def n_states(self) -> int:
        """S, the number of states, terminal ones included."""
        return self.space.n_states

    @property
    def n_actions(self) -> int:
        """A, the number of actions, whether available in a state or not."""
        return self.space.n_actions

    @cached_property
    def _variant_cost(self) -> NDArray[np.float64]:
        """[V] the cost of each variant; ∞ if this belief does not have it."""
        result = np.full(len(self.space.action), np.inf)
        own = self.chosen >= 0
        result[self.chosen[own]] = self.cost[own]
        return result

    @cached_property
    def to_go(self) -> NDArray[np.float64]:
        """[S] the cost of the cheapest plan, exact up to rounding; ∞ in dead ends."""
        first, order = self.space.backwards
        cost, before = self._variant_cost[self.space.variant[order]], self.space.source[order]
        graph = csr_array((cost, before, first), shape=(self.n_states, self.n_states))
        found = dijkstra(graph, indices=np.flatnonzero(self.terminal), min_only=True)
        return np.where(found < self.dead_end_cost, found, np.inf)

    @cached_property
    def free_to_go(self) -> NDArray[np.float64]:
        """[S] the fewest actions that cost nothing on a cheapest plan; ∞ in dead ends."""
        if not (self.cost == 0).any():
            return np.where(np.isfinite(self.to_go), 0.0, np.inf)
        best = self._extra(np.arange(len(self.space.variant))) <= TIE
        free = (self._variant_cost[self.space.variant[best]] == 0).astype(float)
        ends = self.space.successor[best], self.space.source[best]
        order = np.lexsort((free, *ends))
        kept = order[np.r_[True, (np.diff(ends[0][order]) != 0) | (np.diff(ends[1][order]) != 0)]]
        graph = csr_array(
            coo_array((free[kept], (ends[0][kept], ends[1][kept])), shape=(self.n_states,) * 2)
        )
        return dijkstra(graph, indices=np.flatnonzero(self.terminal), min_only=True)

    def gap(self, edges: NDArray[np.int64]) -> NDArray[np.float64]:
        """The extra cost of each edge [T] and a best plan after it over a best plan from its start,
        relative to the most expensive best plan. ∞ if this belief does not have the edge, it leads
        to a dead end, leaves a terminal state, or costs nothing and brings the goal no nearer."""
        before, after = self.space.source[edges], self.space.successor[edges]
        idle = self._variant_cost[self.space.variant[edges]] == 0
        idle &= self.free_to_go[after] >= self.free_to_go[before]
        return np.where(idle, np.inf, self._extra(edges))

    def _extra(self, edges: NDArray[np.int64]) -> NDArray[np.float64]:
        """As :meth:`gap`, for all edges that this belief has."""
        before, variant = self.space.source[edges], self.space.variant[edges]
        behind = self._variant_cost[variant] + self.to_go[self.space.successor[edges]]
        none = ~np.isfinite(behind) | ~np.isfinite(self.to_go[before]) | self.terminal[before]
        more = np.where(none, np.inf, behind) - np.where(none, 0.0, self.to_go[before])
        dearest = self.to_go[np.isfinite(self.to_go)].max(initial=0.0)
        return np.asarray(more / max(dearest, 1e-12))

    def explicable(self, transitions: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether each transition [T, 3] is on a cheapest plan and has the believed result: [T]."""
        edge = self._edges(transitions)
        result = edge >= 0
        result[result] = self.gap(edge[result]) <= TIE
        return result

    def _edges(self, transitions: NDArray[np.int64]) -> NDArray[np.int64]:
        """The edge of each transition as the user sees it; −1 if there is none."""
        s, a, after = transitions.T
        if self.imagined is not None:
            s, after = self.imagined[s], self.imagined[after]
        edge = self.space.edges(s, self.chosen[a])
        there = edge >= 0
        there[there] = self.space.successor[edge[there]] == after[there]
        return np.where(there, edge, -1)

    def steps_from(self, state: int) -> NDArray[np.float64]:
        """[S] the number of actions on the shortest path from a state; ∞ if there is none."""
        own = np.isfinite(self._variant_cost)[self.space.variant]
        return self._steps(np.array([state]), own & ~self.terminal[self.space.source])

    def on_policy(self, starts: NDArray[np.int64]) -> NDArray[np.int64]:
        """[T, 3] every transition on a cheapest plan from one of the states."""
        best = self.gap(np.arange(len(self.space.variant))) <= TIE
        best &= np.isfinite(self._steps(starts, best))[self.space.source]
        source, after = self.space.source[best], self.space.successor[best]
        action = self.space.action[self.space.variant[best]]
        return np.stack([source, action, after], axis=1).astype(np.int64)

    def _steps(self, starts: NDArray[np.int64], edges: NDArray[np.bool_]) -> NDArray[np.float64]:
        """[S] the number of these edges on the shortest path from any of the starts."""
        ends = self.space.source[edges], self.space.successor[edges]
        ways = coo_array((np.ones(len(ends[0])), ends), shape=(self.n_states, self.n_states))
        return np.asarray(dijkstra(ways, indices=starts, unweighted=True, min_only=True))

    @cached_property
    def optimal(self) -> NDArray[np.bool_]:
        """[S, A] the actions on a cheapest plan from each state as it is."""
        result = np.zeros((self.n_states, self.n_actions), dtype=bool)
        best = self.gap(np.arange(len(self.space.variant))) <= TIE
        result[self.space.source[best], self.space.action[self.space.variant[best]]] = True
        return result

    @cached_property
    def successor(self) -> NDArray[np.int32]:
        """[S, A, 1] as in :class:`~xplain.domains.mdp.MDP`; made on demand."""
        return self._table(self.space.successor, np.int32)

    @cached_property
    def probability(self) -> NDArray[np.float32]:
        """[S, A, 1] of 0 and 1, as in :class:`~xplain.domains.mdp.MDP`."""
        return self._table(np.ones(len(self.space.variant)), np.float32)

    @property
    def reward(self) -> NDArray[np.float64]:
        """[S, A, 1] the costs, negative; as in :class:`~xplain.domains.mdp.MDP`."""
        return -self._table(self._variant_cost[self.space.variant], np.float64)

    def _table(self, of_edges: NDArray[Any], kind: type) -> NDArray[Any]:
        """[S, A, 1] a value of each edge of this belief, 0 elsewhere."""
        result: NDArray[Any] = np.zeros((self.n_states, self.n_actions, 1), dtype=kind)
        own = np.isfinite(self._variant_cost)[self.space.variant]
        own &= ~self.terminal[self.space.source]
        action = self.space.action[self.space.variant[own]]
        result[self.space.source[own], action, 0] = of_edges[own]
        return result

    def solved(self, who: str) -> None:
        """Checks that the task has a plan and clear ties.

        Args:
            who: has this belief, for errors.

        Raises:
            DomainError: it has no plan, or a gap is too small to tell whether two actions tie.
        """
        start = self.start if self.imagined is None else int(self.imagined[self.start])
        if start < 0 or not np.isfinite(self.to_go[start]):
            raise DomainError(
                f"domain: unsolvable: {who} has no plan that reaches the goal for less than "
                f"domain.dead_end_cost={self.dead_end_cost:g}"
            )
        gap = self.gap(np.arange(len(self.space.variant)))
        unclear = np.flatnonzero((gap > TIE) & (gap < CLEAR))
        if len(unclear):
            edge = unclear[0]
            raise DomainError(
                f"domain: ambiguous tie in {who}, state {self.space.source[edge]}, action "
                f"{self.space.action[self.space.variant[edge]]}: it costs {gap[edge]:.1e} of "
                f"the dearest plan more; change a cost so that gaps are 0 or above {CLEAR:g}"
            )

    @staticmethod
    def solve(models: Sequence[GoalTask], names: Sequence[str]) -> GoalSolution:
        """Solves all of them.

        Raises:
            DomainError: see :meth:`solved`.
        """
        for model, name in zip(models, names, strict=True):
            model.solved(name)
        return GoalSolution(tuple(models))


@dataclass(frozen=True)
class GoalSolution:
    """The optimal actions in each of B goal tasks (:class:`xplain.domains.mdp.Solution`)."""

    models: tuple[GoalTask, ...]

    def __getitem__(self, index: int) -> NDArray[np.bool_]:
        """[S, A] the optimal actions of one task; the table is made on demand."""
        return self.models[index].optimal

    def labels(self, transitions: NDArray[np.int64]) -> NDArray[np.uint8]:
        """[B, T] explicable or not."""
        found = [model.explicable(transitions) for model in self.models]
        return np.array(found, dtype=np.uint8)
