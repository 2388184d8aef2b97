"""The differences between two tasks, one fact for each, and what a fact says in words."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from xplain.domains.pddl.changes import OF_ACTIONS, Change, effect, function_term, literal
from xplain.domains.pddl.task import EQUAL, Action, Atom, Effect, Literal, Task, pddl
from xplain.domains.pddl.words import Words, gerund, plain
from xplain.errors import InputError


@dataclass(frozen=True)
class Difference:
    """One item in which two tasks differ, as a fact.

    Attributes:
        name: made from the item, such as pick_up_needs_handempty.
        change: from the robot's task to the believed one.
    """

    name: str
    change: Change


def differences(robot: Task, believed: Task, key: str) -> tuple[Difference, ...]:
    """Each item in which two tasks differ, as a fact, in a fixed order.

    Parameters of actions are compared by position, not by name.

    Raises:
        InputError: they differ in objects, types, or the parameters of an action.
    """
    if robot.objects != believed.objects or robot.parents != believed.parents:
        other = sorted(
            {*robot.objects.items(), *robot.parents.items()}
            ^ {*believed.objects.items(), *believed.parents.items()}
        )
        raise InputError(
            key, f"{other[0][0]} - {other[0][1]}", "objects and types must be the same"
        )
    found: list[Difference] = []
    for name in sorted({*robot.actions, *believed.actions}):
        own, other_action = robot.actions.get(name), believed.actions.get(name)
        if own is None or other_action is None:
            kind = "add_action" if own is None else "drop_action"
            found.append(Difference(f"can_{_slug(name)}", {kind: name}))
        else:
            found += _differences_of(own, _renamed(own, other_action, key))
    for atom in sorted(robot.initial ^ believed.initial):
        kind = "drop_initial" if atom in robot.initial else "add_initial"
        found.append(Difference(f"start_{_slug(pddl(atom))}", {kind: pddl(atom)}))
    for fact in sorted(robot.goal ^ believed.goal):
        kind = "drop_goal" if fact in robot.goal else "add_goal"
        found.append(Difference(f"goal_{_slug(str(fact))}", {kind: str(fact)}))
    for atom in sorted({*robot.values, *believed.values}):
        value = believed.values.get(atom)
        if value is None:
            raise InputError(key, pddl(atom), "a function's value is missing")
        if robot.values.get(atom) != value:
            change = {"function": pddl(atom), "value": value}
            found.append(Difference(f"value_{_slug(pddl(atom))}", change))
    return tuple(found)


def _renamed(own: Action, other: Action, key: str) -> Action:
    """The other action with the parameter names of ``own``."""
    if [kind for _, kind in own.parameters] != [kind for _, kind in other.parameters]:
        raise InputError(f"{key}.{own.name}", other.parameters, f"parameters as {own.parameters}")
    binding = {b: a for (a, _), (b, _) in zip(own.parameters, other.parameters, strict=True)}

    def renamed(item: Literal) -> Literal:
        new = item.substituted(binding)
        if new.atom[0] == EQUAL:
            return Literal((EQUAL, *sorted(new.atom[1:])), new.positive)
        return new

    return replace(
        other,
        parameters=own.parameters,
        preconditions=frozenset(map(renamed, other.preconditions)),
        effects=frozenset(
            Effect(renamed(e.literal), tuple(sorted(map(renamed, e.condition))))
            for e in other.effects
        ),
        cost=Literal(other.cost).substituted(binding).atom
        if isinstance(other.cost, tuple)
        else other.cost,
    )


def _differences_of(own: Action, other: Action) -> list[Difference]:
    action, found = _slug(own.name), []
    for item in sorted(own.preconditions ^ other.preconditions):
        kind = "drop_precondition" if item in own.preconditions else "add_precondition"
        name = f"{action}_needs_{_slug(str(item))}"
        found.append(Difference(name, {"action": own.name, kind: str(item)}))
    for made in sorted(own.effects ^ other.effects):
        kind = "drop_effect" if made in own.effects else "add_effect"
        name = f"{action}_makes_{_slug(str(made).removeprefix('(when '))}"
        found.append(Difference(name, {"action": own.name, kind: str(made)}))
    if own.cost != other.cost:
        cost = pddl(other.cost) if isinstance(other.cost, tuple) else other.cost
        found.append(Difference(f"{action}_cost", {"action": own.name, "cost": cost}))
    return found


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")


def told(task: Task, changes: Sequence[Change], words: Words) -> tuple[str, str]:
    """Two texts: what is true, and what somebody with these changes believes."""
    sentences = [_told(task, change, words) for change in changes]
    return " ".join(so for so, _ in sentences), " ".join(believed for _, believed in sentences)


def _told(task: Task, change: Change, words: Words) -> tuple[str, str]:
    ((kind, value),) = [item for item in change.items() if item[0] not in ("action", "value")]
    if kind in OF_ACTIONS:
        own = task.actions[str(change["action"]).lower()]
        subject = gerund(own.name)
        if kind == "cost":
            worths = [
                own.cost,
                function_term("", value, task, own) if isinstance(value, str) else value,
            ]
            so, believed = (_worth(worth, words, own) for worth in worths)
            return f"{subject} costs {so}.", f"{subject} costs {believed}."
        if kind.endswith("_precondition"):
            what = words.literal(literal("", value, task, own), own)
            has, lacks = f"{subject} needs: {what}.", f"{subject} does not need: {what}."
        else:
            made = effect("", value, task, own)
            what = words.literal(made.literal, own)
            if made.condition:
                what += f" (if {' and '.join(words.literal(x, own) for x in made.condition)})"
            has, lacks = f"{subject} leads to: {what}.", f"{subject} does not lead to: {what}."
    elif kind == "function":
        atom = function_term("", value, task)
        name = words.atom(atom).capitalize()
        return f"{name} is {task.values.get(atom, 0):g}.", f"{name} is {float(change['value']):g}."
    elif kind.endswith("_action"):
        name = plain(str(value))
        has, lacks = f"The robot can {name}.", f"The robot cannot {name}."
    elif kind.endswith("_goal"):
        what = words.literal(literal("", value, task, None))
        has, lacks = f"The goal needs: {what}.", f"The goal does not need: {what}."
    else:
        what = words.atom(literal("", value, task, None).atom)
        has, lacks = f"At the start: {what}.", f"At the start: not {what}."
    return (has, lacks) if kind.startswith("drop") else (lacks, has)


def _worth(cost: float | Atom, words: Words, action: Action) -> str:
    return words.atom(cost, action) if isinstance(cost, tuple) else f"{cost:g}"
