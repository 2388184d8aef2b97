"""A lifted planning task: the content of its files, as plain values that can be compared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

Atom = tuple[str, ...]
"""A predicate (or a function) and its arguments: objects, or parameters such as ``?x``."""
EQUAL = "="


def pddl(atom: Atom) -> str:
    """As PDDL writes it: "(on ?x b)"."""
    return f"({' '.join(atom)})"


def substituted(atom: Atom, binding: Mapping[str, str]) -> Atom:
    """The atom with its parameters replaced."""
    return (atom[0], *(binding.get(argument, argument) for argument in atom[1:]))


@dataclass(frozen=True, order=True)
class Literal:
    """An atom that must hold, or must not hold."""

    atom: Atom
    positive: bool = True

    def __str__(self) -> str:
        return pddl(self.atom) if self.positive else f"(not {pddl(self.atom)})"

    def substituted(self, binding: Mapping[str, str]) -> Literal:
        """The literal with its parameters replaced."""
        return Literal(substituted(self.atom, binding), self.positive)


@dataclass(frozen=True, order=True)
class Effect:
    """What an action makes true or false if all of ``condition`` (sorted) held before."""

    literal: Literal
    condition: tuple[Literal, ...] = ()

    def __str__(self) -> str:
        if not self.condition:
            return str(self.literal)
        one = " ".join(map(str, self.condition))
        return f"(when {one if len(self.condition) == 1 else f'(and {one})'} {self.literal})"


@dataclass(frozen=True)
class Action:
    """An action schema.

    Attributes:
        parameters: (name, type) of each; names begin with ``?``.
        preconditions: all must hold.
        effects: all that apply happen at once; an atom that is added and deleted is added.
        cost: a number, or a function (with arguments) whose initial value is the cost.
    """

    name: str
    parameters: tuple[tuple[str, str], ...]
    preconditions: frozenset[Literal]
    effects: frozenset[Effect]
    cost: float | Atom

    def conditions(self) -> Iterator[Literal]:
        """Preconditions and conditions of effects."""
        yield from self.preconditions
        for effect in self.effects:
            yield from effect.condition


@dataclass(frozen=True)
class Task:
    """A domain and a problem.

    Attributes:
        parents: each type's supertype; "" for those that have none.
        objects: each object's type, constants included.
        predicates: each predicate's parameters, (name, type).
        functions: the number of arguments of each function that a cost may use.
        actions: by name.
        initial: the atoms that hold at the start.
        values: of functions; they never change.
        goal: all must hold.
    """

    parents: Mapping[str, str]
    objects: Mapping[str, str]
    predicates: Mapping[str, tuple[tuple[str, str], ...]]
    functions: Mapping[str, int]
    actions: Mapping[str, Action]
    initial: frozenset[Atom]
    values: Mapping[Atom, float]
    goal: frozenset[Literal]

    def is_a(self, object_type: str, wanted: str) -> bool:
        """Whether a type is another, or a subtype of it."""
        while object_type and object_type != wanted:
            object_type = self.parents.get(object_type, "")
        return object_type == wanted or wanted == "object"

    def of_type(self, wanted: str) -> tuple[str, ...]:
        """The objects of a type, in the order of the files."""
        return tuple(name for name, own in self.objects.items() if self.is_a(own, wanted))
