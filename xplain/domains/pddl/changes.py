"""Changes of a task: how a fact that people hold wrong changes it (:mod:`..task`).

A change is a mapping as YAML has it, such as ``{action: pick-up, drop_precondition: (handempty)}``;
it leads from the robot's task to what people believe.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from xplain.domains.pddl.task import EQUAL, Action, Atom, Effect, Literal, Task, pddl
from xplain.errors import InputError, Range, number

OF_ACTIONS = ("drop_precondition", "add_precondition", "drop_effect", "add_effect", "cost")
"""What a change can do to the action that it names; one at a time."""
OF_TASKS = ("drop_initial", "add_initial", "drop_goal", "add_goal", "drop_action", "add_action")
"""What else a change can do; one at a time. Another one is ``function`` with its ``value``."""
Change = Mapping[str, Any]


def expression(key: str, text: object) -> Any:
    """An expression in brackets as nested lists.

    Raises:
        InputError: brackets that do not match, or more than one expression.
    """
    allowed = "an expression such as (on ?x b), (not (clear ?x))"
    if not isinstance(text, str):
        raise InputError(key, text, allowed)
    stack: list[list[Any]] = [[]]
    for token in re.findall(r"[()]|[^\s()]+", text.lower()):
        if token == "(":
            stack.append([])
        elif token != ")":
            stack[-1].append(token)
        elif len(stack) == 1:
            raise InputError(key, text, allowed)
        else:
            stack[-2].append(stack.pop())
    if len(stack) != 1 or len(stack[0]) != 1 or not isinstance(stack[0][0], list):
        raise InputError(key, text, allowed)
    return stack[0][0]


def literal(key: str, text: object, task: Task, action: Action | None) -> Literal:
    """A literal of a task, with the parameters of an action.

    Raises:
        InputError: it is not a literal.
    """
    return _literal(key, text, expression(key, text), task, action)


def _literal(key: str, text: object, node: Any, task: Task, action: Action | None) -> Literal:
    positive = not (node and node[0] == "not")
    inner = node if positive else node[1] if len(node) == 2 else []
    if not isinstance(inner, list) or not inner or not all(isinstance(x, str) for x in inner):
        raise InputError(key, text, "a literal such as (on ?x b) or (not (clear ?x))")
    name, *arguments = inner
    if name != EQUAL and name not in task.predicates:
        raise InputError(key, text, f"unknown predicate; known: {', '.join(task.predicates)}")
    if len(arguments) != (arity := 2 if name == EQUAL else len(task.predicates[name])):
        raise InputError(key, text, f"{name} has {arity} arguments")
    own = dict(action.parameters) if action else {}
    for place, argument in enumerate(arguments):
        kind = own.get(argument) or task.objects.get(argument)
        if kind is None:
            known = ", ".join([*own, *task.objects])
            raise InputError(key, text, f"unknown argument {argument}; known: {known}")
        wanted = "object" if name == EQUAL else task.predicates[name][place][1]
        if not task.is_a(kind, wanted) and not task.is_a(wanted, kind):
            raise InputError(key, text, f"{argument} is a {kind}, {name} takes a {wanted}")
    ordered = sorted(arguments) if name == EQUAL else arguments
    return Literal((name, *ordered), positive)


def effect(key: str, text: object, task: Task, action: Action) -> Effect:
    """An effect, ``(when condition literal)`` or a literal.

    Raises:
        InputError: it is not an effect.
    """
    node = expression(key, text)
    if not node or node[0] != "when":
        return Effect(_literal(key, text, node, task, action))
    if len(node) != 3 or not isinstance(node[1], list) or not node[1]:
        raise InputError(key, text, "(when condition literal)")
    parts = node[1][1:] if node[1][0] == "and" else [node[1]]
    condition = sorted(_literal(key, text, part, task, action) for part in parts)
    return Effect(_literal(key, text, node[2], task, action), tuple(condition))


def checked(key: str, value: Any) -> tuple[Change, ...]:
    """The changes of a fact, one or a list of them, checked in form.

    Raises:
        InputError: their form is wrong.
    """
    changes = [value] if isinstance(value, Mapping) else value
    if isinstance(changes, str) or not isinstance(changes, Sequence) or not changes:
        raise InputError(key, value, "a change or a list of changes")
    for change in changes:
        keys = set(change) if isinstance(change, Mapping) else set()
        fits = (
            (len(keys) == 2 and "action" in keys and keys & set(OF_ACTIONS))
            or (len(keys) == 1 and keys & set(OF_TASKS))
            or keys == {"function", "value"}
        )
        if not fits:
            raise InputError(
                key,
                change,
                f"action with one of {', '.join(OF_ACTIONS)}; or one of {', '.join(OF_TASKS)}; or "
                "function with value",
            )
    return tuple(changes)


def applied(
    task: Task,
    changes: Sequence[Change],
    more: Mapping[str, Action],
    key: str,
    strict: bool = True,
) -> Task:
    """The task with the changes made, one after the other.

    Args:
        task: is not changed.
        changes: of :func:`checked`.
        more: actions that ``add_action`` may name.
        key: of the changes in the configuration, for errors.
        strict: whether a dropped item must exist, and an added one must not. If several facts
            change one item, only the first finds it.

    Raises:
        InputError: a change does not fit the task.
    """
    for change in changes:
        ((kind, value),) = [item for item in change.items() if item[0] not in ("action", "value")]
        at = f"{key}.{kind}"
        if kind in OF_ACTIONS:
            own = _action(f"{key}.action", change["action"], task, strict)
            if own is not None:
                new = _changed_action(at, kind, value, task, own, strict)
                task = replace(task, actions={**task.actions, own.name: new})
        elif kind == "function":
            atom = function_term(at, value, task)
            worth = positive(f"{key}.value", change["value"])
            task = replace(task, values={**task.values, atom: worth})
        elif kind.endswith("_action"):
            task = _changed_actions(at, kind, str(value).lower(), task, more, strict)
        elif kind.endswith("_goal"):
            goal = _toggled(at, kind, literal(at, value, task, None), task.goal, strict)
            task = replace(task, goal=goal)
        else:
            fact = literal(at, value, task, None)
            if not fact.positive or fact.atom[0] == EQUAL:
                raise InputError(at, value, "an atom such as (on a b)")
            task = replace(task, initial=_toggled(at, kind, fact.atom, task.initial, strict))
    return task


def _action(key: str, name: object, task: Task, strict: bool) -> Action | None:
    """The action of this name; None if another fact has dropped it."""
    if strict and (not isinstance(name, str) or name.lower() not in task.actions):
        raise InputError(key, name, f"unknown action; known: {', '.join(task.actions)}")
    return task.actions.get(str(name).lower())


def _changed_action(
    key: str, kind: str, value: Any, task: Task, own: Action, strict: bool
) -> Action:
    if kind == "cost":
        return replace(
            own,
            cost=function_term(key, value, task, own)
            if isinstance(value, str)
            else positive(key, value),
        )
    if kind.endswith("_precondition"):
        wanted = literal(key, value, task, own)
        return replace(own, preconditions=_toggled(key, kind, wanted, own.preconditions, strict))
    found = effect(key, value, task, own)
    if found.literal.atom[0] == EQUAL:
        raise InputError(key, value, "an effect on a predicate")
    return replace(own, effects=_toggled(key, kind, found, own.effects, strict))


def _changed_actions(
    key: str, kind: str, name: str, task: Task, more: Mapping[str, Action], strict: bool
) -> Task:
    known = task.actions if kind == "drop_action" else more
    if strict and name not in known:
        raise InputError(key, name, f"unknown action; known: {', '.join(known) or 'none'}")
    if kind == "drop_action":
        return replace(task, actions={k: v for k, v in task.actions.items() if k != name})
    return replace(task, actions={**task.actions, name: more[name]})


def _toggled(key: str, kind: str, item: Any, items: frozenset[Any], strict: bool) -> frozenset[Any]:
    adds = kind.startswith("add")
    if strict and (item in items) == adds:
        shown = sorted(pddl(x) if isinstance(x, tuple) else str(x) for x in items)
        text = "exists already" if adds else f"does not exist; known: {', '.join(shown) or 'none'}"
        raise InputError(key, pddl(item) if isinstance(item, tuple) else str(item), text)
    return items | {item} if adds else items - {item}


def function_term(key: str, text: object, task: Task, action: Action | None = None) -> Atom:
    """A function with its arguments, such as (distance ?a b).

    Raises:
        InputError: the task does not have it.
    """
    node = expression(key, text)
    own = dict(action.parameters) if action else {}
    if not node or node[0] not in task.functions:
        raise InputError(
            key, text, f"unknown function; known: {', '.join(task.functions) or 'none'}"
        )
    if len(node) - 1 != task.functions[node[0]] or not all(
        isinstance(x, str) and (x in task.objects or x in own) for x in node[1:]
    ):
        raise InputError(key, text, f"{node[0]} with {task.functions[node[0]]} known arguments")
    return tuple(node)


def positive(key: str, value: object) -> float:
    return number(key, value, Range(0, ends="(]"))
