"""Facts that people may believe incorrectly: changes from the robot's task to the believed one,
their names, and their descriptions in words.

A change is a mapping in YAML, such as ``{action: pick-up, drop_precondition: (handempty)}``.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from xplain.domains.pddl.task import (
    Item,
    Items,
    Source,
    Task,
    apply_changes,
    declare,
    read_text,
    write,
)
from xplain.errors import InputError, Range, number, one_of

Atom = tuple[str, ...]
INFIX = ("above", "at", "behind", "below", "beside", "in", "inside", "near", "on", "under")
"""Predicates that are written between their two arguments."""


class Words:
    """Describes a task in words.

    Args:
        task: the task.
        given: templates, ``{predicate, function or action: "{x} is on {y}"}``, with parameters in
            braces by their names in the domain. Names without a template are described as in "clear
            a", "a on b", "pick up block a".

    Raises:
        InputError: a template for a name that the task does not have, or with an unknown parameter.
    """

    def __init__(self, task: Task, given: Mapping[str, str]) -> None:
        """Checks the templates."""
        self._task, self._objects = task, dict(task.objects)
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
        """Fills the template of a predicate, function or action with arguments. Returns None if
        there is no template for this name."""
        values = dict(zip(self._names.get(name, ()), arguments, strict=False))
        template = self._given.get(name)
        return template and re.sub(r"\{(.*?)\}", lambda match: values[match[1]], template)

    def atom(self, atom: Atom, action: str = "") -> str:
        """Describes an atom, such as "a on b".

        Args:
            atom: (predicate, argument, …).
            action: name of the action that the atom is part of, if any. The action's parameters are
                described by their types, such as "the block on b".
        """
        name, *arguments = atom
        words = [self._describe_argument(argument, action) for argument in arguments]
        infix = len(words) == 2 and name in INFIX
        plainly = [words[0], name, words[1]] if infix else [plain(name), *words]
        return self._fill(name, words) or " ".join(plainly)

    def literal(self, text: str, action: str = "") -> str:
        """Describes a literal or a conditional effect, such as "not a on b (if holding c)": a
        negated literal begins with "not", and the conditions of an effect follow in parentheses.

        Args:
            text: the literal or the effect in PDDL.
            action: name of the action that it is part of, as in :meth:`atom`.
        """
        words = []
        for negation, atom in re.findall(r"(\(not )?\(([^?()][^()]*)\)", text):
            name, *arguments = atom.split()
            if name == "=":
                left, right = (self._describe_argument(argument, action) for argument in arguments)
                words.append(f"{left} is {'not ' if negation else ''}{right}")
            else:
                said = self.atom((name, *arguments), action)
                words.append(f"not {said}" if negation else said)
        if text.startswith(("(or", "(exists")):
            return (" or " if "(or" in text else " and ").join(words)
        *conditions, last = words
        return last + (f" (if {' and '.join(conditions)})" if conditions else "")

    def describe(self, item: Item, robots: Any, believed: Any) -> tuple[str, str]:
        """Describes the difference between two tasks in one item.

        Args:
            item: the item.
            robots: value of the item in the robot's task; None if the task does not have the item.
            believed: value of the item in the believed task; None if the task does not have the
                item.

        Returns:
            A sentence about the robot's task, and a sentence about the believed task.
        """
        kind, action, text = item
        subject = f"The action {plain(action)}" if action else "The goal"
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
        """Describes a ground action: "pick up block a"."""
        typed = " ".join([plain(name), *map(self._describe_object, arguments)])
        return self._fill(name, [*map(plain, arguments)]) or typed

    def changes(self, before: Iterable[Atom], after: Iterable[Atom]) -> tuple[str, ...]:
        """Describes the effects of a transition: first each atom that became true ("now holding
        a"), then each atom that became false ("no longer clear a").

        Args:
            before, after: the atoms that hold before and after the transition.
        """
        first, second = set(before), set(after)
        return (
            *(f"now {self.atom(atom)}" for atom in sorted(second - first)),
            *(f"no longer {self.atom(atom)}" for atom in sorted(first - second)),
        )

    def _describe_argument(self, argument: str, action: str) -> str:
        """Describes an argument of an atom: an object by its name; a parameter of the action by its
        type, as "the block", or as "block x" if several parameters have this type."""
        kinds = dict(self._task.items.get(Item("action", action), ()))
        kind = kinds.get(argument, "object")
        if kind == "object":
            return plain(argument.removeprefix("?"))
        alone = [*kinds.values()].count(kind) == 1
        return f"the {plain(kind)}" if alone else f"{plain(kind)} {argument[1:]}"

    def _describe_object(self, name: str) -> str:
        """Describes an object by its type and name, as in "block a". A name that contains the type,
        such as truck1, stays unchanged."""
        kind = self._objects[name]
        return plain(name) if kind == "object" or kind in name else f"{plain(kind)} {plain(name)}"


def plain(name: str) -> str:
    """Replaces hyphens and underscores in a name by spaces."""
    return name.replace("-", " ").replace("_", " ")


Change = Mapping[str, Any]
OF_ACTIONS = ("drop_precondition", "add_precondition", "drop_effect", "add_effect", "cost")
"""Kinds of change of a named action; each change of an action has one of these kinds."""
OF_TASKS = ("drop_initial", "add_initial", "drop_goal", "add_goal", "drop_action", "add_action")
"""Other kinds of change; any other change has one of these kinds, or is ``function`` with its
``value``."""
NAMES = {
    "action": "can_{0}",
    "precondition": "{0}_needs_{1}",
    "effect": "{0}_makes_{1}",
    "cost": "{0}_cost",
    "initial": "start_{1}",
    "goal": "goal_{1}",
    "function": "value_{1}",
}
"""Patterns for names of differences: {0} is the action, {1} the expression. Facts come in the order
of these kinds."""


def read_changes(key: str, value: Any, task: Task, other: Items) -> Items:
    """Reads the changes of a fact from the configuration.

    Args:
        key: the configuration key, for errors.
        value: one change, or a list of changes.
        task: the robot's task.
        other: items of a believed task, whose actions ``add_action`` may name.

    Returns:
        The items that differ from the robot's task, with their believed values (None: removed).

    Raises:
        InputError: a change has an invalid form, or does not fit the task.
    """
    listed = [value] if isinstance(value, Mapping) else value
    if isinstance(listed, str) or not isinstance(listed, Sequence) or not listed:
        raise InputError(key, value, "a change or a list of changes")
    made: dict[Item, Any] = {}
    for change in listed:
        fields = set(change) if isinstance(change, Mapping) else set()
        kind = next(iter(fields - {"action", "value"}), "")
        beside = {"action"} if kind in OF_ACTIONS else {"value"} if kind == "function" else set()
        if kind not in (*OF_ACTIONS, *OF_TASKS, "function") or fields != {kind, *beside}:
            allowed = (
                f"action with one of {', '.join(OF_ACTIONS)}; or one of {', '.join(OF_TASKS)}; or "
                "function with value"
            )
            raise InputError(key, change, allowed)
        present = replace(task, items=apply_changes(task.items, made))
        made |= _read_change(key, kind, change, present, other)
    return made


def _read_change(key: str, kind: str, change: Change, task: Task, other: Items) -> Items:
    """Reads one change of the task. Returns the items that the change adds, replaces or removes,
    with their new values (None: removed).

    Args:
        key: the configuration key, for errors.
        kind: kind of change, such as ``drop_precondition``.
        change: the change.
        task: the task before this change.
        other: items of a believed task, whose actions ``add_action`` may name.
    """
    source = Source(f"{key}.{kind}", change[kind], str(change[kind]).lower())
    owner = str(change.get("action", "")).lower()
    if owner:
        one_of(f"{key}.action", owner, _list_actions(task.items), "action")
    does, _, what = kind.partition("_")
    if what == "action":
        there = task.items if does == "drop" else other
        name = one_of(source.key, source.text, _list_actions(there), "action")
        own = {Item("action", name): None} if does == "drop" else there.items()
        return {item: value for item, value in dict(own).items() if item.owner == name}
    signature = task.items.get(Item("action", owner), ())
    functions = replace(task, predicates=task.functions)
    if kind == "cost" and not isinstance(change[kind], str):
        return {Item(kind, owner): number(source.key, change[kind], Range(0))}
    of_values = kind in ("cost", "function")
    found = read_text(functions if of_values else task, signature, source, what == "effect")
    text = write(found)
    if kind == "cost":
        return {Item(kind, owner): text}
    if kind == "function":
        value = change["value"]
        return {Item(kind, "", text): value if value is None else number(key, value, Range(0))}
    item = Item(what, owner, text)
    if what == "initial" and item.text.startswith("(not"):
        raise InputError(source.key, source.value, "an atom such as (on a b)")
    if (item in task.items) == (does == "add"):
        known = sorted(x.text for x in task.items if x[:2] == item[:2])
        absent = f"does not exist; known: {', '.join(known) or 'none'}"
        raise InputError(source.key, item.text, "exists already" if does == "add" else absent)
    return {item: found if does == "add" else None}


def _list_actions(items: Items) -> list[str]:
    return [item.owner for item in items if item.kind == "action"]


def find_differences(robot: Task, believed: Task, key: str) -> Mapping[str, Items]:
    """Finds the differences between the robot's task and a believed task.

    Usually each item that differs is one difference. Several items are one difference in three
    cases:

    - the items of an action that only one of the tasks has;
    - the items that contain a predicate that only one of the tasks has;
    - a value of a function and an initial atom with the same arguments, if only one of the tasks
      has the value and only this task has the atom.

    Args:
        robot, believed: the two tasks.
        key: the configuration key of the believed task, for errors.

    Returns:
        For each difference, by a unique name such as pick_up_needs_handempty: its items with their
        believed values (None: the believed task does not have the item).

    Raises:
        InputError: the tasks differ in objects, types, or the parameters of an action.
    """
    kinds = ({(x.name, x.basetype_name) for x in y.found.types} for y in (robot, believed))
    for ours, theirs in (({*robot.objects}, {*believed.objects}), kinds):
        if other := sorted(name for name, _ in ours ^ theirs):
            raise InputError(key, other[0], "objects and types must be the same")
    items = believed.items
    for item in (x for x in robot.items if x.kind == "action" and x in items):
        robots, others = (declare(x.items[item]) for x in (robot, believed))
        allowed = f"the robot's parameters: {robots}"
        if robots != others:
            raise InputError(f"{key}.{item.owner}", others, allowed)
    unknown = {*robot.predicates} ^ {*believed.predicates}
    both = {*_list_actions(robot.items)} & {*_list_actions(items)} | {""}
    found: dict[str, dict[Item, Any]] = {}
    names: dict[Any, str] = {}
    order = [*NAMES]
    every = sorted({*robot.items, *items}, key=lambda x: (not x.owner, x[1], order.index(x[0]), x))
    for item in every:
        old, new = robot.items.get(item), items.get(item)
        same = old == new if item.kind in ("cost", "function") else (old is None) == (new is None)
        if same or (item.owner not in both and item.kind != "action"):
            continue
        more = {x: v for x, v in items.items() if old is None and x.owner == item.owner}
        made = {item: new} | (more if item.kind == "action" else {})
        name = _make_name(item, found)
        words = set(re.findall(r"[^\s()]+", " ".join(x.text for x in made)))
        keys = [*sorted(words & unknown), (item.text.partition(" ")[2], old is None, new is None)]
        if item.kind == "function" or len(keys) > 1:
            name = next((names[key] for key in keys if key in names), name)
        names |= dict.fromkeys(keys if item.kind == "initial" else keys[:-1], name)
        found.setdefault(name, {}).update(made)
    return found


def _make_name(item: Item, taken: Mapping[str, Any]) -> str:
    """Makes a name for the difference in an item. A number is added if the name is in ``taken``."""
    parts = (re.sub(r"[^a-z0-9]+", "_", text).strip("_") for text in (item.owner, item.text))
    owner, text = parts
    name = NAMES[item.kind].format(owner, text.removeprefix("when_"))
    others = sum(re.fullmatch(rf"{name}(_\d+)?", x) is not None for x in taken)
    return f"{name}_{others + 1}" if others else name


def describe(task: Task, fact: Items, words: Words) -> tuple[str, str]:
    """Describes a fact in words.

    Args:
        task: the robot's task.
        fact: the items that the fact changes, with their believed values.
        words: describes each item.

    Returns:
        A text that is true in the robot's task, and a text that is true in the believed task.
    """
    pairs = [
        words.describe(item, task.items.get(item), value)
        for item, value in fact.items()
        if item.kind == "action" or Item("action", item.owner) not in fact
    ]
    return " ".join(true for true, _ in pairs), " ".join(believed for _, believed in pairs)
