"""Certified: searches until the optimum is known to within a gap, and acts on the result.

HSVI (Smith & Simmons 2004) on a finite lattice, like AO*. Every belief that the search reaches has
an upper and a lower bound of its optimal value. Trials from the start tighten them until they meet.
The upper bound is the smallest of three: the values of known states, the bound from other beliefs'
upper bounds (sawtooth), and that of the best action. The lower bound is the largest of three: plans
that ignore answers, alpha vectors of other beliefs, and that of the best action. Unlikely answers
stay coarse, and the least likely ones are merged.

The bounds are of the optimal expected *discounted* return under the model. At beliefs that the
search reached, the policy takes the action with the best certified lower bound. At other beliefs
(unlikely answers, users unlike the model) it runs a short search from there.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Count, Positive, Range, checks
from xplain.explanation.actions import Action, AskQuestion, VisibleState, give
from xplain.explanation.label_table import NONE
from xplain.explanation.message_sets import compress, expand
from xplain.explanation.problem import Problem
from xplain.numba_kernels import tell_when_compiling
from xplain.solvers import hsvi_kernel as kernel
from xplain.solvers.base import GIB, Knowledge, Policy, best_action, check_memory
from xplain.solvers.hsvi_kernel import (
    ACTIONS,
    ANSWERS,
    DONE,
    FULL,
    HASHED,
    KEPT,
    NODES,
    OPENED,
    PLACES,
    ROOT,
    SETS,
    WORD,
    Scratch,
    Store,
    Tables,
)
from xplain.solvers.pomcp import search_model
from xplain.solvers.process import (
    Process,
    before_step,
    expected_after_forgetting,
    known_values,
    make_process,
    set_prices,
    weighable,
)

log = logging.getLogger(__name__)

CHUNK = 100_000
"""Work between two checks of the clock and of Ctrl-C: some hundredths of a second."""
COARSER = 2
"""Each search aims at a gap smaller by this factor than the last one."""
GROWTH = 1.2
"""All nodes are backed up after their number has grown by this factor."""
TAIL = 0.6
"""Share of the gap that may come from merged answers."""
SAME = 1e-9
"""Beliefs are equal if all entries differ by less."""
Gap = Annotated[float, Range(1e-9)]


@checks("solver")
@dataclass(frozen=True)
class Effort:
    """Limits of a search.

    Attributes:
        gap: stop when upper − lower is at most this.
        nodes: stop after this number of opened beliefs (the same on every machine).
        seconds: stop after this time (different on every machine).
        memory_gib: stop before more memory is needed.
    """

    gap: Gap = 1e-3
    nodes: Count = 1_000_000
    seconds: float = math.inf
    memory_gib: Positive = 8.0


@checks("solver")
@dataclass(frozen=True)
class Certified:
    """Args:
    gap: stop at this gap between the bounds of the optimum. nodes: maximum number of beliefs opened
    before the first step. seconds: time limit, with which results depend on the machine; None is no
    limit. decision_nodes: maximum number of beliefs opened for a decision at a belief that the
    search did not reach. memory_gib: maximum memory; larger tables are refused, and the search
    stops before it.
    """

    gap: Gap = 1e-3
    nodes: Count = 1_000_000
    seconds: Positive | None = None
    decision_nodes: Count = 50
    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation; see :class:`xplain.solvers.base.Solver`."""
        seconds = math.inf if self.seconds is None else self.seconds
        effort = Effort(self.gap, self.nodes, seconds, self.memory_gib)
        brief = Effort(self.gap, self.decision_nodes, math.inf, self.memory_gib)
        return CertifiedPolicy(search(problem, effort), brief)


@dataclass(frozen=True)
class Searched:
    """The result of a search from one belief.

    Attributes:
        process: the model.
        tables: the kernel's tables.
        kept: the messages of the tables, in order.
        store: the nodes.
    """

    process: Process
    tables: Tables
    kept: tuple[int, ...]
    store: Store

    @property
    def lower(self) -> float:
        """Lower bound on the root's optimal value."""
        return float(self.store.nodes["lower"][ROOT])

    @property
    def upper(self) -> float:
        """Upper bound on the root's optimal value."""
        return float(self.store.nodes["upper"][ROOT])

    def values(self, node: int = int(ROOT)) -> dict[Action, float]:
        """Certified lower bounds of the remaining actions at an opened node."""
        opened = self.store.nodes[node]
        first = int(opened["first_action"])
        actions = self.store.actions[first : first + int(opened["n_actions"])]
        names = [
            AskQuestion(~m) if m < 0 else give(expand(m, self.kept))
            for m in actions["messages"].tolist()
        ]
        return dict(zip(names, actions["lower"].tolist(), strict=True))


@dataclass(frozen=True)
class CertifiedPolicy:
    """Acts on certified lower bounds.

    Attributes:
        found: the search from the start.
        brief: the effort for a belief that it did not reach.
    """

    found: Searched
    brief: Effort

    @property
    def lower(self) -> float:
        """Lower bound on the optimal value."""
        return self.found.lower

    @property
    def upper(self) -> float:
        """Upper bound on the optimal value."""
        return self.found.upper

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """See :class:`xplain.solvers.base.Policy`."""
        return best_action(self.values(visible, belief))

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Certified lower bounds of the remaining actions. Among nodes with the same belief, the
        one with the best bound is used."""
        store = self.found.store
        given = before_step(self.found.process, visible.given)
        place = visible.step, compress(given, self.found.kept)
        nodes = self._opened.get(place, np.empty(0, np.int64))
        equal = np.abs(store.belief[nodes] - belief).max(axis=1, initial=0) < SAME
        equal &= (store.asked[nodes] == _words(self.found.tables, visible.asked)).all(axis=1)
        if equal.any():
            nodes = nodes[equal]
            return self.found.values(int(nodes[store.nodes["lower"][nodes].argmax()]))
        return _Search(self.found, visible, belief, self.brief).run().values()

    @cached_property
    def _opened(self) -> dict[tuple[int, int], NDArray[np.int64]]:
        """The opened nodes of each place."""
        nodes = self.found.store.nodes[: self.found.store.used[NODES]]
        opened: dict[tuple[int, int], list[int]] = {}
        for node in np.flatnonzero(nodes["first_action"] >= 0).tolist():
            place = int(nodes["step"][node]), int(nodes["given"][node])
            opened.setdefault(place, []).append(node)
        return {place: np.array(found) for place, found in opened.items()}


def search(
    problem: Problem, effort: Effort, told: Callable[[float], None] | None = None
) -> Searched:
    """Searches from the start of an explanation, within the effort. Ctrl-C ends it at any time.

    Args:
        problem: a problem of any kind.
        effort: limits of the search.
        told: receives the gap regularly.

    Raises:
        TooLargeError: the tables would need too much memory, or too many messages matter.
    """
    tell_when_compiling()
    process, tables, kept = _tables(problem, effort.memory_gib)
    nothing = Searched(process, tables, kept, _store(tables, process.n_states))
    return _Search(nothing, VisibleState(), process.start, effort, told).run()


class _Search:
    """A running search on given tables."""

    def __init__(
        self,
        known: Searched,
        visible: VisibleState,
        belief: NDArray[np.float64],
        effort: Effort,
        told: Callable[[float], None] | None = None,
    ) -> None:
        self.began, self.effort, self.told = time.perf_counter(), effort, told
        self.process, self.tables, self.kept = known.process, known.tables, known.kept
        self.missed = None if self.process.jump is None else True
        self.store, self.answers = _store(self.tables, len(belief)), 256
        given = compress(before_step(self.process, visible.given), self.kept)
        start = np.ascontiguousarray(belief, dtype=np.float64)
        words = _words(self.tables, visible.asked)
        kernel.make_root(self.tables, self.store, visible.step, given, start, words)
        self.backed_up = 1  # number of nodes at the last backup of all
        # Coarse before fine: a trial for the final gap would refine actions that are excluded later
        self.asked = max(float(effort.gap), self.gap / COARSER)

    @property
    def gap(self) -> float:
        """Upper − lower bound at the root."""
        root = self.store.nodes[ROOT]
        return float(root["upper"] - root["lower"])

    def run(self) -> Searched:
        """Searches until the effort is used, or the gap cannot become smaller."""
        effort, tail_gap = self.effort, self.effort.gap * TAIL / self.process.n_steps
        limits = effort.nodes, CHUNK
        while True:
            scratch = _scratch(self.tables, self.store, self.answers)
            where = self.tables, self.store, scratch, self.missed
            status = kernel.sample(*where, self.asked, tail_gap, *limits)
            if status == FULL and self._grow():
                continue
            if self.told is not None:
                self.told(self.gap)
            spent = self.store.used[OPENED] >= effort.nodes
            spent |= time.perf_counter() - self.began > effort.seconds
            if status == FULL or spent or (status == DONE and self.asked == effort.gap):
                break
            if status == DONE or self.store.used[NODES] > GROWTH * self.backed_up:
                self._back_up_all(scratch)
            if status == DONE:
                self.asked = max(float(effort.gap), min(self.asked, self.gap) / COARSER)
        if self.gap > effort.gap:
            self._back_up_all(scratch)
        return Searched(self.process, self.tables, self.kept, self.store)

    def _back_up_all(self, scratch: Scratch) -> None:
        """Backs up all nodes: those after a question first, then the earlier steps."""
        self.backed_up = int(self.store.used[NODES])
        nodes = self.store.nodes[: self.backed_up]
        asked = np.bitwise_count(self.store.asked[: self.backed_up]).sum(axis=1)
        order = np.lexsort((-asked.astype(np.int64), -nodes["step"]))
        least = kernel.NEWS * self.effort.gap
        kernel.back_up_all(self.tables, self.store, scratch, self.missed, order, least)

    def _grow(self) -> bool:
        """Allocates more room. False if this would need more memory than the effort allows."""
        if 2 * sum(array.nbytes for array in self.store) > self.effort.memory_gib * GIB:
            log.warning("the search stops at solver.memory_gib=%g", self.effort.memory_gib)
            return False
        self.store, self.answers = _grown(self.store), 2 * self.answers
        return True


def _words(tables: Tables, asked: int) -> NDArray[np.int64]:
    """A bitmask of questions in integers of WORD bits, the first questions first."""
    words = range(-(-len(tables.model.asked_answered) // WORD))
    return np.array([asked >> WORD * w & (1 << WORD) - 1 for w in words], np.int64)


def _tables(problem: Problem, memory_gib: float) -> tuple[Process, Tables, tuple[int, ...]]:
    """The process in the form of the search, and the messages that matter, cheapest first."""
    kept = weighable(problem, "certified")
    sets = 1 << len(kept) if problem.messages_land else 1 << 2 * problem.table.relevant.shape[1]
    size = 48 * (problem.n_steps + 1) * sets * problem.n_types
    check_memory("certified", size, memory_gib, "solver=qhr plans without tables")
    process = make_process(problem, dense=True)
    known = known_values(process, idle=True)
    kept = tuple(sorted(kept, key=lambda j: float(process.price[j])))
    if process.jump is None and kept:
        kept = tuple(process.own[0][process.own[0] != NONE].tolist())
    cells, states, steps = process.p.shape[1], process.n_states, process.n_steps
    by_type = 8 * states * (steps + 1) * cells <= memory_gib * GIB - size and process.jump is None
    plans = np.zeros((states + 1 if by_type else 1, steps + 1, cells))
    for k in reversed(range(steps)):
        later = expected_after_forgetting(process, plans[-1, k + 1])
        plans[-1, k] = process.discount * later - process.explain_cost[k]
    if by_type:
        price, discounts = process.price[list(kept)], (process.discount, process.message_discount)
        kernel.make_plans(known.value, known.explain, process.explain_cost, price, discounts, plans)
    prices, factors = set_prices(
        process, np.array([expand(c, kept) for c in range(1 << len(kept))])
    )
    worst = process.explain_cost.max(axis=1) + process.price.sum()
    questions, model = process.questions, search_model(process, known, searches=False)
    floor = np.append(-np.cumsum(worst[::-1])[::-1], 0.0) - questions.cost * questions.most
    model = model._replace(question_stride=questions.cells.stride[list(kept)])
    if process.jump is not None:
        model = model._replace(jump=process.jump[list(kept)])
    width = states if process.jump is None else 0
    tables = Tables(model, width, plans, floor - 1.0, prices, factors)
    return process, tables, kept


def _store(tables: Tables, states: int) -> Store:
    """An empty store with room for some thousand nodes."""
    nodes = 1 << 12 if states <= 64 else 1 << 10
    sets, words = len(tables.price), -(-len(tables.model.asked_answered) // WORD)
    actions, rows = max(4 * nodes, 2 * sets), 16
    visible = sets if tables.width else 1
    places = np.zeros((len(tables.model.explain_cost), visible), kernel.PLACE)
    places["row"] = kernel.NONE
    return Store(
        np.zeros(8, np.int64),
        np.zeros(nodes, kernel.NODE),
        np.zeros((nodes, states)),
        np.zeros((nodes, states)),
        np.zeros((nodes, words), np.int64),
        np.zeros(actions + len(tables.model.asked_answered), kernel.ACTION),
        np.zeros(4 * nodes, kernel.ANSWER),
        np.zeros((4 * nodes, states)),
        np.zeros(actions, np.int64),
        np.zeros((actions, states)),
        np.zeros((actions, states)),
        np.zeros((actions, states)),
        places,
        np.zeros((rows, 2), np.int64),
        np.zeros((rows, KEPT, states)),
        np.zeros((rows, KEPT, states)),
        np.zeros((rows, KEPT)),
        np.zeros((rows, KEPT), np.int64),
        np.zeros((rows, KEPT, 2), np.int64),
        np.full(4 * nodes, kernel.NONE, np.int32),
    )


GROWS = {
    NODES: ("nodes", "belief", "alpha", "asked"),
    ACTIONS: ("actions",),
    ANSWERS: ("answers", "likelihood"),
    SETS: ("sets", "base", "over", "under"),
    PLACES: ("published", "vector", "peak", "height", "by", "source"),
}
"""The arrays that grow with each counter."""


def _grown(store: Store) -> Store:
    """The same store, with twice the room for arrays that are half full."""
    arrays: dict[str, Any] = store._asdict()
    short = {k for k, names in GROWS.items() if 2 * store.used[k] >= len(arrays[names[0]])}
    for kind in short or set(GROWS):
        for name in GROWS[kind]:
            array = arrays[name]
            # New zeros use no memory until they are written.
            arrays[name] = np.zeros((2 * len(array), *array.shape[1:]), array.dtype)
            arrays[name][: store.used[kind]] = array[: store.used[kind]]
    arrays["table"] = np.full(4 * len(arrays["nodes"]), kernel.NONE, np.int32)
    store.used[HASHED] = 0
    return Store(**arrays)


def _scratch(tables: Tables, store: Store, answers: int) -> Scratch:
    states, words = store.belief.shape[1], store.asked.shape[1]
    levels = len(tables.model.explain_cost) + tables.model.most + 1
    return Scratch(
        np.empty((answers, states)),
        np.empty((answers, states)),
        np.empty(states),
        np.empty(states),
        np.empty(states),
        np.empty(words, np.int64),
        np.empty((len(tables.model.explain_cost) + 1, states)),
        np.empty((len(tables.price), states)),
        np.empty(len(tables.model.asked_answered)),
        np.empty(states, np.int64),
        np.empty(levels, np.int64),
        np.empty(levels, np.int64),
        np.empty(levels),
    )
