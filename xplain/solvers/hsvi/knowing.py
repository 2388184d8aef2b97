"""Certified bounds where messages may be missed or forgotten: HSVI over beliefs of what is known.

As :mod:`xplain.solvers.hsvi.search`, in Python, as a belief is no longer told by counts of labels:
a node is a belief before a step's messages, an action a set of messages and then *explain*, or a
question; its children are what may be answered. Above is QMDP's value, linear in the belief; below
the exact value of plans that heed no answer. The policy takes what is certified to be the best
where the bounds are close, and is QMDP elsewhere.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.actions import Action, VisibleState, give
from xplain.explanation.belief import answered, rounded, told
from xplain.explanation.message_sets import subsets
from xplain.solvers.answering import Answering, check_sets, every_told, kept_of
from xplain.solvers.base import best_action
from xplain.solvers.hsvi.deaf_plans import DeafPlans
from xplain.solvers.hsvi.explore import Effort
from xplain.solvers.knowing import make_knowing
from xplain.solvers.model import prices_of_sets
from xplain.solvers.reminding import Reminding
from xplain.solvers.restriction import actions_of

CLOSE = 0.02
"""Bounds so near, relative to 1 + their size, decide."""
FAINT = 1e-7
"""Answers less likely, all together, are not followed."""


@dataclass
class Choice:
    """A set of messages and *explain*, or ~q: its bounds, and what may follow."""

    name: int
    base: float
    later: float
    upper: float
    lower: float
    tail: tuple[float, float] = (0.0, 0.0)
    children: list[tuple[float, Node]] | None = None


@dataclass
class Node:
    """A belief [S] before the messages of step k, what was said so far as far as it matters, and
    the questions asked so far."""

    step: int
    given: int
    belief: NDArray[np.float64]
    asked: int
    upper: float
    lower: float
    actions: list[Choice] = field(default_factory=list)

    @property
    def gap(self) -> float:
        """Between its bounds."""
        return self.upper - self.lower


class Bounded:
    """A search for the optimum of a problem that tracks what users know.

    Raises:
        TooLargeError: more than MAX_SETS messages matter.
    """

    def __init__(self, policy: Reminding) -> None:
        self.policy, self.problem = policy, policy.problem
        self.model = make_knowing(policy)
        self.answers = Answering(self.problem)
        self.plans = DeafPlans(policy, self.model)
        self.kept = policy.kept
        check_sets("certified", self.kept)
        self.nodes: dict[tuple[int, int, bytes, int], Node] = {}

    def afresh(self) -> Bounded:
        """The same problem, nothing of which was searched."""
        other = copy(self)
        other.nodes = {}
        return other

    def node(self, step: int, given: int, belief: NDArray[np.float64], asked: int) -> Node:
        """The node of a belief; made where there is none."""
        key = self.key(step, given, belief, asked)
        if key not in self.nodes:
            belief, given = rounded(belief), key[1]
            upper, lower = self._between(step, given, belief)
            self.nodes[key] = Node(step, given, belief, asked, upper, lower)
        return self.nodes[key]

    def key(
        self, step: int, given: int, belief: NDArray[np.float64], asked: int
    ) -> tuple[int, int, bytes, int]:
        """What nodes are found by."""
        return step, 0, rounded(belief).tobytes(), asked

    def _between(self, step: int, given: int, weight: NDArray[np.float64]) -> tuple[float, float]:
        """Bounds of what a belief, or a part of one, is worth."""
        upper = float(weight @ self.policy.known(step, given))
        return upper, min(float((self.plans.worths(step, given) @ weight).max()), upper)

    def search(self, root: Node, effort: Effort) -> None:
        """Trials until the root's gap is closed or the effort is spent."""
        began, before = time.perf_counter(), len(self.nodes)
        while root.gap > effort.gap and len(self.nodes) - before < effort.nodes:
            if time.perf_counter() - began > effort.seconds:
                return
            if not self._trial(root, effort.gap):
                return  # rounding is all that is left

    def _trial(self, root: Node, gap: float) -> bool:
        """Walks from the root to where the gap is small enough, and back. Returns whether anything
        has changed."""
        path, node, allowed, moved = [], root, gap, False
        while True:
            if not node.actions:
                node.actions, moved = list(self._actions(node)), True
                self._settle(node)
            best = max(node.actions, key=lambda action: action.upper)
            path.append((node, best))
            if node.gap <= allowed or self._is_leaf(node, best):
                break
            if best.children is None:
                self._expand(node, best)
                moved = True
            widest = max(
                ((share * (child.gap - allowed), child) for share, child in best.children or ()),
                key=lambda pair: pair[0],
                default=(0.0, node),
            )
            if widest[0] <= 0:
                break
            allowed, node = allowed / max(best.later, 1e-12), widest[1]
        for node, action in reversed(path):
            before = node.upper, node.lower, action.upper
            self._back_up(action)
            self._settle(node)
            moved = moved or (node.upper, node.lower, action.upper) != before
        return moved

    def _is_leaf(self, node: Node, action: Choice) -> bool:
        return action.name >= 0 and node.step == self.problem.n_steps - 1

    def _actions(self, node: Node) -> Iterator[Choice]:
        """All that may be done, with bounds of one step."""
        model, problem, k = self.model, self.problem, node.step
        prices, free = problem.prices, list(self.kept)
        sets, heard = subsets(free), every_told(problem, node.belief, free)
        price, delay = prices_of_sets(sets, prices, model.message_discount)
        base = -price - delay * (heard @ self.policy.explain_cost(k))
        upper, lower = np.empty((2, len(sets)))
        givens = np.array([self._given(node, chosen) for chosen in sets.tolist()])
        for given in np.unique(givens).tolist():
            own = givens == given
            upper[own] = heard[own] @ self.policy.explained(k, given)
            worth = kept_of(problem, heard[own]) @ self.plans.worths(k + 1, given).T
            lower[own] = worth.max(axis=1)
        later = delay * model.discount
        upper, lower = delay * upper - price, base + later * lower
        columns = sets, base, later, upper, np.minimum(lower, upper)
        for one in zip(*(column.tolist() for column in columns), strict=True):
            yield Choice(*one)
        if problem.questions is not None:
            cost = problem.questions.limits.cost
            most, least = self._between(k, node.given, node.belief)
            for q in problem.questions.open(k, None, node.asked):
                yield Choice(~q, -cost, 1.0, most - cost, least - cost)

    def _given(self, node: Node, chosen: int) -> int:
        return 0

    def _expand(self, node: Node, action: Choice) -> None:
        problem, k = self.problem, node.step
        action.children = []
        if action.name < 0:
            q = ~action.name
            for answer, share in self.answers.to_question(q, node.belief):
                after = answered(problem, node.belief, 0, q, answer)
                child = self.node(k, node.given, after, node.asked | 1 << q)
                action.children.append((share, child))
            return
        found = self.answers.after(k, told(problem, node.belief, action.name), FAINT)
        assert found is not None
        weights, tail = found
        given = self._given(node, action.name)
        action.tail = self._between(k + 1, given, tail)
        for weight in weights:
            share = float(weight.sum())
            child = self.node(k + 1, given, weight / share, node.asked)
            action.children.append((share, child))

    def _back_up(self, action: Choice) -> None:
        if action.children is None:
            return
        upper = action.tail[0] + sum(share * child.upper for share, child in action.children)
        lower = action.tail[1] + sum(share * child.lower for share, child in action.children)
        action.upper = min(action.upper, action.base + action.later * upper)
        action.lower = min(max(action.lower, action.base + action.later * lower), action.upper)

    def _settle(self, node: Node) -> None:
        node.upper = min(node.upper, max(action.upper for action in node.actions))
        node.lower = max(node.lower, *(action.lower for action in node.actions))
        node.lower = min(node.lower, node.upper)


@dataclass(frozen=True)
class CertifiedKnowing:
    """Acts on certified bounds where they are close, as QMDP elsewhere.

    Attributes:
        bounded: the search from the start.
        root: where it began.
        brief: the effort for a decision that it did not come to, a search of its own: a decision
            does not depend on what was asked before.
    """

    bounded: Bounded
    root: Node
    brief: Effort
    _last: dict[tuple[int, int, bytes, int], Node] = field(default_factory=dict)

    @property
    def lower(self) -> float:
        """Lower bound on the optimal value."""
        return self.root.lower

    @property
    def upper(self) -> float:
        """Upper bound on the optimal value."""
        return self.root.upper

    def _decided(
        self, step: int, given: int, asked: int, belief: NDArray[np.float64]
    ) -> Node | None:
        """The node of a belief, if its bounds are close."""
        key = self.bounded.key(step, given, belief, asked)
        node = self.bounded.nodes.get(key) or self._last.get(key)
        if node is None or not node.actions:
            afresh = self.bounded.afresh()
            node = afresh.node(step, given, belief, asked)
            afresh.search(node, self.brief)
            self._last.clear()
            self._last[key] = node
        return node if node.gap <= CLOSE * (1 + abs(node.lower)) and node.actions else None

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """As :class:`xplain.solvers.base.Policy` says, some messages perhaps again."""
        if self._decided(*visible, belief) is None:
            return give(self.bounded.policy.messages(visible.step, visible.given, belief))
        return best_action(self.values(visible, belief))

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Certified lower bounds; QMDP's values where the bounds are not close."""
        node = self._decided(*visible, belief)
        if node is None:
            return actions_of(self.bounded.policy.values(visible.step, visible.given, belief))
        return actions_of({action.name: action.lower for action in node.actions})
