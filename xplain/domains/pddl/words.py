"""Actions, atoms and facts in words that people can read."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

from xplain.domains.pddl.task import Action, Atom, Literal, Task
from xplain.errors import InputError, one_of

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
        actions = {name: action.parameters for name, action in task.actions.items()}
        lifted = {**task.predicates, **actions}
        known = {
            **{name: [str(i + 1) for i in range(n)] for name, n in task.functions.items()},
            **{name: [parameter[1:] for parameter, _ in own] for name, own in lifted.items()},
        }
        for name, template in self._given.items():
            key = f"domain.words.{one_of('domain.words', name, known, 'name')}"
            if not isinstance(template, str) or not template.strip() or "\n" in template:
                raise InputError(key, template, "a line of text")
            for used in re.findall(r"\{(.*?)\}", template):
                if used not in known[name]:
                    raise InputError(key, template, f"{used} is none of {', '.join(known[name])}")

    def atom(self, atom: Atom, action: Action | None = None) -> str:
        """Such as "a on b"; the parameters of an action by their types."""
        predicate, *arguments = atom
        told = [self._argument(argument, action) for argument in arguments]
        if predicate in self._given:
            signature = self._task.predicates.get(predicate)
            names = (
                [str(i) for i in range(1, len(told) + 1)]
                if signature is None
                else [name[1:] for name, _ in signature]
            )
            return _filled(self._given[predicate], dict(zip(names, told, strict=True)))
        if len(told) == 2 and predicate in INFIX:
            return f"{told[0]} {predicate} {told[1]}"
        return " ".join([plain(predicate), *told])

    def literal(self, literal: Literal, action: Action | None = None) -> str:
        """As :meth:`atom`, with "not" before it if it must not hold."""
        if literal.atom[0] == "=":
            left, right = (self._argument(argument, action) for argument in literal.atom[1:])
            return f"{left} {'is' if literal.positive else 'is not'} {right}"
        return ("" if literal.positive else "not ") + self.atom(literal.atom, action)

    def act(self, name: str, arguments: Sequence[str]) -> str:
        """A ground action: "pick up block a"."""
        parameters = self._task.actions[name].parameters if name in self._task.actions else ()
        if name in self._given:
            named = {p[1:]: plain(a) for (p, _), a in zip(parameters, arguments, strict=True)}
            return _filled(self._given[name], named)
        return " ".join([plain(name), *(self._typed(argument) for argument in arguments)])

    def changes(self, before: Iterable[Atom], after: Iterable[Atom]) -> tuple[str, ...]:
        """What a step made true, then what it made false: "now holding a", "no longer clear a"."""
        first, second = set(before), set(after)
        return (
            *(f"now {self.atom(atom)}" for atom in sorted(second - first)),
            *(f"no longer {self.atom(atom)}" for atom in sorted(first - second)),
        )

    def _argument(self, argument: str, action: Action | None) -> str:
        """An object's name; a parameter as "the block", or "block x" if there are several."""
        if not argument.startswith("?") or action is None:
            return plain(argument)
        kinds = dict(action.parameters)
        kind = kinds[argument]
        if kind == "object":
            return argument[1:]
        alone = list(kinds.values()).count(kind) == 1
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


def _filled(template: str, values: Mapping[str, str]) -> str:
    return re.sub(r"\{(.*?)\}", lambda match: values[match[1]], template)
