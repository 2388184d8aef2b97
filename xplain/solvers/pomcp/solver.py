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

import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import blake2b
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.explanation.belief import rounded
from xplain.explanation.problem import Problem
from xplain.numba_kernels import tell_when_compiling
from xplain.randomness import derived_seed
from xplain.solvers.base import Knowledge, Policy, best_question
from xplain.solvers.inquiry import look, make_room
from xplain.solvers.memory import check_memory, check_memory_gib
from xplain.solvers.model import best_set, one_by_one
from xplain.solvers.pomcp.kernel import simulate
from xplain.solvers.pomcp.search_model import (
    SearchModel,
    model_bytes,
    model_of,
    with_own_room,
)
from xplain.solvers.pomcp.tree import Options, Tree, slots_for, tree_bytes
from xplain.solvers.restriction import Restricted, RestrictedAsking, restricted
from xplain.solvers.rows import rows_at

CHUNK = 50_000
"""Simulations between two looks at Ctrl-C."""

# Positions are the kernel's numbers.
DEPTH_UNITS = ("steps", "actions")
LEAVES = ("max_of_mean", "mean_of_max")
ROLLOUTS = ("random", "qmdp", "silent")
BACKUPS = ("mean", "max")


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

    simulations: int = 6_000
    depth: int | None = 3
    depth_unit: Literal["actions", "steps"] = "actions"
    exploration: float = 8.0
    leaf: Literal["max_of_mean", "mean_of_max"] = "max_of_mean"
    rollout: Literal["random", "qmdp", "silent"] = "qmdp"
    backup: Literal["mean", "max"] = "max"
    trees: int = 1
    threads: int = 1
    memory_gib: float = 8.0
    knows: Knowledge = "types"

    def __post_init__(self) -> None:
        """Raises InputError for a setting out of its range."""
        for key in ("simulations", "trees", "threads"):
            if not _is_count(getattr(self, key)):
                raise InputError(f"solver.{key}", getattr(self, key), "an integer ≥ 1")
        if self.trees > self.simulations:
            raise InputError("solver.trees", self.trees, "at most solver.simulations")
        if self.depth is not None and not _is_count(self.depth):
            raise InputError("solver.depth", self.depth, "an integer ≥ 1, or null for no limit")
        if not (isinstance(self.exploration, int | float) and 0 <= self.exploration < np.inf):
            raise InputError("solver.exploration", self.exploration, "a number ≥ 0")
        for key, allowed in (
            ("depth_unit", DEPTH_UNITS),
            ("leaf", LEAVES),
            ("rollout", ROLLOUTS),
            ("backup", BACKUPS),
        ):
            if getattr(self, key) not in allowed:
                raise InputError(f"solver.{key}", getattr(self, key), " or ".join(allowed))
        check_memory_gib(self.memory_gib)

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation, as :class:`xplain.solvers.base.Solver` says."""
        tell_when_compiling()
        small, kept = restricted(problem)
        size = model_bytes(small) + self.trees * tree_bytes(
            small, -(-self.simulations // self.trees)
        )
        check_memory("pomcp", size, self.memory_gib, "search less, or qhr plans without tables")
        unit = max(
            problem.inexplicability_cost, problem.trade_off * problem.message_cost.max(initial=0)
        )
        options = Options(
            depth=self.depth or small.n_steps + small.n_messages + 1,
            message_depth=DEPTH_UNITS.index(self.depth_unit),
            exploration=float(self.exploration * unit),
            leaf=LEAVES.index(self.leaf),
            rollout=ROLLOUTS.index(self.rollout),
            backup=BACKUPS.index(self.backup),
        )
        search = Search(self, model_of(small), options, seed, slots_for(small))
        return (RestrictedAsking if small.questions else Restricted)(search, kept)


@dataclass(frozen=True)
class Search:
    """The policy: a search a decision, on a random stream of its own.

    Attributes:
        solver: its settings.
        model, options: as the kernel wants them.
        seed: of the run.
        slots: questions tried at a belief.
    """

    solver: POMCP
    model: SearchModel
    options: Options
    seed: int
    slots: int = 0
    _last: dict[tuple[object, ...], Mapping[int, float]] = field(default_factory=dict)

    def messages(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """The messages to give before the next *explain*, as
        :class:`xplain.solvers.base.Policy` says."""

        def best_action(shown: int) -> int:
            values = self._values(step, shown, belief, asked, shown == given)
            return best_set({action: value for action, value in values.items() if action >= 0})

        return one_by_one(best_action, given)

    def question(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """The question to ask, as :class:`xplain.solvers.base.Asks` says."""
        return best_question(self.values(step, given, belief, asked))

    def values(
        self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0
    ) -> Mapping[int, float]:
        """Estimated return of *explain* (0), of each message (its bit) and question (~q), where it
        was tried."""
        return self._values(step, given, belief, asked)

    def _values(
        self, step: int, given: int, belief: NDArray[np.float64], asked: int, may_ask: bool = True
    ) -> Mapping[int, float]:
        """As :meth:`values`; between the messages of a step nothing ``may_ask``. What is asked
        first is asked for messages next, so the last search is kept."""
        if self._known_is_exact and rounded(belief).max() == 1.0:
            return self._known_values(step, given, int(np.argmax(belief)))
        key = step, given, belief.tobytes(), asked, may_ask
        if key not in self._last:
            value, visits = self.search(step, given, belief, asked, may_ask)
            n = len(value) - 1 - self.slots
            room = make_room(self.model.reduced.inquiry, asked, self.slots)
            if self.slots:
                look(self.model.reduced.inquiry, step, given, np.ascontiguousarray(belief), room)
            names = [1 << j for j in range(n)] + [0] + [~q for q in room.found.tolist()]
            order = [n, *range(n), *range(n + 1, len(value))]
            self._last.clear()
            self._last[key] = {names[a]: float(value[a]) for a in order if visits[a]}
        return self._last[key]

    @property
    def _known_is_exact(self) -> bool:
        """Whether a search from a certain belief finds V* in the limit: it backs up maxima of what
        QMDP's rollouts, which are exact there, return. So V* is taken at once."""
        return self.solver.backup == "max" and self.solver.rollout == "qmdp"

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

    def search(
        self,
        step: int,
        given: int,
        belief: NDArray[np.float64],
        asked: int = 0,
        may_ask: bool = True,
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Value and visits of each action at the root, merged over the trees: [n + 1 + B] each,
        messages, *explain*, then the most telling questions. The random stream comes from what is
        to be decided, not from what was decided before."""
        belief = rounded(np.ascontiguousarray(belief, dtype=np.float64))
        digest = int.from_bytes(blake2b(belief.tobytes(), digest_size=8).digest(), "little")
        heard = (str(asked),) if asked else ()
        whole, rest = divmod(self.solver.simulations, self.solver.trees)
        stop = threading.Event()

        def grow(number: int) -> NDArray[Any]:
            seed = derived_seed(self.seed, "pomcp", step, given, digest, number, *heard)
            budget = whole + (number < rest)
            tree = Tree.rooted(
                budget,
                len(self.model.reduced.price),
                self.model.reduced.n_steps,
                step,
                given,
                belief,
                seed,
                make_room(self.model.reduced.inquiry, asked, self.slots),
                may_ask,
            )
            roots = _roots(1 << budget.bit_length())
            model = self.model if self.solver.threads == 1 else with_own_room(self.model)
            while budget > 0 and not stop.is_set():
                simulate(min(budget, CHUNK), model, self.options, tree, *roots)
                budget -= CHUNK
            return tree.root_edges()

        numbers = range(self.solver.trees)
        if self.solver.threads == 1 or self.solver.trees == 1:
            edges = np.stack([grow(number) for number in numbers])
        else:
            with ThreadPoolExecutor(self.solver.threads) as pool:
                try:
                    edges = np.stack(list(pool.map(grow, numbers)))
                except BaseException:
                    stop.set()  # Ctrl-C: the threads end with their present chunk
                    raise
        visits = edges["visits"].astype(np.int64)
        weighted = np.where(visits > 0, edges["value"], 0.0) * visits
        return weighted.sum(axis=0) / np.maximum(visits.sum(axis=0), 1), visits.sum(axis=0)


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


@lru_cache(maxsize=4)
def _roots(size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """sqrt(log v) and 1 / sqrt(v) for v = 0 … size (0 for 0), once a size."""
    v = np.maximum(np.arange(size + 1), 1)
    inverse = 1 / np.sqrt(v)
    inverse[0] = 0.0
    return np.sqrt(np.log(v)), inverse
