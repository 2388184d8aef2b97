"""POMCP in plain Python, from the problem alone: the reference of the compiled kernel.

Histories are objects with dicts, values are recomputed from what they are made of, and only the
random words are drawn in the kernel's order: a word a type, a word where an action is chosen at
random, a word for all informative labels and one more after each that was the less likely.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from xplain.explanation.problem import Problem
from xplain.solvers.pomcp import POMCP

ALL = (1 << 64) - 1


@dataclass
class Node:
    """A history: ``start`` is where its step began, ``tried`` has action → [visits, value]."""

    step: int
    given: int
    belief: tuple[float, ...]
    start: Node | None = None
    visits: int = 0
    value: float = 0.0
    tried: dict[int, list[float]] = field(default_factory=dict)
    orders: dict[int, Node] = field(default_factory=dict)  # by message set, at the start of a step
    answers: dict[object, Node] = field(default_factory=dict)  # by what was answered


class PlainPOMCP:
    """A search from (step, given, belief)."""

    def __init__(
        self, solver: POMCP, problem: Problem, seed: int, step: int, given: int, belief: np.ndarray
    ) -> None:
        self.solver, self.problem, self.counter = solver, problem, seed
        per_action = problem.discount_per == "action"
        self.discount = problem.discount
        self.message_discount = problem.discount if per_action else 1.0
        self.price = [problem.trade_off * float(c) for c in problem.message_cost]
        unit = max([problem.inexplicability_cost, *self.price])
        self.exploration = solver.exploration * unit
        self.n, self.m = problem.n_messages, problem.n_steps
        self.optimal = cache(self.optimal)
        self.root = Node(step, given, tuple(belief))

    def run(self) -> dict[int, list[float]]:
        """Visits and value of the root's actions; action n is *explain*."""
        for _ in range(self.solver.simulations):
            u = self.uniform()
            possible = [t for t, b in enumerate(self.root.belief) if b > 0]
            user_type = possible[-1]
            for t in possible[:-1]:
                if u < self.root.belief[t]:
                    user_type = t
                    break
                u -= self.root.belief[t]
            self.simulate(self.root, user_type, 0)
        return self.root.tried

    def word(self) -> int:
        """splitmix64."""
        self.counter = (self.counter + 0x9E3779B97F4A7C15) & ALL
        x = self.counter
        x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & ALL
        x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & ALL
        return x ^ (x >> 31)

    def uniform(self) -> float:
        return (self.word() >> 11) * 2.0**-53

    def choice(self, options: list[int]) -> int:
        return options[((self.word() >> 32) * len(options)) >> 32]

    def simulate(self, node: Node, user_type: int, depth: int) -> float:
        """The return from a node that is in the tree."""
        if self.solver.depth is not None and depth >= self.solver.depth:
            node.visits += 1
            node.value = self.leaf(node)
            return node.value
        action = self.select(node)
        if action < self.n:
            start = node.start or node
            given = node.given | 1 << action
            is_new = given not in start.orders
            if is_new:
                start.orders[given] = Node(node.step, given, node.belief, start)
            child: Node | None = start.orders[given]
            below = depth + (self.solver.depth_unit == "actions")
            reward, discount = -self.price[action], self.message_discount
        else:
            reward, discount, below = self.explain_reward(node), self.discount, depth + 1
            child = None
            if node.step + 1 < self.m:
                labels = self.draw(node.step, node.given, user_type)
                seen = self.counts(node, labels)
                is_new = seen not in node.answers
                if is_new:
                    posterior = self.posterior(node.step, node.given, node.belief, labels)
                    node.answers[seen] = Node(node.step + 1, node.given, posterior)
                child = node.answers[seen]
        future = 0.0
        if child is not None and is_new:
            future = child.value = self.roll(child, user_type)
            child.visits = 1
        elif child is not None:
            future = self.simulate(child, user_type, below)
        sample = reward + discount * future
        visits, value = node.tried.get(action, [0, 0.0])
        node.tried[action] = [visits + 1, value + (sample - value) / (visits + 1)]
        node.visits += 1
        if self.solver.backup == "mean":
            return sample
        if action == self.n and child is not None:
            told = sum(answer.visits * answer.value for answer in node.answers.values())
            node.tried[action][1] = reward + discount * told / (visits + 1)
        else:
            node.tried[action][1] = sample
        node.value = max(value for _, value in node.tried.values())
        return node.value

    def select(self, node: Node) -> int:
        actions = [a for a in range(self.n + 1) if not node.given >> a & 1]
        untried = [a for a in actions if a not in node.tried]
        if untried:
            return self.choice(untried)
        log = math.log(node.visits)
        return max(
            actions,
            key=lambda a: node.tried[a][1] + self.exploration * math.sqrt(log / node.tried[a][0]),
        )

    def explain_cost(self, step: int, given: int, user_type: int) -> float:
        zeros = (1 - self.problem.p_explicable[user_type, : step + 1, given]).sum()
        return self.problem.inexplicability_cost * float(zeros)

    def explain_reward(self, node: Node) -> float:
        return -sum(
            b * self.explain_cost(node.step, node.given, t) for t, b in enumerate(node.belief)
        )

    def informative(self, step: int, given: int) -> list[int]:
        p = self.problem.p_explicable[:, : step + 1, given]
        return [i for i in range(step + 1) if len(set(p[:, i])) > 1]

    def draw(self, step: int, given: int, user_type: int) -> list[int]:
        """Labels are the likelier of the two until u exceeds the probability that all were."""
        labels: list[int] = []
        u, as_likely = -1.0, 1.0
        for i in self.informative(step, given):
            p = float(self.problem.p_explicable[user_type, i, given])
            u = self.uniform() if u < 0 else u
            as_likely *= max(p, 1 - p)
            likelier = int(p >= 0.5)
            labels.append(likelier)
            if u >= as_likely:
                labels[-1] = 1 - likelier
                u, as_likely = self.uniform(), 1.0
        return labels

    def counts(self, node: Node, labels: list[int]) -> object:
        """Zeros by distinct column of the table."""
        zeros: dict[tuple[float, ...], int] = {}
        for i, label in zip(self.informative(node.step, node.given), labels, strict=True):
            column = tuple(self.problem.p_explicable[:, i, node.given].tolist())
            zeros[column] = zeros.get(column, 0) + (label == 0)
        return frozenset(zeros.items())

    def posterior(
        self, step: int, given: int, belief: tuple[float, ...], labels: list[int]
    ) -> tuple[float, ...]:
        joint = list(belief)
        for i, label in zip(self.informative(step, given), labels, strict=True):
            for t in range(len(joint)):
                p = float(self.problem.p_explicable[t, i, given])
                joint[t] *= p if label else 1 - p
        return tuple(x / sum(joint) for x in joint)

    def optimal(self, step: int, given: int, user_type: int) -> float:
        """V*_t(k, H), by recursion."""
        if step == self.m:
            return 0.0
        values = [
            self.discount * self.optimal(step + 1, given, user_type)
            - self.explain_cost(step, given, user_type)
        ]
        values += [
            self.message_discount * self.optimal(step, given | 1 << j, user_type) - self.price[j]
            for j in range(self.n)
            if not given >> j & 1
        ]
        return max(values)

    def qmdp(self, step: int, given: int, belief: tuple[float, ...]) -> tuple[float, int]:
        best, action = 0.0, self.n
        for t, b in enumerate(belief):
            later = self.discount * self.optimal(step + 1, given, t)
            best += b * (later - self.explain_cost(step, given, t))
        for j in range(self.n):
            if not given >> j & 1:
                value = sum(b * self.optimal(step, given | 1 << j, t) for t, b in enumerate(belief))
                value = self.message_discount * value - self.price[j]
                if value > best + 1e-12:
                    best, action = value, j
        return best, action

    def settled(self, step: int, given: int) -> bool:
        """No type should be told anything more, now or later."""
        return all(
            self.optimal(k, given, t)
            <= self.discount * self.optimal(k + 1, given, t)
            - self.explain_cost(k, given, t)
            + 1e-12
            for k in range(step, self.m)
            for t in range(self.problem.n_types)
        )

    def leaf(self, node: Node) -> float:
        return self.qmdp(node.step, node.given, node.belief)[0]

    def roll(self, node: Node, user_type: int) -> float:
        step, given, belief = node.step, node.given, node.belief
        value, scale = 0.0, 1.0
        while step < self.m:
            if belief[user_type] > 1 - 1e-6 or self.settled(step, given):
                return value + scale * self.optimal(step, given, user_type)
            action = self.qmdp(step, given, belief)[1]
            if action < self.n:
                value -= scale * self.price[action]
                scale *= self.message_discount
                given |= 1 << action
                continue
            value -= scale * self.explain_cost(step, given, user_type)
            scale *= self.discount
            if step + 1 < self.m:
                labels = self.draw(step, given, user_type)
                belief = self.posterior(step, given, belief, labels)
            step += 1
        return value
