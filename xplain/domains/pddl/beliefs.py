"""A task under every belief about it: the ground actions and the states that all beliefs share, and
the model of somebody who believes some of the facts incorrectly."""

from __future__ import annotations

import logging
from array import array
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from functools import cache
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from xplain.domains.goal_task import GoalTask, StateSpace
from xplain.domains.pddl.grounding import Ground, Grounding, Masks, Wrong, meets
from xplain.domains.pddl.task import Item, Items, Task
from xplain.errors import InputError, TooLargeError

log = logging.getLogger(__name__)

EVERY = 5.0
"""Seconds between two lines on how far the exploration is."""


class BelievedTask:
    """A task, and the facts about it that people may believe incorrectly.

    Args:
        task: the robot's.
        facts: what each changes.
        dead_end_cost: of a state without a plan.
        max_states: a task with more states is refused.

    Attributes:
        atoms: those that can change, in the order of their bits.
        states: S sets of atoms: those that the robot reaches, first the initial one; those that
            people who believe in another start see instead; and all that can be reached from these
            by the actions of any beliefs, in any mixture.
        n_robot: the number of states that the robot reaches.
        actions: A ground actions, (name, object, …), those that occur between these states.

    Raises:
        InputError: the problem gives no cost for an action of the robot.
        TooLargeError: too many states, or too many facts about one action.
    """

    def __init__(
        self, task: Task, facts: Sequence[Items], dead_end_cost: float, max_states: int
    ) -> None:
        """Grounds the task and explores its states."""
        self._dead_end_cost = dead_end_cost
        self._ground = ground = Grounding(task, facts)
        self.atoms = [(atom.predicate, *atom.args) for atom in ground.bits]
        robot, nobody = ground.choose(frozenset()), frozenset[int]()
        robots, costless = robot[robot >= 0], (robot >= 0) & np.isnan(ground.cost(nobody))
        if costless.any():
            first = ground.actions[int(costless.argmax())]
            cost = task.items[Item("cost", first[0])]
            raise InputError("domain.problem", " ".join(first), f"a value of its cost {cost}")
        rest = ground.variants, max_states
        self.states = explore([ground.start], robots, ground.goal(nobody), *rest)[0]
        self.n_robot = len(self.states)
        for start in ground.starts.values():
            self.states += [_imagine(state, ground.start, start) for state in self.states]
        self.states = [*dict.fromkeys(self.states)]
        every = range(len(ground.variants))
        self.states, edges = explore(self.states, every, ground.common_goal(), *rest)
        used, variant = np.unique(edges[1], return_inverse=True)
        action = ground.action[used]
        self._kept, number = np.unique(action, return_inverse=True)
        self.actions = [ground.actions[a] for a in self._kept]
        self._space = StateSpace(
            n_states=len(self.states),
            n_actions=len(self.actions),
            action=number.astype(np.int32),
            first=np.concatenate([[0], np.cumsum(edges[0])]).astype(np.int64),
            variant=variant.astype(np.int32),
            successor=edges[2],
        )
        self._number = np.full(len(every) + 1, -1)  # the last is for −1
        self._number[used] = np.arange(len(used))
        self._state = {state: s for s, state in enumerate(self.states)}
        self._imagined, self._terminal = cache(self._imagine_all), cache(self._end)

    def table(self) -> NDArray[np.bool_]:
        """[S, atoms] whether each atom holds in each state."""
        width = len(self.atoms) // 8 + 1
        rows = b"".join(state.to_bytes(width, "little") for state in self.states)
        packed = np.frombuffer(rows, np.uint8).reshape(-1, width)
        bits = np.unpackbits(packed, axis=1, bitorder="little", count=len(self.atoms))
        return bits.astype(np.bool_)

    def _imagine_all(self, wrong: Wrong) -> NDArray[np.int64] | None:
        """[S] the state that people see instead of each; itself if the robot never reaches it."""
        starts = [start for j, start in self._ground.starts.items() if j in wrong]
        if not starts:
            return None
        result = np.arange(len(self.states))
        for s, state in enumerate(self.states[: self.n_robot]):
            for start in starts:
                state = _imagine(state, self._ground.start, start)
            result[s] = self._state.get(state, -1)
        return result

    def _end(self, wrong: Wrong) -> NDArray[np.bool_]:
        """[S] where these people think that the goal is met."""
        goal = self._ground.goal(wrong)
        return np.array([goal is not None and meets(state, goal) for state in self.states])

    def model(self, wrong: Wrong) -> GoalTask:
        """The task of somebody who believes these facts incorrectly."""
        ground = self._ground
        cost = ground.cost(wrong & ground.about_cost)[self._kept]
        chosen = self._number[ground.choose(wrong)[self._kept]]
        return GoalTask(
            space=self._space,
            chosen=np.where(np.isnan(cost), -1, chosen),
            cost=np.nan_to_num(cost),
            terminal=self._terminal(wrong & ground.about_goal),
            dead_end_cost=self._dead_end_cost,
            start=0,
            imagined=self._imagined(wrong & frozenset(ground.starts)),
        )


def _imagine(state: int, initial: int, start: Masks) -> int:
    """What people see who believe in another start: the atoms that differ there, as they believe
    them to be, until the robot changes one of them."""
    about, added = start
    return state if (state ^ initial) & about else state & ~about | added


def explore(
    seeds: Sequence[int],
    allowed: Iterable[int],
    goal: Masks | None,
    variants: Sequence[Ground],
    limit: int,
) -> tuple[list[int], tuple[array[int], NDArray[np.int32], NDArray[np.int32]]]:
    """All states reached from the seeds, breadth first; the seeds come first, in their order.

    Args:
        seeds: distinct states.
        allowed: the variants to use.
        goal: a state that meets it has no edges.
        variants: what ground actions ask for and do.
        limit: largest number of states.

    Returns:
        The states, and their edges, rising by state and variant: the number of edges of each state,
        [E] variants, [E] successors.

    Raises:
        TooLargeError: there are more states.
    """
    used = sorted(map(int, allowed))
    often = Counter(bit for v in used for bit in split(variants[v][0]))
    watched: dict[int, list[int]] = defaultdict(list)  # by the rarest atom that is asked for
    for v in used:
        watched[min(split(variants[v][0]), key=often.__getitem__, default=0)].append(v)
    number = {state: s for s, state in enumerate(seeds)}
    states, heard = [*seeds], monotonic()
    degrees, edges, successors = array("q"), array("i"), array("i")
    for done, state in enumerate(states):
        before = len(edges)
        if goal is None or not meets(state, goal):
            able = [v for bit, own in watched.items() if state & bit == bit for v in own]
            for v in sorted(v for v in able if meets(state, variants[v])):
                after = _apply(state, variants[v][2])
                edges.append(v)
                successors.append(number.setdefault(after, len(states)))
                if successors[-1] == len(states):
                    states.append(after)
        degrees.append(len(edges) - before)
        if len(states) > limit:
            raise TooLargeError(
                f"domain.max_states={limit}: the robot's and the believed tasks reach more states; "
                "use fewer objects, or allow more (memory and time grow with them)"
            )
        if monotonic() > heard + EVERY:
            heard = monotonic()
            log.info("PDDL: %s of %s states found so far are explored", done + 1, len(states))
    arrays = np.array(edges, np.int32), np.array(successors, np.int32)
    return states, (degrees, *arrays)


def _apply(state: int, effects: Iterable[tuple[int, ...]]) -> int:
    """The state after the effects, which all happen at once; what is added stays."""
    adds = deletes = 0
    for *condition, added, deleted in effects:
        if meets(state, condition):
            adds |= added
            deletes |= deleted
    return state & ~deletes | adds


def split(atoms: int) -> list[int]:
    """The bits of a set."""
    return [1 << i for i in range(atoms.bit_length()) if atoms >> i & 1]
