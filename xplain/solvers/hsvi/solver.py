"""Certified: searches until the optimum is known to within a gap, and acts on what it found.

The bounds are of the optimal expected *discounted* return under the model. The policy takes, where
the search has been, the set of messages with the best certified lower bound; elsewhere (answers so
unlikely that the search left them coarse, users unlike the model) it searches afresh from there,
briefly. Its own exact value is :func:`xplain.solvers.evaluate.evaluate`'s to tell.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Count, Positive, checks
from xplain.explanation.actions import Action, VisibleState
from xplain.explanation.problem import Problem
from xplain.solvers.base import Knowledge, Policy, best_action
from xplain.solvers.hsvi.explore import Effort, Explored, Gap, explore
from xplain.solvers.hsvi.initial_bounds import BoundTables, make_tables, table_bytes
from xplain.solvers.hsvi.knowing import Bounded, CertifiedKnowing
from xplain.solvers.hsvi.search import Start
from xplain.solvers.hsvi.tree import NODES
from xplain.solvers.inquiry import words_of
from xplain.solvers.memory import check_memory
from xplain.solvers.model import table_bytes as model_bytes
from xplain.solvers.reminding import Reminding, known_bytes
from xplain.solvers.restriction import Restricted, actions_of, coupled

KNOWING_NODES = 20_000
"""Beliefs opened, at most, where messages may be missed or forgotten: a search in Python."""
SAME = 1e-9
"""Beliefs that differ by less in every entry are the same belief."""


@checks("solver")
@dataclass(frozen=True)
class Certified:
    """Args:
    gap: stop once the optimum is known this well.
    nodes: most beliefs to open before the first step.
    seconds: most time for it, results then depend on the machine; None is no limit.
    decision_nodes: most beliefs to open for a decision where the search has not been.
    memory_gib: most memory; tables beyond it are refused, the search stops before it.
    """

    gap: Gap = 1e-3
    nodes: Count = 1_000_000
    seconds: Positive | None = None
    decision_nodes: Count = 50
    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    @property
    def _effort(self) -> Effort:
        seconds = math.inf if self.seconds is None else self.seconds
        return Effort(self.gap, self.nodes, seconds, self.memory_gib)

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation, as :class:`xplain.solvers.base.Solver` says."""
        if not problem.messages_land:
            return self.plan_knowing(problem)
        small, kept = coupled(problem, "certified")
        small, tables = tables_within(small, self.memory_gib)
        found = explore(tables, Start(0, 0, small.prior), self._effort)
        brief = Effort(self.gap, self.decision_nodes, math.inf, self.memory_gib)
        return CertifiedPolicy(Searched(found, brief), kept)

    def plan_knowing(self, problem: Problem) -> CertifiedKnowing:
        """Where messages may be missed or forgotten."""
        size = (problem.n_types + 3) * model_bytes(problem) + known_bytes(problem)
        check_memory("certified", size, self.memory_gib, "solver=qmdp needs less")
        bounded = Bounded(Reminding(problem))
        root = bounded.node(0, 0, problem.start, 0)
        bounded.search(root, replace(self._effort, nodes=min(self.nodes, KNOWING_NODES)))
        brief = Effort(self.gap, self.decision_nodes, math.inf, self.memory_gib)
        return CertifiedKnowing(bounded, root, brief)


def tables_within(problem: Problem, memory_gib: float) -> tuple[Problem, BoundTables]:
    """The problem made dense, and the bounds' tables.

    Raises:
        TooLargeError: they take more.
    """
    instead = "solver=lookahead needs less, and solver=qhr no tables"
    check_memory("certified", table_bytes(problem), memory_gib, instead)
    dense = problem.dense()
    return dense, make_tables(dense)


@dataclass(frozen=True)
class CertifiedPolicy(Restricted):
    """A restricted policy that also tells the bounds at the root.

    Attributes:
        policy: the policy over the kept messages.
    """

    policy: Searched

    @property
    def lower(self) -> float:
        """Lower bound on the optimal value."""
        return self.policy.found.lower

    @property
    def upper(self) -> float:
        """Upper bound on the optimal value."""
        return self.policy.found.upper


@dataclass(frozen=True)
class Searched:
    """Acts on certified lower bounds.

    Attributes:
        found: by the search from the prior.
        brief: the effort for a belief not found there.
    """

    found: Explored
    brief: Effort

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """As :class:`xplain.solvers.base.Policy` says."""
        return best_action(self.values(visible, belief))

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Certified lower bounds by set of messages and question, of those not ruled out."""
        return actions_of(self._values(*visible, belief))

    def _values(
        self, step: int, given: int, asked: int, belief: NDArray[np.float64]
    ) -> Mapping[int, float]:
        words = words_of(asked, self.found.tables.model.inquiry.words)
        nodes = self._opened.get((step, given), np.empty(0, dtype=np.int64))
        store = self.found.store
        equal = np.abs(store.belief[nodes] - belief).max(axis=1, initial=0) < SAME
        equal &= (store.evidence[nodes, len(belief) :] == words).all(axis=1)
        if equal.any():
            nodes = nodes[equal]
            return self.found.values(int(nodes[store.nodes["lower"][nodes].argmax()]))
        start = Start(step, given, belief, words)
        return explore(self.found.tables, start, self.brief).values()

    @cached_property
    def _opened(self) -> dict[tuple[int, int], NDArray[np.int64]]:
        """The opened nodes at each (k, H)."""
        store = self.found.store
        nodes = store.nodes[: store.used[NODES]]
        opened = np.flatnonzero(nodes["first_action"] >= 0)
        place = nodes["step"][opened] << 32 | nodes["given"][opened]
        order = np.argsort(place, kind="stable")
        keys, starts = np.unique(place[order], return_index=True)
        groups = np.split(opened[order], starts[1:])
        return {
            (int(key) >> 32, int(key) & 0xFFFFFFFF): group
            for key, group in zip(keys, groups, strict=True)
        }
