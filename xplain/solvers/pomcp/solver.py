"""POMCP with d-step lookahead: Monte-Carlo tree search over histories, with exact beliefs.

Silver & Veness (2010) with the paper's two changes ("POMCP with d-step lookahead"): beliefs at
the nodes are exact, and a simulation goes to depth d only. There, a history already in the tree
is worth QMDP's value at its belief; a history not in the tree is added and rolled out, at any
depth. Actions are chosen by UCB1:

    search(b):  repeat
                    t ~ b; h ← root
                    while h is in the tree and above depth d:
                        a ← argmax_a V(ha) + c sqrt(log N(h) / N(ha));  h ← ha, and labels ~ t
                    R ← QMDP's value at b(h) if h was in the tree, else a rollout's return
                    add R to the means of the actions on the way

Rewards of *explain* are the exact expectations under a node's belief rather than the drawn
labels: the same mean with less noise. A decision searches, takes the action with the best value,
and searches anew after each message until that action is *explain*; so a decision taken up in the
middle goes on as it would have. A certain type is not searched for: its Q* is known, and is what
the default setting finds there.

``backup="max"`` is MaxUCT (Keller & Helmert 2013): a node is worth its best action, not the mean
over everything that was tried. It keeps exploration and first rollouts out of the values, which
the mean forgets only slowly.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Annotated, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Count, Positive, Range, checks
from xplain.explanation.actions import Action, AskQuestion, VisibleState, give
from xplain.explanation.belief import rounded, told
from xplain.explanation.problem import Problem
from xplain.numba_kernels import tell_when_compiling
from xplain.randomness import derived_seed
from xplain.solvers.base import Knowledge, Policy, best_action, messages_of
from xplain.solvers.inquiry import Inquiry, look, make_room
from xplain.solvers.knowing import make_knowing
from xplain.solvers.memory import check_memory
from xplain.solvers.model import table_bytes
from xplain.solvers.pomcp.kernel import MAX, simulate
from xplain.solvers.pomcp.knowing import KnowingSearch, simulate_knowing
from xplain.solvers.pomcp.search_model import CodedRooms, SearchModel, model_bytes, model_of
from xplain.solvers.pomcp.tree import (
    Options,
    Roots,
    SearchRoot,
    Tree,
    make_roots,
    slots_for,
    tree_bytes,
)
from xplain.solvers.reminding import Reminding, known_bytes
from xplain.solvers.restriction import Restricted, actions_of, restricted
from xplain.solvers.rows import rows_at

# Positions are the kernel's numbers.
DepthUnit = Literal["steps", "actions"]
Backup = Literal["mean", "max"]
CHUNK = 50_000
"""Simulations between two looks at Ctrl-C."""


@checks("solver")
@dataclass(frozen=True)
class POMCP:
    """Args:
    simulations: of one search, which tries each action at least once; a decision of j messages
        takes j + 1 searches.
    depth: d ≥ 1, where simulations end; None for the end of the trace.
    depth_unit: ``actions`` (messages and *explain*) or ``steps`` (*explain* alone).
    exploration: c of UCB1, in units of the dearest single cost (a 0 label, or a message).
    backup: ``mean`` (the paper) or ``max``.
    memory_gib: most that tables and the tree may take.
    """

    simulations: Count = 6_000
    depth: Count | None = 3
    depth_unit: DepthUnit = "actions"
    exploration: Annotated[float, Range(0)] = 8.0
    backup: Backup = "max"
    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation, as :class:`xplain.solvers.base.Solver` says."""
        tell_when_compiling()
        if not problem.messages_land:
            return self._plan_knowing(problem, seed)
        small, kept = restricted(problem)
        size = model_bytes(small) + tree_bytes(small, self.simulations)
        check_memory("pomcp", size, self.memory_gib, "search less, or qhr plans without tables")
        rooms = CodedRooms(model_of(small))
        search = Search(small, self._options(small), self.simulations, seed, rooms)
        return Restricted(search, kept)

    def _plan_knowing(self, problem: Problem, seed: int) -> Policy:
        """Where messages may be missed or forgotten."""
        tree = tree_bytes(problem, self.simulations)
        size = 3 * table_bytes(problem) + known_bytes(problem) + tree
        check_memory("pomcp", size, self.memory_gib, "fewer messages or habits fit")
        model = KnowingSearch(make_knowing(Reminding(problem)))
        return Remembering(problem, self._options(problem), self.simulations, seed, model)

    def _options(self, problem: Problem) -> Options:
        steps, messages = problem.n_steps, problem.n_messages
        unit = max(
            problem.inexplicability_cost, problem.trade_off * problem.message_cost.max(initial=0)
        )
        again = steps if not problem.messages_land else 1
        return Options(
            depth=self.depth or steps + again * messages + 1,
            message_depth=get_args(DepthUnit).index(self.depth_unit),
            exploration=float(self.exploration * unit),
            backup=get_args(Backup).index(self.backup),
        )


@dataclass(frozen=True)
class Searching(ABC):
    """A policy that searches for each decision, on a random stream of its own.

    Attributes:
        problem: of the plan.
        options: as the kernel wants them.
        simulations: of a search.
        seed: of the run.
    """

    problem: Problem
    options: Options
    simulations: int
    seed: int
    _last: dict[tuple[object, ...], Mapping[int, float]] = field(default_factory=dict, init=False)

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """As :class:`xplain.solvers.base.Policy` says; where messages may be missed or forgotten,
        some of them perhaps again, each at most once a step."""
        said = 0
        while True:
            start = self._start(visible.step, visible.given, said, belief, visible.asked)
            action = best_action(actions_of(self._values(start)))
            if isinstance(action, AskQuestion):
                return action
            new = messages_of(action)
            if not new:
                return give(said)
            said |= new
            belief = told(self.problem, belief, new)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Estimated return of *explain*, of each message and question, where it was tried, before
        anything is said at this step."""
        start = self._start(visible.step, visible.given, 0, belief, visible.asked)
        return actions_of(self._values(start))

    def _start(
        self, step: int, given: int, said: int, belief: NDArray[np.float64], asked: int
    ) -> SearchRoot:
        """A search's root once messages were ``said`` at this step. Where they may be missed or
        forgotten, what was said at earlier steps counts as far as it matters."""
        problem = self.problem
        if problem.messages_land:
            return SearchRoot(step, given | said, belief, asked, not said)
        return SearchRoot(step, said, belief, asked, not said, 0)

    def _values(self, start: SearchRoot) -> Mapping[int, float]:
        """What is searched for a question is searched for messages next, so the last values are
        kept."""
        key = *start[:2], start.belief.tobytes(), *start[3:]
        found = self._last.get(key)
        if found is None:
            found = self._named(start, *self.search(start))
            self._last.clear()
            self._last[key] = found
        return found

    def _named(
        self, start: SearchRoot, value: NDArray[np.float64], visits: NDArray[np.int64]
    ) -> dict[int, float]:
        """Values of *explain* (0), of each message (its bit) and question (~q) that was tried."""
        room = make_room(self._inquiry, start.asked, slots_for(self.problem))
        if len(room.found):
            look(self._inquiry, start.step, start.given, _exact(start.belief), room)
        n = self.problem.n_messages
        names = [1 << j for j in range(n)] + [0] + [~q for q in room.found.tolist()]
        order = [n, *range(n), *range(n + 1, len(value))]
        return {names[a]: float(value[a]) for a in order if visits[a]}

    def search(self, start: SearchRoot) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Value and visits of each action at the root, [n + 1 + B] each: messages, *explain*, then
        the most telling questions. The random stream comes from what is to be decided, not from
        what was decided before."""
        start = start._replace(belief=_exact(start.belief))
        digest = int.from_bytes(blake2b(start.belief.tobytes(), digest_size=8).digest(), "little")
        asked = (str(start.asked),) if start.asked or start.before else ()
        before = (str(start.before),) if start.before else ()
        names = "pomcp", start.step, start.given, digest, 0, *asked, *before
        problem, slots = self.problem, slots_for(self.problem)
        left = budget = max(self.simulations, problem.n_messages + 1 + slots)
        tree = Tree.rooted(
            budget,
            problem.n_messages,
            problem.n_steps,
            start,
            derived_seed(self.seed, *names),
            make_room(self._inquiry, start.asked, slots),
        )
        roots = make_roots(1 << budget.bit_length())
        while left > 0:
            self._simulate(min(left, CHUNK), tree, roots)
            left -= CHUNK
        edges = tree.root_edges()
        return np.where(edges["visits"] > 0, edges["value"], 0.0), edges["visits"].astype(np.int64)

    @property
    @abstractmethod
    def _inquiry(self) -> Inquiry:
        """The questions."""

    @abstractmethod
    def _simulate(self, count: int, tree: Tree, roots: Roots) -> None:
        """Runs so many simulations in a tree."""


@dataclass(frozen=True)
class Search(Searching):
    """Where messages are taken in.

    Attributes:
        rooms: the model as the kernel wants it, for each search that runs at the same time.
    """

    rooms: CodedRooms

    @property
    def model(self) -> SearchModel:
        """The model as the kernel wants it."""
        return self.rooms.model

    def _values(self, start: SearchRoot) -> Mapping[int, float]:
        """A search from a certain belief that backs up maxima finds V* in the limit, as QMDP's
        rollouts are exact there. So V* is taken at once."""
        if self.options.backup == MAX and rounded(start.belief).max() == 1.0:
            return self._known_values(start.step, start.given, int(np.argmax(start.belief)))
        return super()._values(start)

    @property
    def _inquiry(self) -> Inquiry:
        return self.model.reduced.inquiry

    def _simulate(self, count: int, tree: Tree, roots: Roots) -> None:
        with self.rooms.borrow() as model:
            simulate(count, model, self.options, tree, *roots)

    def _known_values(self, step: int, given: int, t: int) -> Mapping[int, float]:
        """Q*_t(k, H, a) of *explain* (0) and of each message (its bit) not given that matters."""
        optimal, reduced = self.model.optimal, self.model.reduced

        def row(shown: int) -> int:
            return int(rows_at(reduced.rows, shown)[t])

        later = reduced.discount * optimal[step + 1, row(given), t]
        values = {0: float(later - self.model.explain_cost[row(given), step, t])}
        for j, price in enumerate(reduced.price):
            if reduced.rows.relevant[t] & ~given & 1 << j:
                said = optimal[step, row(given | 1 << j), t]
                values[1 << j] = float(reduced.message_discount * said - price)
        return values


@dataclass(frozen=True)
class Remembering(Searching):
    """Where messages may be missed or forgotten, and said again.

    Attributes:
        model: as the kernel wants it.
    """

    model: KnowingSearch

    @property
    def _inquiry(self) -> Inquiry:
        return self.model.reduced.inquiry

    def _simulate(self, count: int, tree: Tree, roots: Roots) -> None:
        labels = np.empty(self.problem.n_steps, np.bool_)
        simulate_knowing(count, self.model, self.options, tree, labels, *roots)


def _exact(belief: NDArray[np.float64]) -> NDArray[np.float64]:
    return rounded(np.ascontiguousarray(belief, dtype=np.float64))
