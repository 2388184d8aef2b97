"""A task under every belief about it: ground actions as bit masks, under every combination of the
facts that affect them; the states that all beliefs share; and the model of somebody who believes
some of the facts incorrectly.
"""

from __future__ import annotations

import logging
import re
from array import array
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from functools import cache
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.goal_task import GoalTask, StateSpace
from xplain.domains.pddl.task import (
    Item,
    Items,
    Source,
    Task,
    changed,
    instantiate,
    lifted,
    reach,
    substitute,
    texts,
    translate,
)
from xplain.errors import InputError, TooLargeError

Wrong = frozenset[int]
"""The facts that somebody believes incorrectly."""
Masks = tuple[int, int]
"""Two sets of atoms, a bit each: those that hold, and those that do not."""
Ground = tuple[int, int, tuple[tuple[int, ...], ...]]
"""What a ground action asks for, as :data:`Masks`, and its effects: (holds, lacks, adds, deletes),
the first two as a condition."""
MOST_FACTS = 12
"""Most facts about what one ground action asks for and does: all their combinations are tried."""
SOURCE = Source("domain.facts", "", "")
"""What was read without an error before."""


class Grounding:
    """A task and the facts about it, grounded: actions that cannot be reached in any belief are
    left out.

    Args:
        task: the robot's.
        facts: what each changes.

    Attributes:
        actions: (name, object, …) of each, in the order of the files.
        variants: the distinct forms that some belief gives an action; ``action`` [V] says which.
        bits: of the atoms that can change, sorted.
        start: the robot's initial state.
        starts: of each fact about the start that the robot can change: the atoms in which it
            differs, and those of them that hold.
        about_goal, about_cost: the facts that affect goals and costs.

    Raises:
        TooLargeError: more than MOST_FACTS facts affect what one ground action asks for and does.
    """

    def __init__(self, task: Task, facts: Sequence[Items]) -> None:
        """Grounds the task."""
        self._task, self._facts = task, facts
        relaxed = translate(task, self._relax(), SOURCE)
        self._names = {x.name: [y.name for y in x.parameters] for x in relaxed.actions}
        self._things = instantiate.get_objects_by_type(relaxed.objects, relaxed.types)
        changing = {effect.literal.predicate for x in relaxed.actions for effect in x.effects}
        model = reach(relaxed)
        order = {name: i for i, name in enumerate(self._names)}
        actions = (
            (x.predicate.name, *x.args) for x in model if isinstance(x.predicate, lifted.Action)
        )
        self.actions = sorted(actions, key=lambda action: (order[action[0]], action))
        self.bits = {
            atom: 1 << i
            for i, atom in enumerate(sorted(x for x in model if x.predicate in changing))
        }
        self.start = sum(self.bits.get(_atom(text), 0) for text in texts(task.items, "initial"))
        self._static: dict[str, list[int]] = defaultdict(list)
        self.starts: dict[int, Masks] = {}
        for j, fact in enumerate(facts):
            differing = added = 0
            for item in (item for item in fact if item.kind == "initial"):
                bit = self.bits.get(_atom(item.text))
                if bit is None:
                    self._static[item.text].append(j)
                else:
                    differing, added = differing | bit, added | bit * (fact[item] is not None)
            if differing:
                self.starts[j] = differing, added
        self._about_static = frozenset[int]().union(*self._static.values())
        self.about_goal = self._about("goal") | self._about_static
        self.about_cost = self._about("cost", "function")
        self._items = cache(lambda wrong: changed(task.items, *(facts[j] for j in sorted(wrong))))
        self._initial, self._schema = cache(self._read_initial), cache(self._read_schema)
        self.cost = cache(self._read_costs)
        self._number_variants()

    def _relax(self) -> Items:
        """The items of a task in which all can happen that can happen in any belief."""
        result, loose = dict(self._task.items), set()
        for fact in self._facts:
            for item, value in fact.items():
                asks = item.kind in ("precondition", "cost")
                if asks and Item("action", item.owner) not in fact:
                    loose.add(item)
                elif value is not None:
                    result[item] = value
        return {item: value for item, value in result.items() if item not in loose}

    def _about(self, *kinds: str, owner: str = "") -> Wrong:
        """The facts that change an item of these kinds; of an action, if it is given."""
        return frozenset(
            j
            for j, fact in enumerate(self._facts)
            if any(item.kind in kinds and owner in ("", item.owner) for item in fact)
        )

    def _read_initial(self, wrong: Wrong) -> Any:
        """The initial atoms as these people believe them; each object equals itself."""
        equal = {lifted.Atom("=", (name, name)) for name in self._task.objects}
        return equal.union(map(_atom, texts(self._items(wrong), "initial")))

    def _read_schema(self, name: str, wrong: Wrong) -> Any:
        """An action as these people believe it to be; None if it does not exist or does nothing."""
        own = {item: value for item, value in self._items(wrong).items() if item.owner == name}
        found = translate(self._task, own if Item("action", name) in own else {}, SOURCE).actions
        return found[0] if found else None

    def _number_variants(self) -> None:
        """Grounds each action under all combinations of the facts about it."""
        about = {x: self._about("action", "precondition", "effect", owner=x) for x in self._names}
        asked = defaultdict(set)
        for item in {item for items in (self._task.items, *self._facts) for item in items}:
            asked[item.owner].update(re.findall(r"\([^()]+\)", item.text))
        number: dict[tuple[int, Ground], int] = {}
        groups: dict[tuple[int, ...], list[tuple[int, list[int]]]] = defaultdict(list)
        for a, (name, *objects) in enumerate(self.actions):
            binding = dict(zip(self._names[name], objects, strict=True))
            own = set(about[name])
            for pattern in (substitute(text, binding) for text in asked[name] if self._static):
                any_object = re.sub(r"\\\?[^\s()]+", r"\\S+", re.escape(pattern))
                own.update(*(j for x, j in self._static.items() if re.fullmatch(any_object, x)))
            if len(own) > MOST_FACTS:
                raise TooLargeError(
                    f"domain: {len(own)} facts affect the action {' '.join(self.actions[a])}; at "
                    f"most {MOST_FACTS} can be combined: join some of them into one fact"
                )
            row, facts = [], tuple(sorted(own))
            for subset in range(1 << len(facts)):
                wrong = frozenset(j for i, j in enumerate(facts) if subset >> i & 1)
                made = self._ground(name, binding, wrong)
                row.append(-1 if made is None else number.setdefault((a, made), len(number)))
            groups[facts].append((a, row))
        self.variants = [made for _, made in number]
        self.action = np.array([a for a, _ in number], dtype=np.int32)
        self._choices = {
            x: [np.array(y) for y in zip(*own, strict=True)] for x, own in groups.items()
        }

    def _ground(self, name: str, binding: Any, wrong: Wrong) -> Ground | None:
        """An action for some objects, as these people believe it to be; None: it never happens."""
        action = self._schema(
            name, wrong & self._about("action", "precondition", "effect", owner=name)
        )
        initial = self._initial(wrong & self._about_static)
        made = action and action.instantiate(binding, initial, {}, self.bits, self._things, False)
        if made is None:
            return None
        effects: dict[Masks, list[int]] = defaultdict(lambda: [0, 0])
        for i, part in enumerate((made.add_effects, made.del_effects)):
            for condition, atom in part:
                effects[self._masks(condition)][i] |= self.bits[atom]
        done = tuple((*condition, *both) for condition, (*both,) in sorted(effects.items()))
        return (*self._masks(made.precondition), done)

    def _masks(self, literals: Iterable[Any]) -> Masks:
        masks = [0, 0]
        for literal in literals:
            masks[literal.negated] |= self.bits[literal.positive()]
        return masks[0], masks[1]

    def choose(self, wrong: Wrong) -> NDArray[np.int64]:
        """[A] the variant of each action for these people; −1: none."""
        result = np.full(len(self.actions), -1, dtype=np.int64)
        for facts, (own, variants) in self._choices.items():
            result[own] = variants[:, sum(1 << i for i, j in enumerate(facts) if j in wrong)]
        return result

    def _read_costs(self, wrong: Wrong) -> NDArray[np.float64]:
        """[A] the cost of each action for these people; NaN where it has none, so that the action
        does not exist."""
        items, result = self._items(wrong), []
        for name, *objects in self.actions:
            cost = items.get(Item("cost", name), np.nan)
            if isinstance(cost, str):
                function = substitute(cost, dict(zip(self._names[name], objects, strict=True)))
                cost = items.get(Item("function", "", function), np.nan)
            result.append(cost)
        return np.array(result, dtype=np.float64)

    def goal(self, wrong: Wrong) -> Masks | None:
        """What these people take for the goal; None if it cannot be met."""
        return self._meet(texts(self._items(wrong), "goal"), wrong)

    def common_goal(self) -> Masks | None:
        """What meets the goals of all beliefs; None if nothing does."""
        every = {
            text for items in (self._task.items, *self._facts) for text in texts(items, "goal")
        }
        touched = any(atom in text for text in every for atom in self._static)
        return None if touched else self._meet(every, frozenset())

    def _meet(self, literals: Iterable[str], wrong: Wrong) -> Masks | None:
        items = {Item("goal", "", text): True for text in literals}
        goal = translate(self._task, items, SOURCE).goal
        initial = self._initial(wrong & self._about_static)
        found = instantiate.instantiate_goal(goal, initial, self.bits)
        return None if found is None else self._masks(found)


def _atom(text: str) -> Any:
    name, *arguments = text.strip("()").split()
    return lifted.Atom(name, arguments)


def meets(state: int, masks: Sequence[Any]) -> bool:
    """Whether a state has all atoms of the first set, and none of the second."""
    return not (~state & masks[0] or state & masks[1])


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
