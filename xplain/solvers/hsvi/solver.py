"""Certified: searches until the optimum is known to within a gap, and acts on what it found.

The bounds are of the optimal expected *discounted* return under the model. The policy takes, where
the search has been, the set of messages with the best certified lower bound; elsewhere (answers so
unlikely that the search left them coarse, users unlike the model) it searches afresh from there,
briefly. Its own exact value is :func:`xplain.solvers.policy_evaluation.evaluate`'s to tell.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.explanation.problem import Problem
from xplain.solvers.base import Knowledge, Policy
from xplain.solvers.count_lattice import make_room
from xplain.solvers.hsvi.initial_bounds import Tables, make_tables, table_bytes
from xplain.solvers.hsvi.pair_bounds import PairTables, with_own_room
from xplain.solvers.hsvi.search import DONE, FULL, NEWS, TAIL, add_node, search, sweep, tighten
from xplain.solvers.hsvi.tree import NODES, OPENED, WORK, Store, grown, make_store, store_bytes
from xplain.solvers.memory import GIB, check_memory, check_memory_gib
from xplain.solvers.model import best_set
from xplain.solvers.restriction import Restricted, messages_worth_giving

log = logging.getLogger(__name__)

CHUNK = 100_000
"""Work between two looks at the clock and at Ctrl-C: some hundredths of a second."""
COARSER = 2
"""A search asks for a gap this much smaller than the last that it closed."""
GROWTH = 1.2
"""All nodes are backed up once their number has grown by this factor."""
WORTH = 4
"""Tables of pairs are made once they cost at most this many times what was spent."""
SAME = 1e-9
"""Beliefs that differ by less in every entry are the same belief."""


@dataclass(frozen=True)
class Effort:
    """When a search may stop.

    Attributes:
        gap: once upper − lower is at most this.
        nodes: once so many beliefs were opened (the same on every machine).
        seconds: once so much time has passed (not the same on every machine).
        memory_gib: rather than take more.
    """

    gap: float = 1e-3
    nodes: int = 1_000_000
    seconds: float = math.inf
    memory_gib: float = 8.0

    def __post_init__(self) -> None:
        """Raises InputError."""
        if not self.gap >= 1e-9:
            raise InputError("solver.gap", self.gap, "a number ≥ 1e-9")
        if not self.nodes >= 1:
            raise InputError("solver.nodes", self.nodes, "a number ≥ 1")
        if not self.seconds > 0:
            raise InputError("solver.seconds", self.seconds, "a number > 0")
        check_memory_gib(self.memory_gib)


@dataclass(frozen=True)
class Found:
    """What a search found.

    Attributes:
        tables: those it ended with.
        store: its nodes.
        root: one of them.
    """

    tables: Tables
    store: Store
    root: int

    @property
    def lower(self) -> float:
        """Of the root's optimal value."""
        return float(self.store.lower[self.root])

    @property
    def upper(self) -> float:
        """Of the root's optimal value."""
        return float(self.store.upper[self.root])

    def values(self, node: int) -> dict[int, float]:
        """Certified lower bounds of the sets of messages not ruled out at an opened node."""
        first = self.store.first[node]
        actions = slice(first, first + self.store.n_actions[node])
        sets, lower = self.store.action_set[actions], self.store.action_lower[actions]
        return dict(zip(sets.tolist(), lower.tolist(), strict=True))


def explore(
    tables: Tables,
    step: int,
    given: int,
    belief: NDArray[np.float64],
    effort: Effort,
    problem: Problem | None = None,
) -> Found:
    """Searches from a belief at (k, H), within the effort. Ctrl-C is heard throughout.

    With the ``problem`` of the tables, a long search makes those of pairs; a short one does not
    pay for them.
    """
    began = time.perf_counter()
    tables = tables._replace(pairs=with_own_room(tables.pairs))
    steps, _, types = tables.explain.shape
    store = make_store(tables)
    root = add_node(tables, store, step, given, belief, np.zeros(types, dtype=np.int64))
    tail_gap = effort.gap * TAIL / steps
    path, gaps = np.empty((2, steps), dtype=np.int64), np.empty(steps)
    working = path, gaps, np.empty(types), make_room(steps, types)
    room, swept = 256, 1
    pairs = PairTables(problem) if problem else None
    # Coarse before fine: a trial for the final gap would first refine what is ruled out later.
    asked = max(effort.gap, (store.upper[root] - store.lower[root]) / COARSER)
    while True:
        buffers = np.empty((room, types)), np.empty((room, types), dtype=np.int64)
        limits = asked, tail_gap, effort.nodes, CHUNK
        status = search(tables, store, root, *limits, *buffers, *working)
        if status == FULL:
            room *= 2
            if 2 * store_bytes(store) > effort.memory_gib * GIB:
                log.warning("the search stops at solver.memory_gib=%g", effort.memory_gib)
                break
            store = grown(store)
            continue
        if (status == DONE and asked == effort.gap) or store.used[OPENED] >= effort.nodes:
            break
        spent = time.perf_counter() - began
        if spent > effort.seconds:
            break
        if pairs and CHUNK <= store.used[WORK] >= pairs.work / WORTH:
            in_time = spent < effort.seconds / (1 + WORTH)
            if in_time and pairs.bytes < effort.memory_gib * GIB / 4:
                tables = tables._replace(pairs=pairs.make())
                tighten(tables, store)
                swept = 0
            pairs = None
        if status == DONE or store.used[NODES] > GROWTH * swept:
            sweep(tables, store, NEWS * effort.gap)
            swept = int(store.used[NODES])
        if status == DONE:
            asked = max(effort.gap, min(asked, store.upper[root] - store.lower[root]) / COARSER)
    if store.upper[root] - store.lower[root] > effort.gap:
        sweep(tables, store, NEWS * effort.gap)
    return Found(tables, store, root)


@dataclass(frozen=True)
class Certified:
    """Args:
    gap: stop once the optimum is known this well.
    nodes: most beliefs to open before the first step.
    seconds: most time for it, results then depend on the machine; None is no limit.
    decision_nodes: most beliefs to open for a decision where the search has not been.
    memory_gib: most memory; tables beyond it are refused, the search stops before it.
    """

    gap: float = 1e-3
    nodes: int = 1_000_000
    seconds: float | None = None
    decision_nodes: int = 50
    memory_gib: float = 8.0
    knows: Knowledge = "types"

    def __post_init__(self) -> None:
        """Raises InputError."""
        if not self.decision_nodes >= 1:
            raise InputError("solver.decision_nodes", self.decision_nodes, "a number ≥ 1")
        _ = self._effort

    @property
    def _effort(self) -> Effort:
        seconds = math.inf if self.seconds is None else self.seconds
        return Effort(self.gap, self.nodes, seconds, self.memory_gib)

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """See :class:`xplain.solvers.base.Solver`."""
        kept = messages_worth_giving(problem)
        small = problem.with_messages(kept)
        tables = tables_within(small, self.memory_gib)
        found = explore(tables, 0, 0, small.prior, self._effort, small)
        brief = Effort(self.gap, self.decision_nodes, math.inf, self.memory_gib)
        return CertifiedPolicy(Searched(found, brief), kept)


def tables_within(problem: Problem, memory_gib: float) -> Tables:
    """The bounds' tables.

    Raises:
        TooLargeError: they take more.
    """
    instead = "solver=lookahead needs less, and solver=qhr no tables"
    check_memory("certified", table_bytes(problem), memory_gib, instead)
    return make_tables(problem)


@dataclass(frozen=True)
class CertifiedPolicy(Restricted):
    """A restricted policy that also tells the bounds at the root.

    Attributes:
        policy: the policy over the kept messages.
    """

    policy: Searched

    @property
    def lower(self) -> float:
        """Of the optimal value."""
        return self.policy.found.lower

    @property
    def upper(self) -> float:
        """Of the optimal value."""
        return self.policy.found.upper


@dataclass(frozen=True)
class Searched:
    """Acts on certified lower bounds.

    Attributes:
        found: by the search from the prior.
        brief: the effort for a belief not found there.
    """

    found: Found
    brief: Effort

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """See :class:`xplain.solvers.base.Policy`."""
        return best_set(self.values(step, given, belief))

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """Certified lower bounds by set of messages, of those not ruled out."""
        nodes = self._opened.get((step, given), np.empty(0, dtype=np.int64))
        if len(nodes):
            distance = np.abs(self.found.store.belief[nodes] - belief).max(axis=1)
            nearest = int(distance.argmin())
            if distance[nearest] < SAME:
                return self.found.values(int(nodes[nearest]))
        here = explore(self.found.tables, step, given, belief, self.brief)
        return here.values(here.root)

    @cached_property
    def _opened(self) -> dict[tuple[int, int], NDArray[np.int64]]:
        """The opened nodes at each (k, H)."""
        store = self.found.store
        opened = np.flatnonzero(store.first[: store.used[NODES]] >= 0)
        place = store.step[opened] << 32 | store.given[opened]
        order = np.argsort(place, kind="stable")
        keys, starts = np.unique(place[order], return_index=True)
        groups = np.split(opened[order], starts[1:])
        return {
            (int(key) >> 32, int(key) & 0xFFFFFFFF): group
            for key, group in zip(keys, groups, strict=True)
        }
