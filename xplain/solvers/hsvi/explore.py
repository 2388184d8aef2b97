"""HSVI's driver: sample, back up, stop. Growth of the memory and the clock are below."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from xplain.errors import Count, Positive, Range, checks
from xplain.solvers.count_lattice import make_answers
from xplain.solvers.hsvi.initial_bounds import BoundTables
from xplain.solvers.hsvi.search import (
    DONE,
    FULL,
    NEWS,
    TAIL,
    SearchLimits,
    Start,
    back_up_all,
    make_path,
    sample,
)
from xplain.solvers.hsvi.tree import (
    NODES,
    OPENED,
    ROOT,
    NodeStore,
    grown,
    make_store,
    store_bytes,
)
from xplain.solvers.inquiry import make_room
from xplain.solvers.memory import GIB

log = logging.getLogger(__name__)

CHUNK = 100_000
"""Work between two looks at the clock and at Ctrl-C: some hundredths of a second."""
COARSER = 2
"""A search asks for a gap this much smaller than the last that it closed."""
GROWTH = 1.2
"""All nodes are backed up once their number has grown by this factor."""
Gap = Annotated[float, Range(1e-9)]


@checks("solver")
@dataclass(frozen=True)
class Effort:
    """When a search may stop.

    Attributes:
        gap: once upper − lower is at most this.
        nodes: once so many beliefs were opened (the same on every machine).
        seconds: once so much time has passed (not the same on every machine).
        memory_gib: rather than take more.
    """

    gap: Gap = 1e-3
    nodes: Count = 1_000_000
    seconds: float = math.inf
    memory_gib: Positive = 8.0


@dataclass(frozen=True)
class Explored:
    """What a search found.

    Attributes:
        tables: those it ended with.
        store: its nodes.
    """

    tables: BoundTables
    store: NodeStore

    @property
    def lower(self) -> float:
        """Lower bound on the root's optimal value."""
        return float(self.store.nodes["lower"][ROOT])

    @property
    def upper(self) -> float:
        """Upper bound on the root's optimal value."""
        return float(self.store.nodes["upper"][ROOT])

    def values(self, node: int = int(ROOT)) -> dict[int, float]:
        """Certified lower bounds of the sets of messages not ruled out at an opened node."""
        opened = self.store.nodes[node]
        first = int(opened["first_action"])
        actions = self.store.actions[first : first + int(opened["n_actions"])]
        return dict(zip(actions["messages"].tolist(), actions["lower"].tolist(), strict=True))


def explore(
    tables: BoundTables,
    start: Start,
    effort: Effort,
    told: Callable[[float], None] | None = None,
) -> Explored:
    """Searches from a belief at (k, H), within the effort. Ctrl-C is heard throughout.

    ``told`` receives the gap now and then.
    """
    search = _Search(tables, start, effort)
    while True:
        search.sample()
        if told is not None:
            told(search.gap)
        if search.stops():
            break
        search.back_up()
    if search.gap > effort.gap:
        search.back_up_all()
    return Explored(search.tables, search.store)


class _Search:
    """A search under way."""

    def __init__(self, tables: BoundTables, start: Start, effort: Effort) -> None:
        self.began = time.perf_counter()
        self.effort = effort
        inquiry = tables.model.inquiry
        room = make_room(inquiry)
        self.tables = tables._replace(room=room)
        words = start.asked if start.asked.size else np.zeros(inquiry.words, np.int64)
        self.start = start._replace(belief=start.belief.copy(), asked=words)
        steps, _, types = tables.explain.shape
        self.store = make_store(tables)
        self.path = make_path(steps + min(inquiry.most, len(room.asked)))
        self.answers = make_answers(256, steps, types, inquiry.words)
        self.backed_up = 1  # nodes, when all were
        self.asked = math.inf
        self.sample()  # the root
        # Coarse before fine: a trial for the final gap would first refine what is ruled out later.
        self.asked = max(float(effort.gap), self.gap / COARSER)

    @property
    def gap(self) -> float:
        """Upper − lower bound at the root."""
        root = self.store.nodes[ROOT]
        return float(root["upper"] - root["lower"])

    def sample(self) -> None:
        """Trials, for a while."""
        tail_gap = self.effort.gap * TAIL / len(self.tables.explain)
        limits = SearchLimits(self.asked, tail_gap, self.effort.nodes, CHUNK)
        while True:
            self.status = sample(
                self.tables, self.store, self.start, limits, self.path, self.answers
            )
            if self.status != FULL or not self._grow():
                return

    def stops(self) -> bool:
        """Whether the effort is spent, or the gap closed as far as it will."""
        closed = self.status == DONE and self.asked == self.effort.gap
        spent = self.store.used[OPENED] >= self.effort.nodes or self._seconds > self.effort.seconds
        return self.status == FULL or closed or bool(spent)

    def back_up(self) -> None:
        """Backs up all nodes where that is due, and asks for a finer gap where this is closed."""
        if self.status == DONE or self.store.used[NODES] > GROWTH * self.backed_up:
            self.back_up_all()
        if self.status == DONE:
            self.asked = max(float(self.effort.gap), min(self.asked, self.gap) / COARSER)

    def back_up_all(self) -> None:
        """Backs up all nodes."""
        self.backed_up = int(self.store.used[NODES])
        nodes = self.store.nodes[: self.backed_up]
        order = np.argsort(-nodes["step"], kind="stable")
        if len(self.tables.room.asked):  # what follows a question has fewer types, or asked more
            left = (self.store.belief[: self.backed_up] > 0).sum(axis=1)
            order = np.lexsort((left, -nodes["asked"], -nodes["step"]))
        back_up_all(self.tables, self.store, order, NEWS * self.effort.gap)

    @property
    def _seconds(self) -> float:
        return time.perf_counter() - self.began

    def _grow(self) -> bool:
        """Makes room. False where that would take more memory than the effort."""
        if 2 * store_bytes(self.store) > self.effort.memory_gib * GIB:
            log.warning("the search stops at solver.memory_gib=%g", self.effort.memory_gib)
            return False
        self.store = grown(self.store)
        capacity, types = self.answers.weight.shape
        steps, words = len(self.tables.explain), self.tables.model.inquiry.words
        self.answers = make_answers(2 * capacity, steps, types, words)
        return True
