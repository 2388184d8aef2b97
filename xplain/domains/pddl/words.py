"""Actions, atoms and facts in words that people can read."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from xplain.domains.pddl.task import Item, Task
from xplain.errors import InputError, one_of

Atom = tuple[str, ...]
INFIX = ("above", "at", "behind", "below", "beside", "in", "inside", "near", "on", "under")
"""Predicates that stand between their two arguments, because they read better so."""


class Words:
    """A task in words.

    Args:
        task: its names are put in words.
        given: templates, ``{predicate, function or action: "{x} is on {y}"}``, parameters in
            braces by their names in the domain. Those not given are made from the names:
            "clear a", "a on b", "pick up block a".

    Raises:
        InputError: a template for a name that the task does not have, or with an unknown parameter.
    """

    def __init__(self, task: Task, given: Mapping[str, str]) -> None:
        """Checks the templates."""
        self._task = task
        self._given = {str(name).lower(): template for name, template in given.items()}
        self._names = {
            **{name: [str(i + 1) for i in range(len(x))] for name, x in task.functions.items()},
            **{name: [x[1:] for x, _ in typed] for name, typed in task.predicates.items()},
            **{x.owner: [y[1:] for y, _ in v] for x, v in task.items.items() if x.kind == "action"},
        }
        for name, template in self._given.items():
            key = f"domain.words.{one_of('domain.words', name, self._names, 'name')}"
            if not isinstance(template, str) or not template.strip() or "\n" in template:
                raise InputError(key, template, "a line of text")
            for used in re.findall(r"\{(.*?)\}", template):
                if used not in self._names[name]:
                    allowed = f"{used} is none of {', '.join(self._names[name])}"
                    raise InputError(key, template, allowed)

    def _fill(self, name: str, arguments: Sequence[str]) -> str | None:
        """The template of a name with its arguments; None if there is none."""
        values = dict(zip(self._names.get(name, ()), arguments, strict=False))
        template = self._given.get(name)
        return template and re.sub(r"\{(.*?)\}", lambda match: values[match[1]], template)

    def atom(self, atom: Atom, action: str = "") -> str:
        """Such as "a on b"; the parameters of an action by their types."""
        name, *arguments = atom
        words = [self._argument(argument, action) for argument in arguments]
        infix = len(words) == 2 and name in INFIX
        plainly = [words[0], name, words[1]] if infix else [plain(name), *words]
        return self._fill(name, words) or " ".join(plainly)

    def literal(self, text: str, action: str = "") -> str:
        """As :meth:`atom`, with "not" before it if it must not hold; the last literal of an effect,
        with its conditions after it."""
        *conditions, last = re.findall(r"(\(not )?\(([^()]+)\)", text)
        atom = last[1].split()
        if atom[0] == "=":
            left, right = (self._argument(argument, action) for argument in atom[1:])
            words = f"{left} {'is not' if last[0] else 'is'} {right}"
        else:
            words = ("not " if last[0] else "") + self.atom(tuple(atom), action)
        asked = " and ".join(self.literal(f"{x}({y})", action) for x, y in conditions)
        return words + (f" (if {asked})" if asked else "")

    def describe(self, item: Item, robots: Any, believed: Any) -> tuple[str, str]:
        """What the robot knows of an item, and what people believe, as two sentences."""
        kind, action, text = item
        subject = gerund(action) if action else "The goal"
        if kind in ("cost", "function"):
            name = self.literal(text).capitalize() if text else subject
            values = (
                self.literal(x, action)
                if isinstance(x, str)
                else "unknown"
                if x is None
                else f"{x:g}"
                for x in (robots, believed)
            )
            true, false = (f"{name} {'is' if text else 'costs'} {x}." for x in values)
            return true, false
        what = self.literal(text, action) if text else plain(action)
        has, lacks = {
            "action": (f"The robot can {what}.", f"The robot cannot {what}."),
            "effect": (f"{subject} leads to: {what}.", f"{subject} does not lead to: {what}."),
            "initial": (f"At the start: {what}.", f"At the start: not {what}."),
        }.get(kind, (f"{subject} needs: {what}.", f"{subject} does not need: {what}."))
        return (has, lacks) if believed is None else (lacks, has)

    def act(self, name: str, arguments: Sequence[str]) -> str:
        """A ground action: "pick up block a"."""
        typed = " ".join([plain(name), *map(self._typed, arguments)])
        return self._fill(name, [*map(plain, arguments)]) or typed

    def changes(self, before: Iterable[Atom], after: Iterable[Atom]) -> tuple[str, ...]:
        """What a step made true, then what it made false: "now holding a", "no longer clear a"."""
        first, second = set(before), set(after)
        return (
            *(f"now {self.atom(atom)}" for atom in sorted(second - first)),
            *(f"no longer {self.atom(atom)}" for atom in sorted(first - second)),
        )

    def _argument(self, argument: str, action: str) -> str:
        """An object's name; a parameter as "the block", or "block x" if there are several."""
        kinds = dict(self._task.items.get(Item("action", action), ()))
        kind = kinds.get(argument, "object")
        if kind == "object":
            return plain(argument.removeprefix("?"))
        alone = [*kinds.values()].count(kind) == 1
        return f"the {plain(kind)}" if alone else f"{plain(kind)} {argument[1:]}"

    def _typed(self, name: str) -> str:
        """ "block a"; a name that says its type, such as truck1, stands alone."""
        kind = self._task.objects[name]
        return plain(name) if kind == "object" or kind in name else f"{plain(kind)} {plain(name)}"


def plain(name: str) -> str:
    """A name without hyphens and underscores."""
    return name.replace("-", " ").replace("_", " ")


def gerund(name: str) -> str:
    """An action's name as a subject: "Picking up"."""
    first, *rest = plain(name).split()
    if re.search(r"[^aeiou]e$|ue$", first) and first != "be":
        stem = first[:-1]
    elif re.fullmatch(r"[^aeiou]*[aeiou][^aeiouwxy]", first):
        stem = first + first[-1]
    else:
        stem = first
    return " ".join([f"{stem}ing", *rest]).capitalize()
