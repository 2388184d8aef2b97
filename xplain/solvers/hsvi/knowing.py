"""Certified bounds where messages may be missed or forgotten: HSVI over beliefs of what is known.

As :mod:`xplain.solvers.hsvi.search`, in Python, as a belief is no longer told by counts of labels:
a node is a belief before a step's messages, an action a set of messages and then *explain*, or a
question; its children are what may be answered. Above is QMDP's value, linear in the belief; below
the exact value of plans that heed no answer. The policy takes what is certified to be the best
where the bounds are close, and is QMDP elsewhere. Where messages discount, nothing is said as a
mere delay: bounds are of plans that do not.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.errors import TooLargeError
from xplain.explanation import knowledge
from xplain.explanation.belief import answered, rounded, told
from xplain.explanation.message_sets import indices, subsets
from xplain.numba_kernels import lean_kernel
from xplain.solvers.base import best_question
from xplain.solvers.count_lattice import Answers, branch, make_answers
from xplain.solvers.hsvi.explore import Effort
from xplain.solvers.knowing import make_knowing
from xplain.solvers.model import best_set
from xplain.solvers.reminding import Reminding
from xplain.solvers.rows import Rows

MAX_SETS = 10
"""Messages whose sets are weighed together, at most."""
CLOSE = 0.02
"""Bounds so near, relative to 1 + their size, decide."""
FAINT = 1e-7
"""Answers less likely, all together, are not followed."""


@dataclass
class Action:
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
    """A belief [S] before the messages of step k, and the questions asked so far."""

    step: int
    belief: NDArray[np.float64]
    asked: int
    upper: float
    lower: float
    actions: list[Action] = field(default_factory=list)

    @property
    def gap(self) -> float:
        """Between its bounds."""
        return self.upper - self.lower


class Lattice(NamedTuple):
    """What :func:`~xplain.solvers.count_lattice.branch` reads: states in the place of types."""

    answered: NDArray[np.float64]
    rows: Rows


@lean_kernel
def _answers(lattice, step, weight, evidence, negligible, found):  # type: ignore[no-untyped-def]
    return branch(lattice, step, 0, weight, evidence, negligible, found)


class Bounded:
    """A search for the optimum of a problem that tracks what users know.

    Raises:
        TooLargeError: more than MAX_SETS messages matter.
    """

    def __init__(self, policy: Reminding) -> None:
        self.policy, self.problem = policy, policy.problem
        self.model = make_knowing(policy)
        self.kept = self.problem.messages_with_effect()
        if len(self.kept) > MAX_SETS:
            raise TooLargeError(
                f"certified weighs sets of messages together: {len(self.kept)} matter on this "
                f"trace, at most {MAX_SETS}; solver=qmdp or pomcp says one after the other"
            )
        steps, states = self.model.answered.shape
        none = np.zeros((0, 0), np.int64)
        rows = Rows(
            np.zeros(states, np.int64),
            none,
            np.zeros((1, 1, states), np.int64),
            *(0, np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 0, 0))),
        )
        self._lattice = Lattice(self.model.answered[:, None], rows)
        self._room: Answers = make_answers(1 << 10, steps, states)
        self.nodes: dict[tuple[int, bytes, int], Node] = {}

    def afresh(self) -> Bounded:
        """The same problem, nothing of which was searched."""
        other = copy(self)
        other.nodes = {}
        return other

    def node(self, step: int, belief: NDArray[np.float64], asked: int) -> Node:
        """The node of a belief; made where there is none."""
        belief = rounded(belief)
        key = step, belief.tobytes(), asked
        if key not in self.nodes:
            upper, lower = self._between(step, belief)
            self.nodes[key] = Node(step, belief, asked, upper, lower)
        return self.nodes[key]

    def _between(self, step: int, weight: NDArray[np.float64]) -> tuple[float, float]:
        """Bounds of what a belief, or a part of one, is worth."""
        upper = float(weight @ self.model.optimal[step])
        return upper, min(float((self._plans[step] @ weight).max()), upper)

    @cached_property
    def _plans(self) -> NDArray[np.float64]:
        """[m + 1, U, S] what plans that heed no answer are worth: silence, and for each type what
        QMDP would say to it if it knew the type alone."""
        model, problem = self.model, self.problem
        steps, states = model.explain.shape
        types = problem.n_types
        found = np.zeros((steps + 1, types + 1, states))
        schedules = [self._schedule(t) for t in range(types)] + [[0] * steps]
        for u, schedule in enumerate(schedules):
            for k in reversed(range(steps)):
                later = knowledge.expected_after_forgetting(
                    found[k + 1, u].reshape(-1, types), problem.table.relevant, problem.forget
                )
                value = model.discount * later - model.explain_cost[k].reshape(-1, types)
                for j in sorted(indices(schedule[k]), key=lambda j: -model.price[j]):
                    landed = knowledge.with_message(value, problem.table.relevant, j)
                    heard = problem.accept * landed + (1 - problem.accept) * value
                    value = model.message_discount * heard - model.price[j]
                found[k, u] = value.ravel()
        return found

    def _schedule(self, t: int) -> list[int]:
        """What QMDP says to a user of a type, step by step, if nothing is heard of them."""
        problem, said = self.problem, []
        alone = np.where(np.arange(problem.n_types) == t, 1.0, 0.0)
        belief = np.zeros((self.model.optimal.shape[1] // problem.n_types, problem.n_types))
        belief[0] = alone
        for k in range(problem.n_steps):
            said.append(self.policy.messages(k, 0, belief.ravel()))
            belief = told(problem, belief.ravel(), said[-1]).reshape(belief.shape)
            belief = knowledge.forget(belief, problem.table.relevant, problem.forget)
        return said

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

    def _is_leaf(self, node: Node, action: Action) -> bool:
        return action.name >= 0 and node.step == self.problem.n_steps - 1

    def _actions(self, node: Node) -> Iterator[Action]:
        """All that may be done, with bounds of one step."""
        model, problem, k = self.model, self.problem, node.step
        heard = {0: node.belief}
        for chosen in subsets(self.kept).tolist():
            if chosen:
                last = 1 << chosen.bit_length() - 1
                heard[chosen] = told(problem, heard[chosen ^ last], last)
            price, delay = 0.0, 1.0
            for j in sorted(indices(chosen), key=lambda j: model.price[j]):
                price += delay * model.price[j]
                delay *= model.message_discount
            belief = heard[chosen]
            base = -price - delay * float(belief @ model.explain_cost[k])
            upper = -price + delay * float(belief @ model.explain[k])
            later = delay * model.discount
            lower = base + later * self._between(k + 1, self._kept_of(belief))[1]
            yield Action(chosen, base, later, upper, min(lower, upper))
        if problem.questions is not None:
            cost = problem.questions.limits.cost
            upper, lower = self._between(k, node.belief)
            for q in problem.questions.open(k, None, node.asked):
                yield Action(~q, -cost, 1.0, upper - cost, lower - cost)

    def _kept_of(self, belief: NDArray[np.float64]) -> NDArray[np.float64]:
        """[..., S] what is left of what is known after a step."""
        problem = self.problem
        rows = belief.reshape(-1, problem.n_types)
        return knowledge.forget(rows, problem.table.relevant, problem.forget).ravel()

    def _expand(self, node: Node, action: Action) -> None:
        problem, k = self.problem, node.step
        action.children = []
        if action.name < 0:
            q = ~action.name
            assert problem.questions is not None
            yes = problem.questions.table.answered[q].ravel()
            for answer, p in ((1, yes), (0, 1 - yes)):
                share = float(node.belief @ p)
                if share > 0:
                    after = answered(problem, node.belief, 0, q, answer)
                    child = self.node(k, after, node.asked | 1 << q)
                    action.children.append((share, child))
            return
        belief = told(problem, node.belief, action.name)
        evidence = np.zeros(len(belief), np.int64)
        while (count := _answers(self._lattice, k, belief, evidence, FAINT, self._room)) < 0:
            self._room = make_answers(
                2 * len(self._room.weight), *self._lattice.answered.shape[::2]
            )
        action.tail = self._between(k + 1, self._kept_of(self._room.tail))
        for weight in self._room.weight[:count].copy():
            share = float(weight.sum())
            child = self.node(k + 1, self._kept_of(weight / share), node.asked)
            action.children.append((share, child))

    def _back_up(self, action: Action) -> None:
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
    _last: dict[tuple[int, bytes, int], Node] = field(default_factory=dict)

    @property
    def lower(self) -> float:
        """Lower bound on the optimal value."""
        return self.root.lower

    @property
    def upper(self) -> float:
        """Upper bound on the optimal value."""
        return self.root.upper

    def _decided(self, step: int, belief: NDArray[np.float64], asked: int) -> Node | None:
        """The node of a belief, if its bounds are close."""
        key = step, rounded(belief).tobytes(), asked
        node = self.bounded.nodes.get(key) or self._last.get(key)
        if node is None or not node.actions:
            afresh = self.bounded.afresh()
            node = afresh.node(step, belief, asked)
            afresh.search(node, self.brief)
            self._last.clear()
            self._last[key] = node
        return node if node.gap <= CLOSE * (1 + abs(node.lower)) and node.actions else None

    def messages(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """The messages to give before the next *explain*, some of them perhaps again."""
        node = self._decided(step, belief, asked)
        if node is None:
            return self.bounded.policy.messages(step, given, belief)
        return best_set({a.name: a.lower for a in node.actions if a.name >= 0})

    def question(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """The question to ask, as :class:`xplain.solvers.base.Asks` says."""
        return best_question(self.values(step, given, belief, asked))

    def values(
        self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0
    ) -> Mapping[int, float]:
        """Certified lower bounds; QMDP's values where the bounds are not close."""
        node = self._decided(step, belief, asked)
        if node is None:
            return self.bounded.policy.values(step, given, belief)
        return {action.name: action.lower for action in node.actions}
