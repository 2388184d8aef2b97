"""A task under every belief about it: one grounding for all beliefs, their common states, and the
task of a person who believes some of the facts incorrectly.

All beliefs are merged into one task, which Fast Downward's translator grounds once. In this task
the atom (fact@3) means that a person believes fact 3 incorrectly, and all changes of this fact
depend on the atom. No action changes such atoms. A belief determines which of these atoms hold, and
a ground action exists in the belief if the action's conditions on these atoms hold.
"""

import logging
from array import array
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import copy
from functools import cache
from itertools import chain, product
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.goal_task import GoalTask, StateSpace
from xplain.domains.pddl.task import (
    Item,
    Items,
    Signature,
    Task,
    apply_changes,
    instantiate,
    lifted,
    reach,
    substitute,
    texts,
)
from xplain.errors import TooLargeError

Wrong = frozenset[int]
"""The facts that a person believes incorrectly."""
Condition = tuple[Signature, Sequence[Any]]
"""Variables, and the literals that must hold, in the translator's form."""
Effects = tuple[tuple[int, int, int], ...]
"""(condition, adds, deletes) of each conditional effect."""
MOST_FACTS = 12
"""Maximum number of facts about one action's preconditions and effects, because all combinations of
these facts are grounded."""
EVERY = 5.0
"""Seconds between two progress lines of the exploration."""
log = logging.getLogger(__name__)


def merge(task: Task, facts: Sequence[Items], conditions: Iterable[Condition]) -> Any:
    """Merges the robot's task and all believed tasks into one task of the translator.

    Args:
        task: the robot's task.
        facts: the changes of each fact.
        conditions: conditions whose instances are needed. For condition i the merged task has an
            action holds@i with this precondition, so that grounding the actions finds the
            instances.

    Raises:
        TooLargeError: more than MOST_FACTS facts affect one action's preconditions and effects.
    """
    flags = [lifted.Atom(f"fact@{j}", []) for j in range(len(facts))]
    robots = dict(task.items)
    for i, (variables, parts) in enumerate(conditions):
        name, effect = f"holds@{i}", lifted.Effect([], lifted.Truth(), flags[0])
        robots |= {Item("action", name): variables, Item("effect", name): effect}
        robots |= {Item("precondition", name, str(k)): part for k, part in enumerate(parts)}
    every = dict(robots)
    for item, value in chain(*(fact.items() for fact in facts)):
        if value is not None:
            every.setdefault(item, value)

    def guard(item: Item) -> Any:
        """Returns a condition on the atoms fact@j: it holds for exactly the people whose task has
        the item."""
        own = [(flag, fact[item]) for flag, fact in zip(flags, facts, strict=True) if item in fact]
        if item in robots:
            return lifted.Conjunction([flag.negate() for flag, value in own if value is None])
        return lifted.Disjunction([flag for flag, _ in own])

    def function(text: str) -> Any:
        name, *arguments = text.strip("()").split()
        return lifted.PrimitiveNumericExpression(name, arguments)

    actions = []
    for name, signature in ((x.owner, every[x]) for x in every if x.kind == "action"):
        about = [x for x in facts if any(y.owner == name and y.kind != "cost" for y in x)]
        if len(about) > MOST_FACTS:
            raise TooLargeError(
                f"domain: {len(about)} facts affect the action {name}; at most {MOST_FACTS} can be "
                "combined: join some of them into one fact"
            )
        asked, effects = [guard(Item("action", name))], []
        for item, value in ((x, every[x]) for x in every if x.owner == name):
            # If the robot lacks an action, the guard of the action holds for all of its parts.
            there = guard(item) if Item("action", name) in robots else lifted.Truth()
            if item.kind == "precondition":
                asked.append(lifted.Disjunction([there.negate(), value]))
            elif item.kind == "effect":
                when = lifted.Conjunction([there, value.condition]).simplified()
                effects.append(lifted.Effect(value.parameters, when, value.literal))
        cost = Item("cost", name)
        same = isinstance(every.get(cost), str) and not any(cost in fact for fact in facts)
        value = lifted.Increase(None, function(every[cost])) if same else None
        typed = [lifted.TypedObject(*variable) for variable in signature]
        condition = lifted.Conjunction(asked).simplified()
        actions.append(lifted.Action(name, typed, len(typed), condition, effects, value))
    found, initial = copy(task.found), [every[x] for x in every if x.kind == "initial"]
    equal = [x for x in found.init if getattr(x, "predicate", "") == "="]
    values = [lifted.Assign(function(x.text), None) for x in every if x.kind == "function"]
    found.init, found.goal = [*initial, *flags, *equal, *values], lifted.Truth()
    found.actions = actions
    return found


class Grounding:
    """A task and its facts, grounded once. Actions that no belief reaches are left out.

    A set of literals is an integer with one bit for each literal: first the atoms that actions can
    change, then the *belief atoms*, which no action changes and which differ between beliefs, then
    the negations of all these atoms, in the same order.

    Args:
        task: the robot's task.
        facts: the changes of each fact.
        conditions: conditions by name; all of their instances are found.

    Attributes:
        atoms: atoms that actions can change.
        beliefs: set of the belief atoms and their negations.
        start: set of the atoms that hold at the start of the robot's task.
        starts: two sets of atoms for each fact j: the atoms that the fact changes at the start,
            including fact@j; and the atoms in this first set that hold in the believed start.
        actions: (name, object, …) of each ground action, in the order of the files.
        variants: V forms of ground actions. A ground action has several forms if its precondition
            or effects differ between beliefs. Each form is (index of the ground action,
            precondition, effects), without literals about belief atoms.
        instances: for each condition by name, the set of literals of each of its instances.

    Raises:
        TooLargeError: more than MOST_FACTS facts affect one action's preconditions and effects.
    """

    def __init__(
        self, task: Task, facts: Sequence[Items], conditions: Mapping[str, Condition]
    ) -> None:
        """Grounds the task."""
        found = merge(task, facts, conditions.values())
        order = [x.name for x in found.actions]
        changing = {y.literal.predicate for x in found.actions for y in x.effects} - {"fact@0"}
        flags = [lifted.Atom(f"fact@{j}", []) for j in range(len(facts))]
        starts = [{x: y for x, y in fact.items() if x.kind == "initial"} for fact in facts]
        differing = [[y or task.items[x] for x, y in own.items()] for own in starts]
        model = reach(found)
        atoms = sorted({x for x in model if x.predicate in changing})
        fixed = sorted({x for x in chain(flags, *differing) if x.predicate not in changing})
        self.atoms = [(x.predicate, *x.args) for x in atoms]
        positive = [*atoms, *fixed]
        both = [*positive, *(x.negate() for x in positive)]
        self._bits = {literal: 1 << i for i, literal in enumerate(both)}
        self._every = (1 << len(positive)) - 1
        self.beliefs = self._make_mask([*fixed, *(x.negate() for x in fixed)])
        own = (y for x, y in task.items.items() if x.kind == "initial")
        self.start = sum(self._bits.get(x, 0) for x in own)
        self.starts = [
            (self._make_mask([flag, *atoms]), self._make_mask([flag, *filter(None, own.values())]))
            for flag, atoms, own in zip(flags, differing, starts, strict=True)
        ]
        forms = sorted(self._instantiate(found, model), key=lambda x: (order.index(x[0][0]), x))
        self.instances = {
            name: [asked for action, asked, _ in forms if action[0] == f"holds@{i}"]
            for i, name in enumerate(conditions)
        }
        self.actions = [*dict.fromkeys(x for x, *_ in forms if "@" not in x[0])]
        number = {action: a for a, action in enumerate(self.actions)}
        variants: dict[tuple[int, int, Effects], int] = {}
        self._guards: dict[int, list[int]] = defaultdict(list)
        for action, asked, effects in forms:
            for guard, done in self._resolve(asked, effects) if action in number else ():
                variant = number[action], asked & ~self.beliefs, done
                self._guards[guard].append(variants.setdefault(variant, len(variants)))
        self.variants = [*variants]

    def _make_mask(self, literals: Iterable[Any]) -> int:
        return sum(self._bits[x] for x in {*literals})

    def _instantiate(self, found: Any, model: Any) -> Iterator[tuple[Any, int, Effects]]:
        """Yields each ground action of the merged task as ((name, object, …), precondition,
        effects). The precondition and the conditions of effects may contain literals about belief
        atoms (:class:`Grounding`).

        Args:
            found: the merged task.
            model: the atoms and ground actions that it reaches.
        """
        objects = instantiate.get_objects_by_type(found.objects, found.types)
        initial = {x for x in found.init if isinstance(x, lifted.Atom)}
        for schema, arguments in ((x.predicate, x.args) for x in model):
            if not isinstance(schema, lifted.Action):
                continue
            binding = {x.name: y for x, y in zip(schema.parameters, arguments, strict=False)}
            made = schema.instantiate(binding, initial, {}, self._bits, objects, False)
            if made:
                effects: dict[int, list[int]] = defaultdict(lambda: [0, 0])
                for i, part in enumerate((made.add_effects, made.del_effects)):
                    for condition, atom in part:
                        effects[self._make_mask(condition)][i] |= self._bits[atom]
                action = schema.name, *arguments[: schema.num_external_parameters]
                done = tuple((x, adds, deletes) for x, (adds, deletes) in sorted(effects.items()))
                yield action, self._make_mask(made.precondition), done

    def _resolve(self, asked: int, effects: Effects) -> Iterator[tuple[int, Effects]]:
        """Yields the forms of a ground action, one for each combination of truth values of the
        belief atoms (:class:`Grounding`) in the conditions of its effects.

        Args:
            asked: precondition, with literals about belief atoms.
            effects: effects, with literals about belief atoms in their conditions.

        Returns:
            For each form (one at a time): the set of the literals about belief atoms that must all
            be true in a belief that has this form; and the effects without these literals.
        """
        about = 0
        for condition, *_ in effects:
            about |= condition & self.beliefs
        about = (about | about >> self._every.bit_length()) & self._every
        for chosen in product(*((0, 1 << i) for i in split(about))):
            known = self.complete(sum(chosen), about)
            done = (
                (condition & ~self.beliefs, adds, deletes)
                for condition, adds, deletes in effects
                if not condition & self.beliefs & ~known
            )
            yield asked & self.beliefs | known, tuple(done)

    def complete(self, atoms: int, among: int | None = None) -> int:
        """Adds the negative literals to a set of atoms.

        Args:
            atoms: set of the atoms that hold.
            among: set of the atoms that the result is about; None: all atoms.

        Returns:
            The set with each atom in ``among`` that holds, and the negation of each that does not
            hold.
        """
        among = self._every if among is None else among
        return atoms & among | (~atoms & among) << self._every.bit_length()

    def believe(self, wrong: Wrong) -> int:
        """Returns the set of the literals about belief atoms (:class:`Grounding`) that are true for
        a person who believes the facts in ``wrong`` incorrectly."""
        atoms = self.start
        for differing, held in (self.starts[j] for j in wrong):
            atoms = atoms & ~differing | held
        return self.complete(atoms) & self.beliefs

    def imagine(self, state: int, wrong: Wrong) -> int:
        """Returns the state that a person imagines instead of the true state.

        A fact may be about the values of some atoms at the start. While all of these atoms have the
        values of the robot's start, people who believe the fact incorrectly imagine the believed
        values instead.

        Args:
            state: set of the atoms that hold in the true state.
            wrong: the facts that the person believes incorrectly.
        """
        for differing, held in (self.starts[j] for j in sorted(wrong)):
            if not (state ^ self.start) & differing & ~self.beliefs:
                state = state & ~differing | held & ~self.beliefs
        return state

    def choose(self, wrong: Wrong) -> NDArray[np.bool_]:
        """Returns [V] True for the variants that exist for a person who believes the facts in
        ``wrong`` incorrectly."""
        result, believed = np.zeros(len(self.variants), dtype=bool), self.believe(wrong)
        for guard, own in self._guards.items():
            result[own] |= not guard & ~believed
        return result


class BelievedTask:
    """A task, and the facts about it that people may believe incorrectly.

    Args:
        task: the robot's task.
        facts: the changes of each fact.
        dead_end_cost: cost of a state without a plan.
        max_states: maximum number of states.
        counts: conditions by name, for :meth:`count`.

    Attributes:
        atoms: atoms that actions can change.
        states: S states, each a set of the atoms that hold. First come the states that the robot
            reaches, beginning with the initial state. Then come the states that people with an
            incorrect belief about the start imagine instead of these. Last come all other states
            that actions of any belief reach from the states before.
        table: [S, atoms] True if an atom holds in a state.
        actions: A ground actions, (name, object, …), that occur between these states.

    Raises:
        TooLargeError: too many states, or too many facts about one action.
    """

    def __init__(
        self,
        task: Task,
        facts: Sequence[Items],
        dead_end_cost: float,
        max_states: int,
        counts: Mapping[str, Condition],
    ) -> None:
        """Grounds the task and explores its states."""
        self._task, self._facts, self._dead_end_cost = task, facts, dead_end_cost
        goals = {
            item.text: ((), [value])
            for items in (task.items, *facts)
            for item, value in items.items()
            if item.kind == "goal" and value is not None
        }
        conditions: dict[str, Condition] = {**goals, **counts}
        self._ground = ground = Grounding(task, facts, conditions)
        self.atoms, self._max_states = ground.atoms, max_states
        self._imagined = cache(self._imagine_all)
        nobody = frozenset[int]()
        robots = np.flatnonzero(np.isfinite(self._compute_costs(nobody)))
        goal = [ground.instances[text] for text in texts(task.items, "goal")]
        seeds = [ground.start & ~ground.beliefs]
        self.states, *_ = self._explore(seeds, robots, goal, ground.believe(nobody))
        self._n_robot = len(self.states)
        self._elsewhere = {j for j, (x, _) in enumerate(ground.starts) if x & ~ground.beliefs}
        for j in self._elsewhere:
            seen = [ground.imagine(state, frozenset({j})) for state in self.states]
            self.states = [*dict.fromkeys([*self.states, *seen])]
        # A state where the goal holds in every belief has no edges.
        common = [[x for x in ground.instances[text] if not x & ground.beliefs] for text in goals]
        everybody = np.arange(len(ground.variants))
        self.states, source, edges, successor = self._explore(self.states, everybody, common, 0)
        self._used, variant = np.unique(edges, return_inverse=True)
        kept, action = np.unique([ground.variants[v][0] for v in self._used], return_inverse=True)
        self.actions = [ground.actions[a] for a in kept]
        self._space = StateSpace(len(self.states), len(kept), action, source, variant, successor)
        lacking = [ground.complete(~state) for state in self.states]
        self._lacking = _pack(lacking, ground.beliefs.bit_length())
        bits = self._lacking.view(np.uint8)
        self.table = np.unpackbits(bits, 1, len(ground.atoms), "little") == 0

    def _explore(
        self,
        seeds: Sequence[int],
        allowed: NDArray[np.int64],
        goal: Sequence[Sequence[int]],
        believed: int,
    ) -> tuple[list[int], NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
        """Finds all states that actions reach from the seeds, breadth first.

        Args:
            seeds: distinct states, where the search begins.
            allowed: indices of the variants to use, ascending.
            goal: for each literal of the goal, its instances. The goal holds in a state if one
                instance of each literal holds; such a state has no edges.
            believed: set of the literals that are true in all states, because they are about belief
                atoms (:class:`Grounding`).

        Returns:
            The states, beginning with the seeds in their order; and three arrays [E], the source,
            variant and successor of each edge. Edges are sorted by source, then by variant.

        Raises:
            TooLargeError: more than ``max_states`` states.
        """
        variants = {v: self._ground.variants[v] for v in allowed.tolist()}
        beliefs, width = self._ground.beliefs, self._ground.beliefs.bit_length()
        needed = _pack([asked for _, asked, _ in variants.values()], width)
        number = {state: s for s, state in enumerate(seeds)}
        states, reported = [*seeds], monotonic()
        sources, used, successors = array("i"), array("i"), array("i")
        for done, state in enumerate(states):
            lacking = self._ground.complete(~state) & ~beliefs | beliefs & ~believed
            if not all(any(not x & lacking for x in one) for one in goal):
                able = ~(needed & _pack([lacking], width)).any(axis=1)
                for v in allowed[able].tolist():
                    adds = deletes = 0  # effects are simultaneous; an added atom is not deleted
                    for condition, added, deleted in variants[v][2]:
                        if not condition & lacking:
                            adds |= added
                            deletes |= deleted
                    after = state & ~deletes | adds
                    sources.append(done)
                    used.append(v)
                    successors.append(number.setdefault(after, len(states)))
                    if successors[-1] == len(states):
                        states.append(after)
            if len(states) > self._max_states:
                raise TooLargeError(
                    f"domain.max_states={self._max_states}: the robot's and the believed tasks "
                    "reach more states; use fewer objects, or allow more (memory and time grow "
                    "with them)"
                )
            if monotonic() > reported + EVERY:
                reported = monotonic()
                log.info("PDDL: %s of %s states found so far are explored", done + 1, len(states))
        source, variant, successor = (np.array(x, np.int32) for x in (sources, used, successors))
        return states, source, variant, successor

    def _list_items(self, wrong: Wrong) -> Items:
        return apply_changes(self._task.items, *(self._facts[j] for j in sorted(wrong)))

    def count(self, condition: str, wrong: Wrong) -> NDArray[np.int64]:
        """Computes [S] the number of instances of a condition that hold in each state.

        Args:
            condition: name of the condition.
            wrong: the facts that a person believes incorrectly; the instances hold for this person.
        """
        beliefs, known = self._ground.beliefs, self._ground.believe(wrong)
        own = [x for x in self._ground.instances[condition] if not x & beliefs & ~known]
        needed = _pack([x & ~beliefs for x in own], beliefs.bit_length())
        holds = (~(one & self._lacking).any(axis=1) for one in needed)
        return np.asarray(sum(holds, np.zeros(len(self.states), dtype=np.int64)))

    def _compute_costs(self, wrong: Wrong) -> NDArray[np.float64]:
        """Computes [V] the cost of each variant for a person who believes the facts in ``wrong``
        incorrectly; ∞ if the variant does not exist for this person, or has no cost."""
        items, cost = self._list_items(wrong), []
        for name, *objects in self._ground.actions:
            signature = items.get(Item("action", name))
            own = np.inf if signature is None else items[Item("cost", name)]
            if isinstance(own, str):
                names = [parameter for parameter, _ in signature or ()]
                function = substitute(own, dict(zip(names, objects, strict=True)))
                own = items.get(Item("function", "", function), np.inf)
            cost.append(own)
        action = [a for a, *_ in self._ground.variants]
        return np.where(self._ground.choose(wrong), np.array(cost, dtype=float)[action], np.inf)

    def _imagine_all(self, wrong: Wrong) -> NDArray[np.int64] | None:
        """Returns [S] for each state, the index of the state that a person imagines instead of it.
        States that the robot never reaches are imagined as they are. None if ``wrong`` is empty.

        Args:
            wrong: the facts about the start that the person believes incorrectly.
        """
        if not wrong:
            return None
        number = {state: s for s, state in enumerate(self.states)}
        seen = [number[self._ground.imagine(x, wrong)] for x in self.states[: self._n_robot]]
        return np.array([*seen, *range(self._n_robot, len(self.states))])

    def model(self, wrong: Wrong) -> GoalTask:
        """Makes the task of a person who believes the facts in ``wrong`` incorrectly."""
        goal = [self.count(text, wrong) > 0 for text in texts(self._list_items(wrong), "goal")]
        return GoalTask(
            space=self._space,
            cost=self._compute_costs(wrong)[self._used],
            terminal=np.all([np.ones(len(self.states), dtype=bool), *goal], axis=0),
            dead_end_cost=self._dead_end_cost,
            start=0,
            imagined=self._imagined(wrong & self._elsewhere),
        )


def _pack(sets: Sequence[int], size: int) -> NDArray[np.uint64]:
    """Returns [sets, words] the bits of sets of ``size`` literals, 64 in a word."""
    width = size // 64 * 8 + 8
    rows = b"".join(one.to_bytes(width, "little") for one in sets)
    return np.frombuffer(rows, "<u8").reshape(-1, width // 8)


def split(literals: int) -> list[int]:
    """Returns the indices of the literals in a set."""
    return [i for i in range(literals.bit_length()) if literals >> i & 1]
