"""The certified solver: a search that bounds the optimal value from both sides, and its policy.

The search is HSVI (Smith & Simmons 2004) on a finite graph of beliefs. Each visited belief has an
upper and a lower bound of the optimal value. Trials from the start improve the bounds until the gap
at the start is small enough. Upper bounds come from the values of known states, from upper bounds
at other beliefs (sawtooth), and from the best action. Lower bounds come from plans that ignore
answers, from alpha vectors of other beliefs, and from the best action. Beliefs after unlikely
answers keep wide bounds, and the least likely answers are treated as one.

The bounds are bounds of the optimal expected *discounted* return under the model. To *open* a
belief is to list the actions that may be optimal there. At an opened belief the policy takes the
action with the best lower bound. At other beliefs (after unlikely answers, or with users unlike the
model) the policy runs a short search from there.
"""

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
"""The work between two checks of the time and of Ctrl-C: a few hundredths of a second."""
COARSER = 2
"""Each time that the search reaches its gap, the next gap is smaller by this factor."""
GROWTH = 1.2
"""All nodes are backed up after their number has grown by this factor."""
TAIL = 0.6
"""The share of the gap that may come from the answers that are treated as one."""
SAME = 1e-9
"""Beliefs whose entries all differ by less than this are the same."""
NOTHING = np.empty(0, np.int64)
Gap = Annotated[float, Range(1e-9)]


@checks("solver")
@dataclass(frozen=True)
class Effort:
    """The limits of a search: it stops at the first one that it reaches.

    Attributes:
        gap: the gap, upper − lower, that is small enough.
        nodes: the largest number of beliefs to open (the result is the same on every machine).
        seconds: the largest time (the result depends on the machine).
        memory_gib: the largest memory.
    """

    gap: Gap = 1e-3
    nodes: Count = 1_000_000
    seconds: float = math.inf
    memory_gib: Positive = 8.0


@checks("solver")
@dataclass(frozen=True)
class Certified:
    """Plans with HSVI.

    Args:
        gap: the gap between upper and lower bound at which the search stops.
        nodes: the largest number of beliefs to open before the first step.
        seconds: the largest time before the first step; results then depend on the machine. None is
            no limit.
        decision_nodes: the largest number of beliefs to open for a decision at a belief that the
            search has not opened.
        memory_gib: the memory limit. Larger tables are refused, and the search stops at this limit.
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
class SearchResult:
    """The result of a search from one belief.

    Attributes:
        process: the model.
        tables: the model in the kernel's layout.
        kept: the messages that the tables contain; ``kept[i]`` is bit i of their message sets.
        store: the visited nodes with their bounds and actions; node 0 is the root.
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
        """Returns certified lower bounds of the actions that may be optimal at an opened node."""
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
    """Takes the action with the largest certified lower bound.

    Attributes:
        found: the result of the search from the start.
        brief: the effort of the search for a decision at another belief.
    """

    found: SearchResult
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
        """Chooses the action with the largest certified lower bound."""
        return best_action(self.values(visible, belief))

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Returns the certified lower bounds of the actions that may be optimal. If several opened
        nodes have this belief, the one with the best lower bound is used."""
        store = self.found.store
        given = before_step(self.found.process, visible.given)
        place = visible.step, compress(given, self.found.kept)
        nodes = self._opened.get(place, np.empty(0, np.int64))
        equal = np.abs(store.belief[nodes] - belief).max(axis=1, initial=0) < SAME
        equal &= (store.asked[nodes] == _split_words(self.found.tables, visible.asked)).all(axis=1)
        if equal.any():
            nodes = nodes[equal]
            return self.found.values(int(nodes[store.nodes["lower"][nodes].argmax()]))
        return _Search(self.found, visible, belief, self.brief).run().values()

    @cached_property
    def _opened(self) -> dict[tuple[int, int], NDArray[np.int64]]:
        """The nodes that the search has opened, by (k, v)."""
        nodes = self.found.store.nodes[: self.found.store.used[NODES]]
        opened: dict[tuple[int, int], list[int]] = {}
        for node in np.flatnonzero(nodes["first_action"] >= 0).tolist():
            place = int(nodes["step"][node]), int(nodes["given"][node])
            opened.setdefault(place, []).append(node)
        return {place: np.array(found) for place, found in opened.items()}


def search(
    problem: Problem, effort: Effort, told: Callable[[float], None] | None = None
) -> SearchResult:
    """Searches from the start of an explanation, within the effort. Ctrl-C stops the search at any
    time.

    Args:
        problem: a problem of any kind.
        effort: the limits of the search.
        told: is called with the gap from time to time.

    Raises:
        TooLargeError: the tables would need too much memory, or too many messages matter.
    """
    process, tables, kept = _make_tables(problem, effort.memory_gib)
    nothing = SearchResult(process, tables, kept, _allocate_store(tables, process.n_states))
    return _Search(nothing, VisibleState(), process.start, effort, told).run()


class _Search:
    """A running search, with the model and the tables of an earlier result."""

    def __init__(
        self,
        known: SearchResult,
        visible: VisibleState,
        belief: NDArray[np.float64],
        effort: Effort,
        told: Callable[[float], None] | None = None,
    ) -> None:
        self.began, self.effort, self.told = time.perf_counter(), effort, told
        self.process, self.tables, self.kept = known.process, known.tables, known.kept
        self.store, self.answers = _allocate_store(self.tables, len(belief)), 256
        self._make_root(visible, belief)
        self.backed_up = 1  # number of nodes when all were backed up last
        # The first gap is large: trials for the final gap would refine actions excluded later.
        self.asked = max(float(effort.gap), self.gap / COARSER)

    def _make_root(self, visible: VisibleState, belief: NDArray[np.float64]) -> None:
        """Makes the root. Its upper bound is the value of known states, its lower bound the value
        of the best plan."""
        step, given = visible.step, compress(before_step(self.process, visible.given), self.kept)
        cells = given * self.tables.width + np.arange(len(belief))
        plans = self.tables.plans[:, step, cells]
        values = plans @ belief
        upper = self.tables.model.value[step, cells] @ belief
        lower = min(values.max(), upper)
        self.store.nodes[ROOT] = upper, lower, step, given, kernel.NONE, 0, kernel.SILENCE
        self.store.belief[ROOT], self.store.alpha[ROOT] = belief, plans[values.argmax()]
        self.store.asked[ROOT] = _split_words(self.tables, visible.asked)
        self.store.used[NODES] = 1

    @property
    def gap(self) -> float:
        """Upper − lower bound at the root."""
        root = self.store.nodes[ROOT]
        return float(root["upper"] - root["lower"])

    def run(self) -> SearchResult:
        """Searches until a limit is reached, or the gap cannot get smaller."""
        effort, tail_gap = self.effort, self.effort.gap * TAIL / self.process.n_steps
        limits = effort.nodes, CHUNK
        while True:
            scratch = _allocate_scratch(self.tables, self.store, self.answers)
            where = self.tables, self.store, scratch
            status = kernel.sample(*where, NOTHING, 0.0, self.asked, tail_gap, *limits)
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
        return SearchResult(self.process, self.tables, self.kept, self.store)

    def _back_up_all(self, scratch: Scratch) -> None:
        """Backs up all nodes: later steps first, and within a step the nodes after more questions
        first."""
        self.backed_up = int(self.store.used[NODES])
        nodes = self.store.nodes[: self.backed_up]
        asked = np.bitwise_count(self.store.asked[: self.backed_up]).sum(axis=1)
        order = np.lexsort((-asked.astype(np.int64), -nodes["step"]))
        where, least = (self.tables, self.store, scratch), kernel.NEWS * self.effort.gap
        kernel.sample(*where, order, least, math.inf, 0.0, 0, 0)

    def _grow(self) -> bool:
        """Enlarges the store. Returns False if that would take more memory than allowed."""
        if 2 * sum(array.nbytes for array in self.store) > self.effort.memory_gib * GIB:
            log.warning("the search stops at solver.memory_gib=%g", self.effort.memory_gib)
            return False
        self.store, self.answers = _enlarge(self.store), 2 * self.answers
        return True


def _split_words(tables: Tables, asked: int) -> NDArray[np.int64]:
    """Splits a bitmask of questions into integers of WORD bits. The first integer has the questions
    with the smallest numbers."""
    words = range(-(-len(tables.model.asked_answered) // WORD))
    return np.array([asked >> WORD * w & (1 << WORD) - 1 for w in words], np.int64)


def _make_tables(problem: Problem, memory_gib: float) -> tuple[Process, Tables, tuple[int, ...]]:
    """Makes the model for a search.

    Returns:
        The process, its tables for the kernel, and the messages that the tables contain, by
        ascending price.
    """
    kept = weighable(problem, "certified")
    sets = 1 << len(kept) if problem.messages_land else 1 << 2 * problem.table.relevant.shape[1]
    size = 48 * (problem.n_steps + 1) * sets * problem.n_types
    check_memory("certified", size, memory_gib, "solver=qhr plans without tables")
    process = make_process(problem, dense=True)
    known = known_values(process, without_effect=True)
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


def _allocate_store(tables: Tables, states: int) -> Store:
    """Allocates an empty store for a few thousand nodes."""
    nodes = 1 << 12 if states <= 64 else 1 << 10
    sets, words = len(tables.price), -(-len(tables.model.asked_answered) // WORD)
    actions, rows = max(4 * nodes, 2 * sets), 16
    visible = sets if tables.width else 1
    places = np.zeros((len(tables.model.explain_cost), visible), kernel.PLACE)
    places["row"] = kernel.NONE
    return Store(
        np.zeros(8, np.int64),
        np.empty(nodes, kernel.NODE),
        np.empty((nodes, states)),
        np.empty((nodes, states)),
        np.empty((nodes, words), np.int64),
        np.empty(actions + len(tables.model.asked_answered), kernel.ACTION),
        np.empty(4 * nodes, kernel.ANSWER),
        np.empty((4 * nodes, states)),
        np.empty(actions, np.int64),
        np.empty((actions, states)),
        np.empty((actions, states)),
        np.empty((actions, states)),
        places,
        np.zeros((rows, 2), np.int64),
        np.empty((rows, KEPT, states)),
        np.empty((rows, KEPT, states)),
        np.empty((rows, KEPT)),
        np.empty((rows, KEPT), np.int64),
        np.empty((rows, KEPT, 2), np.int64),
        np.full(4 * nodes, kernel.NONE, np.int32),
    )


GROWS = {
    NODES: ("nodes", "belief", "alpha", "asked"),
    ACTIONS: ("actions",),
    ANSWERS: ("answers", "likelihood"),
    SETS: ("sets", "base", "over", "under"),
    PLACES: ("published", "vector", "peak", "height", "by", "source"),
}
"""The arrays that grow together, by their position in ``store.used``."""


def _enlarge(store: Store) -> Store:
    """Doubles the arrays that are at least half full, or all arrays if none is. Returns the new
    store."""
    arrays: dict[str, Any] = store._asdict()
    short = {k for k, names in GROWS.items() if 2 * store.used[k] >= len(arrays[names[0]])}
    for kind in short or set(GROWS):
        for name in GROWS[kind]:
            array = arrays[name]
            # Only the numbers of published bounds must be 0 at first.
            make = np.zeros if name == "published" else np.empty
            arrays[name] = make((2 * len(array), *array.shape[1:]), array.dtype)
            arrays[name][: store.used[kind]] = array[: store.used[kind]]
    arrays["table"] = np.full(4 * len(arrays["nodes"]), kernel.NONE, np.int32)
    store.used[HASHED] = 0
    return Store(**arrays)


def _allocate_scratch(tables: Tables, store: Store, answers: int) -> Scratch:
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
