"""A task under every belief about it: the states and actions that all beliefs share, and the model
of somebody who holds some of the facts wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from xplain.domains.goal_task import GoalTask, StateSpace
from xplain.domains.pddl.changes import Change
from xplain.domains.pddl.grounding import Grounding, static_holds
from xplain.domains.pddl.states import Bits, Compiled, Words, explore
from xplain.domains.pddl.task import Action, Literal, Task

Wrong = frozenset[int]
"""The facts that somebody holds wrong."""


class BelievedTask:
    """A task, and the facts about it that people may hold wrong.

    Args:
        task: the robot's.
        facts: the changes of each.
        more: actions that changes may add.
        dead_end_cost: of a state without a plan.
        max_states: a task with more states is refused.

    Attributes:
        task: as given.
        bits: numbers the atoms that can change.
        states: [S, W] those that the robot reaches, first the initial one; those that people who
            believe in another start see instead; and all that can be reached from these by the
            actions of any beliefs, in any mixture.
        actions: A ground actions, (schema, object, …), those that occur between these states.

    Raises:
        XplainError: a cost is not positive, or has no value.
        TooLargeError: too many states or actions.
    """

    def __init__(
        self,
        task: Task,
        facts: Sequence[Sequence[Change]],
        more: Mapping[str, Action],
        dead_end_cost: float,
        max_states: int,
    ) -> None:
        """Grounds the task and explores its states."""
        self.task, self._facts, self._dead_end_cost = task, facts, dead_end_cost
        self._grounding = Grounding(task, facts, more)
        self.bits = Bits(self._grounding.atoms)
        self._number: dict[bytes, int] | None = None
        self._imagined, self._terminal = cache(self._imagined_by), cache(self._terminal_to)
        self._explore(max_states)

    def _explore(self, max_states: int) -> None:
        """States and edges; the robot's states first, from its initial one on."""
        grounding, bits = self._grounding, self.bits
        compiled = Compiled.of(bits, grounding.variants)
        initial = bits.rows([self.task.initial])
        robots = np.zeros(len(grounding.variants), dtype=bool)
        own, _ = grounding.chosen(frozenset())
        robots[own[own >= 0]] = True
        everything = np.ones(len(robots), dtype=bool)
        one_goal = self._ends([frozenset()])
        seeds = explore(compiled, initial, robots, one_goal, max_states).states
        self._robot_states = len(seeds)
        about = [j for j in range(len(self._facts)) if self._believed_start(j)]
        for j in about:
            seeds = np.concatenate([seeds, self._imagine(seeds, j)])
            _, kept = np.unique(seeds, axis=0, return_index=True)
            seeds = seeds[np.sort(kept)]
        goals = [
            j for j in range(len(self._facts))
            if any(kind.endswith("_goal") for change in self._facts[j] for kind in change)
        ]  # fmt: skip
        several = [
            frozenset(j for i, j in enumerate(goals) if mask >> i & 1)
            for mask in range(1 << len(goals))
        ] if len(goals) <= 6 else []  # fmt: skip
        reached = explore(compiled, seeds, everything, self._ends(several), max_states)
        self.states = reached.states
        used, variant = np.unique(reached.variant, return_inverse=True)
        actions, action = np.unique(grounding.action[used], return_inverse=True)
        self._space = StateSpace(
            n_states=len(reached.states),
            n_actions=len(actions),
            action=action.astype(np.int32),
            first=reached.first,
            variant=variant.astype(np.int32),
            successor=reached.successor,
        )
        self.actions = [grounding.actions[i] for i in actions]
        self._kept = actions
        self._variant_number = np.full(len(robots) + 1, -1)  # the last is for −1
        self._variant_number[used] = np.arange(len(used))
        self._about_start, self._about_goal = frozenset(about), frozenset(goals)

    def _ends(self, wrongs: Sequence[Wrong]) -> tuple[Words, Words]:
        """The goals of people with these facts wrong, to explore; none if one cannot be met."""
        goals = [self._goal(wrong) for wrong in wrongs]
        if any(goal is None for goal in goals):
            goals = []
        known = [goal for goal in goals if goal is not None]
        return tuple(
            self.bits.rows([x.atom for x in goal if x.positive == positive] for goal in known)
            for positive in (True, False)
        )  # type: ignore[return-value]

    def _goal(self, wrong: Wrong) -> list[Literal] | None:
        """The part of the goal that can change; None if the rest is not met."""
        task = self._grounding.task_of(wrong)
        changing = self._grounding.changing
        rest = [x for x in task.goal if x.atom[0] not in changing]
        if not all(static_holds(task, x) for x in rest):
            return None
        return [x for x in task.goal if x.atom[0] in changing]

    def _believed_start(self, fact: int) -> list[tuple[str, Literal]]:
        """What a fact says about the start that the robot can change: (kind of change, atom)."""
        task, other = self.task, self._grounding.task_of(frozenset({fact}))
        return [
            ("drop" if atom in task.initial else "add", Literal(atom))
            for atom in sorted(task.initial ^ other.initial)
            if atom[0] in self._grounding.changing
        ]

    def _imagine(self, rows: Words, fact: int) -> Words:
        """The states [n, W] that people who hold a fact about the start wrong see instead of these;
        the same states if the robot has changed anything that the fact is about."""
        differing = self._believed_start(fact)
        about = self.bits.row(x.atom for _, x in differing)
        added = self.bits.row(x.atom for kind, x in differing if kind == "add")
        untouched = ((rows & about) == (self.bits.row(self.task.initial) & about)).all(axis=1)
        return np.where(untouched[:, None], (rows & ~about) | added, rows)

    def _imagined_by(self, wrong: Wrong) -> NDArray[np.int64] | None:
        """[S] the state that people see instead of each; itself if the robot never reaches it."""
        if not wrong:
            return None
        rows = self.states[: self._robot_states]
        for j in sorted(wrong):
            rows = self._imagine(rows, j)
        if self._number is None:
            self._number = {row.tobytes(): s for s, row in enumerate(self.states)}
        number = self._number
        result = np.arange(len(self.states))
        result[: len(rows)] = [number.get(row.tobytes(), -1) for row in rows]
        return result

    def _terminal_to(self, wrong: Wrong) -> NDArray[np.bool_]:
        goal = self._goal(wrong)
        if goal is None:
            return np.zeros(len(self.states), dtype=bool)
        return self.bits.meets(self.states, goal)

    def model(self, wrong: Wrong) -> GoalTask:
        """The task of somebody who holds these facts wrong."""
        chosen, cost = self._grounding.chosen(wrong)
        return GoalTask(
            space=self._space,
            chosen=self._variant_number[chosen[self._kept]],
            cost=cost[self._kept],
            terminal=self._terminal(wrong & self._about_goal),
            dead_end_cost=self._dead_end_cost,
            start=0,
            imagined=self._imagined(wrong & self._about_start),
        )
