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
from typing import Annotated, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Count, InputError, Positive, Range, checks
from xplain.explanation.belief import rounded, told
from xplain.explanation.problem import Problem
from xplain.numba_kernels import tell_when_compiling
from xplain.solvers.base import Knowledge, Policy, best_question
from xplain.solvers.inquiry import Inquiry
from xplain.solvers.knowing import make_knowing
from xplain.solvers.memory import check_memory
from xplain.solvers.model import best_set, table_bytes
from xplain.solvers.pomcp.forest import Forest, Run
from xplain.solvers.pomcp.kernel import simulate
from xplain.solvers.pomcp.knowing import KnowingSearch, simulate_knowing
from xplain.solvers.pomcp.search_model import (
    SearchModel,
    model_bytes,
    model_of,
    with_own_room,
)
from xplain.solvers.pomcp.tree import Options, SearchRoot, slots_for, tree_bytes
from xplain.solvers.reminding import Reminding, known_bytes
from xplain.solvers.restriction import Restricted, RestrictedAsking, restricted
from xplain.solvers.rows import rows_at

# Positions are the kernel's numbers.
DepthUnit = Literal["steps", "actions"]
Leaf = Literal["max_of_mean", "mean_of_max"]
Rollout = Literal["random", "qmdp", "silent"]
Backup = Literal["mean", "max"]


@checks("solver")
@dataclass(frozen=True)
class POMCP:
    """Args:
    simulations: of one search; a decision of j messages takes j + 1 searches.
    depth: d ≥ 1, where simulations end; None for the end of the trace.
    depth_unit: ``actions`` (messages and *explain*) or ``steps`` (*explain* alone).
    exploration: c of UCB1, in units of the dearest single cost (a 0 label, or a message).
    leaf: at depth d, ``max_of_mean`` is max_a Σ_t b(t) Q_t(a), the paper's QMDP;
        ``mean_of_max`` is Σ_t b(t) max_a Q_t(a), larger and looser.
    rollout: ``random`` actions; ``qmdp``, which goes on with QMDP's action at the exact
        belief; or ``silent``, which says nothing more.
    backup: ``mean`` (the paper) or ``max``.
    trees: independent searches that share the simulations and are merged at the root. Results
        depend on it, and not on ``threads``.
    threads: that search the trees.
    memory_gib: most that tables and trees may take.
    """

    simulations: Count = 6_000
    depth: Count | None = 3
    depth_unit: DepthUnit = "actions"
    exploration: Annotated[float, Range(0)] = 8.0
    leaf: Leaf = "max_of_mean"
    rollout: Rollout = "qmdp"
    backup: Backup = "max"
    trees: Count = 1
    threads: Count = 1
    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def __post_init__(self) -> None:
        """Raises InputError for more trees than simulations."""
        if self.trees > self.simulations:
            raise InputError("solver.trees", self.trees, "at most solver.simulations")

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation, as :class:`xplain.solvers.base.Solver` says."""
        tell_when_compiling()
        if problem.tracks_knowledge:
            return self._plan_knowing(problem, seed)
        small, kept = restricted(problem)
        size = model_bytes(small) + self.trees * tree_bytes(
            small, -(-self.simulations // self.trees)
        )
        check_memory("pomcp", size, self.memory_gib, "search less, or qhr plans without tables")
        model, known_is_exact = model_of(small), self.backup == "max" and self.rollout == "qmdp"
        forest = self._forest(small, model.reduced.inquiry, seed)
        search = Search(small, self._options(small), forest, model, known_is_exact)
        return (RestrictedAsking if small.questions else Restricted)(search, kept)

    def _plan_knowing(self, problem: Problem, seed: int) -> Policy:
        """Where messages may be missed or forgotten."""
        trees = self.trees * tree_bytes(problem, -(-self.simulations // self.trees))
        size = 3 * table_bytes(problem) + known_bytes(problem) + trees
        check_memory("pomcp", size, self.memory_gib, "fewer messages or habits fit")
        model = KnowingSearch(make_knowing(Reminding(problem)))
        forest = self._forest(problem, model.reduced.inquiry, seed)
        return Remembering(problem, self._options(problem), forest, model)

    def _forest(self, problem: Problem, inquiry: Inquiry, seed: int) -> Forest:
        return Forest(
            self.simulations,
            self.trees,
            self.threads,
            problem.n_steps,
            problem.n_messages,
            slots_for(problem),
            inquiry,
            seed,
        )

    def _options(self, problem: Problem) -> Options:
        steps, messages = problem.n_steps, problem.n_messages
        unit = max(
            problem.inexplicability_cost, problem.trade_off * problem.message_cost.max(initial=0)
        )
        again = steps if problem.tracks_knowledge else 1
        return Options(
            depth=self.depth or steps + again * messages + 1,
            message_depth=get_args(DepthUnit).index(self.depth_unit),
            exploration=float(self.exploration * unit),
            leaf=get_args(Leaf).index(self.leaf),
            rollout=get_args(Rollout).index(self.rollout),
            backup=get_args(Backup).index(self.backup),
        )


@dataclass(frozen=True)
class Searching(ABC):
    """A policy that searches for each decision, on a random stream of its own.

    Attributes:
        problem: of the plan.
        options: as the kernel wants them.
        forest: how to search.
    """

    problem: Problem
    options: Options
    forest: Forest
    _last: dict[tuple[object, ...], Mapping[int, float]] = field(default_factory=dict, init=False)

    def messages(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """The messages to give before the next *explain*, as
        :class:`xplain.solvers.base.Policy` says; where they may be missed or forgotten, some of
        them perhaps again, each at most once a step."""
        said = 0
        while new := best_set(self._values(self._start(step, given, said, belief, asked))):
            said |= new
            belief = told(self.problem, belief, new)
        return said

    def question(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """The question to ask, as :class:`xplain.solvers.base.Asks` says."""
        return best_question(self.values(step, given, belief, asked))

    def values(
        self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0
    ) -> Mapping[int, float]:
        """Estimated return of *explain* (0), of each message (its bit) and question (~q), where it
        was tried, before anything is said at this step."""
        return self._values(self._start(step, given, 0, belief, asked))

    def _start(
        self, step: int, given: int, said: int, belief: NDArray[np.float64], asked: int
    ) -> SearchRoot:
        """A search's root once messages were ``said`` at this step. Where they may be missed or
        forgotten, what was said at earlier steps counts as far as it matters."""
        problem = self.problem
        if not problem.tracks_knowledge:
            return SearchRoot(step, given | said, belief, asked, not said)
        before = given if problem.levels else 0
        used = problem.again.exhausted(before, problem.n_messages)
        return SearchRoot(step, used | said, belief, asked, not said, before)

    def _values(self, start: SearchRoot) -> Mapping[int, float]:
        """What is searched for a question is searched for messages next, so the last values are
        kept."""
        key = *start[:2], start.belief.tobytes(), *start[3:]
        if key not in self._last:
            found = self.forest.values(start, self._run)
            self._last.clear()
            self._last[key] = found
        return self._last[key]

    @abstractmethod
    def _run(self) -> Run:
        """What a thread runs simulations with."""


@dataclass(frozen=True)
class Search(Searching):
    """Where messages are taken in.

    Attributes:
        model: as the kernel wants it.
        known_is_exact: whether a search from a certain belief finds V* in the limit: it backs up
            maxima of what QMDP's rollouts, which are exact there, return. So V* is taken at once.
    """

    model: SearchModel
    known_is_exact: bool

    def search(
        self, step: int, given: int, belief: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """As :meth:`xplain.solvers.pomcp.forest.Forest.merged`."""
        return self.forest.merged(SearchRoot(step, given, belief), self._run)

    def _values(self, start: SearchRoot) -> Mapping[int, float]:
        if self.known_is_exact and rounded(start.belief).max() == 1.0:
            return self._known_values(start.step, start.given, int(np.argmax(start.belief)))
        return super()._values(start)

    def _run(self) -> Run:
        model = self.model if self.forest.threads == 1 else with_own_room(self.model)
        return lambda count, tree, roots: simulate(count, model, self.options, tree, *roots)

    def _known_values(self, step: int, given: int, t: int) -> Mapping[int, float]:
        """Q*_t(k, H, a) of *explain* (0) and of each message (its bit) not given."""
        optimal, reduced = self.model.optimal, self.model.reduced

        def row(shown: int) -> int:
            return int(rows_at(reduced.rows, shown)[t])

        later = reduced.discount * optimal[step + 1, row(given), t]
        values = {0: float(later - self.model.explain_cost[row(given), step, t])}
        for j, price in enumerate(reduced.price):
            if not given >> j & 1:
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

    def _run(self) -> Run:
        labels = np.empty(self.problem.n_steps, np.bool_)
        return lambda count, tree, roots: simulate_knowing(
            count, self.model, self.options, tree, labels, *roots
        )
