"""Ground actions of a task under every combination of the facts that affect them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from xplain.domains.pddl.changes import Change, applied
from xplain.domains.pddl.task import EQUAL, Action, Atom, Literal, Task, pddl, substituted
from xplain.errors import TooLargeError, XplainError

MAX_VARIANTS = 200_000
"""Most ground actions, each counted once for every combination of facts about its schema."""
Atoms = tuple[Atom, ...]


@dataclass(frozen=True)
class Ground:
    """Preconditions and effects of a ground action; sorted, and only atoms that can change.

    Attributes:
        holds, lacks: atoms that must hold, or must not.
        effects: (holds, lacks, adds, deletes) of each condition.
    """

    holds: Atoms
    lacks: Atoms
    effects: tuple[tuple[Atoms, Atoms, Atoms, Atoms], ...]


class Grounding:
    """A task and its facts, grounded.

    Args:
        task: the robot's.
        facts: the changes of each.
        more: actions that changes may add.

    Attributes:
        actions: A ground actions, (schema, object, …), in the order of the files.
        variants: V of them, an action as some belief has it; ``action`` [V] is the action of each.
        atoms: those that can change, sorted.
        changing: their predicates.

    Raises:
        XplainError: the function that is the cost of an action has no value, or not a positive one.
        TooLargeError: more than MAX_VARIANTS.
    """

    def __init__(
        self,
        task: Task,
        facts: Sequence[Sequence[Change]],
        more: Mapping[str, Action],
    ) -> None:
        """Grounds every schema once for each combination of the facts that affect it."""
        self._facts = facts
        self.task_of = cache(lambda wrong: self._task_of(task, wrong, more))
        tasks = [task, *(self.task_of(frozenset({j})) for j in range(len(facts)))]
        self.changing = {
            effect.literal.atom[0]
            for some in tasks
            for action in some.actions.values()
            for effect in action.effects
        }
        names = dict.fromkeys(name for some in tasks for name in some.actions)
        self._relevant = {
            name: [j for j in range(len(facts)) if self._bears(tasks, j, name)] for name in names
        }
        tables = {
            (name, wrong): self._ground(self.task_of(wrong), name)
            for name, own in self._relevant.items()
            for wrong in _subsets(own)
        }
        possible = self._possible(tables, [some.initial for some in tasks])
        self._number(tables, possible, tasks)

    def _task_of(self, task: Task, wrong: frozenset[int], more: Mapping[str, Action]) -> Task:
        for j in sorted(wrong):
            task = applied(task, self._facts[j], more, "", strict=False)
        return task

    def _bears(self, tasks: Sequence[Task], fact: int, name: str) -> bool:
        """Whether a fact changes the ground actions of a schema, their effects or their costs."""
        before, after = tasks[0], tasks[fact + 1]
        if before.actions.get(name) != after.actions.get(name):
            return True
        versions = [task.actions[name] for task in tasks if name in task.actions]
        asked = {x.atom[0] for action in versions for x in action.conditions()} - self.changing
        if any(atom[0] in asked for atom in before.initial ^ after.initial):
            return True
        functions = {action.cost[0] for action in versions if isinstance(action.cost, tuple)}
        changed = before.values.items() ^ after.values.items()
        return any(atom[0] in functions for atom, _ in changed)

    def _ground(self, task: Task, name: str) -> dict[tuple[str, ...], tuple[Ground, float]]:
        """Preconditions, effects and cost of each ground action of a schema, by its objects."""
        found: dict[tuple[str, ...], tuple[Ground, float]] = {}
        action = task.actions.get(name)
        if action is None:
            return found
        for binding in _bindings(task, action, self.changing):
            made = self._made(task, action, binding)
            if made is not None:
                found[tuple(binding.values())] = made, _cost(task, action, binding)
                if len(found) > MAX_VARIANTS:
                    raise _too_many()
        return found

    def _made(self, task: Task, action: Action, binding: Mapping[str, str]) -> Ground | None:
        """None if its preconditions never hold."""
        needs = self._split(task, (x.substituted(binding) for x in action.preconditions))
        if needs is None:
            return None
        effects: dict[tuple[Atoms, Atoms], tuple[set[Atom], set[Atom]]] = {}
        for effect in action.effects:
            condition = self._split(task, (x.substituted(binding) for x in effect.condition))
            if condition is not None:
                literal = effect.literal.substituted(binding)
                effects.setdefault(condition, (set(), set()))[0 if literal.positive else 1].add(
                    literal.atom
                )
        done = tuple((*c, *(tuple(sorted(x)) for x in e)) for c, e in sorted(effects.items()))
        return Ground(*needs, done)  # type: ignore[arg-type]

    def _split(self, task: Task, literals: Iterator[Literal]) -> tuple[Atoms, Atoms] | None:
        """The atoms that must hold and must not, without those that never change. None if one of
        these contradicts it, or two literals contradict each other."""
        holds: set[Atom] = set()
        lacks: set[Atom] = set()
        for literal in literals:
            if literal.atom[0] in self.changing:
                (holds if literal.positive else lacks).add(literal.atom)
            elif static_holds(task, literal) is False:
                return None
        return None if holds & lacks else (tuple(sorted(holds)), tuple(sorted(lacks)))

    @staticmethod
    def _possible(
        tables: Mapping[tuple[str, frozenset[int]], Mapping[tuple[str, ...], tuple[Ground, float]]],
        initial: Sequence[frozenset[Atom]],
    ) -> dict[tuple[tuple[str, ...], Ground], None]:
        """The (ground action, effects) that can happen if nothing is ever deleted."""
        waiting = dict.fromkeys(
            ((name, *objects), made)
            for (name, _), table in tables.items()
            for objects, (made, _) in table.items()
        )
        if len(waiting) > MAX_VARIANTS:
            raise _too_many()
        reached = {atom for atoms in initial for atom in atoms}
        possible: dict[tuple[tuple[str, ...], Ground], None] = {}
        while True:
            before = len(reached), len(possible)
            for one in list(waiting):
                if reached.issuperset(one[1].holds):
                    possible[one] = None
                    del waiting[one]
            for _, made in possible:
                for holds, _, adds, _ in made.effects:
                    if reached.issuperset(holds):
                        reached.update(adds)
            if (len(reached), len(possible)) == before:
                return possible

    def _number(self, tables, possible, tasks) -> None:  # type: ignore[no-untyped-def]
        """Numbers actions, variants and atoms."""
        order = {name: i for i, name in enumerate(self._relevant)}
        self.actions = tuple(
            sorted({action for action, _ in possible}, key=lambda a: (order[a[0]], a))
        )
        number = {action: i for i, action in enumerate(self.actions)}
        listed = sorted(possible, key=lambda one: number[one[0]])
        variant = {one: i for i, one in enumerate(listed)}
        self.variants = tuple(made for _, made in listed)
        self.action = np.array([number[action] for action, _ in listed], dtype=np.int32)
        self._choices = {}
        for (name, wrong), table in tables.items():
            rows = [
                (number[action], variant[action, made], cost)
                for objects, (made, cost) in table.items()
                if ((action := (name, *objects)), made) in variant
            ]
            self._choices[name, wrong] = rows
        atoms = {atom for task in tasks for atom in task.initial if atom[0] in self.changing}
        for made in self.variants:
            atoms.update(made.holds)
            for _, _, adds, deletes in made.effects:
                atoms.update(adds, deletes)
        atoms.update(x.atom for task in tasks for x in task.goal if x.atom[0] in self.changing)
        self.atoms = tuple(sorted(atoms))

    def chosen(self, wrong: frozenset[int]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """For somebody who holds these facts wrong, [A] the variant of each action (−1: none) and
        [A] its cost (1 where there is none)."""
        variant = np.full(len(self.actions), -1, dtype=np.int64)
        cost = np.ones(len(self.actions))
        for name, own in self._relevant.items():
            for action, number, price in self._choices[name, wrong & frozenset(own)]:
                variant[action], cost[action] = number, price
        return variant, cost


def static_holds(task: Task, literal: Literal) -> bool | None:
    """Whether a literal that never changes holds; None while a parameter is not replaced."""
    if any(argument.startswith("?") for argument in literal.atom[1:]):
        return None
    if literal.atom[0] == EQUAL:
        return (literal.atom[1] == literal.atom[2]) == literal.positive
    return (literal.atom in task.initial) == literal.positive


def _cost(task: Task, action: Action, binding: Mapping[str, str]) -> float:
    """The cost of a ground action.

    Raises:
        XplainError: it is a function whose value is not positive, or not given.
    """
    if not isinstance(action.cost, tuple):
        return action.cost
    term = substituted(action.cost, binding)
    cost = task.values.get(term, 0.0)
    if cost <= 0:
        value = f"{cost:g}" if term in task.values else "not given"
        raise XplainError(
            f"domain.problem: the action {' '.join([action.name, *binding.values()])} costs "
            f"{pddl(term)}, which is {value}; every cost must be > 0"
        )
    return cost


def _bindings(task: Task, action: Action, changing: set[str]) -> Iterator[dict[str, str]]:
    """Objects for the parameters with which the preconditions that never change hold."""
    static = [x for x in action.preconditions if x.atom[0] not in changing]
    objects = [task.of_type(kind) for _, kind in action.parameters]
    binding: dict[str, str] = {}

    def extend(place: int) -> Iterator[dict[str, str]]:
        if place == len(objects):
            yield dict(binding)
            return
        name = action.parameters[place][0]
        asked = [x for x in static if name in x.atom]
        for candidate in objects[place]:
            binding[name] = candidate
            if all(static_holds(task, x.substituted(binding)) is not False for x in asked):
                yield from extend(place + 1)
        binding.pop(name, None)

    if all(static_holds(task, x) is not False for x in static):
        yield from extend(0)


def _subsets(items: Sequence[int]) -> Iterator[frozenset[int]]:
    if len(items) > 12:
        raise TooLargeError(
            f"domain: {len(items)} facts affect one action; at most 12 can be combined"
        )
    for mask in range(1 << len(items)):
        yield frozenset(item for i, item in enumerate(items) if mask >> i & 1)


def _too_many() -> TooLargeError:
    return TooLargeError(
        f"domain: more than {MAX_VARIANTS} ground actions; use fewer objects, or narrower types"
    )
