"""A planning task as items of text, which can be compared and changed."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple


class Item(NamedTuple):
    """One thing that a task says.

    Attributes:
        kind: ``action`` (its value: (name, type) of each parameter), ``precondition`` and
            ``effect`` (of an action; True), ``cost`` (of an action; a number, or the text of a
            function), ``initial`` and ``goal`` (True), ``function`` (a number).
        owner: the action's name; empty for items of the problem.
        text: the literal, the effect or the function as :func:`write` has it; empty for ``action``
            and ``cost``.
    """

    kind: str
    owner: str = ""
    text: str = ""


Items = Mapping[Item, Any]
"""Items with their values. As a change of a task, None says that there is no such item."""


@dataclass(frozen=True)
class Task:
    """A domain and a problem.

    Attributes:
        types: the domain's section of types.
        parents: the supertypes of each type.
        objects: each object's type, constants included.
        predicates, functions: the parameters of each, (name, type).
        items: all else.
    """

    types: str
    parents: Mapping[str, tuple[str, ...]]
    objects: Mapping[str, str]
    predicates: Mapping[str, tuple[tuple[str, Any], ...]]
    functions: Mapping[str, tuple[tuple[str, Any], ...]]
    items: Items

    def is_a(self, kind: str, wanted: str) -> bool:
        """Whether a type is another, or a subtype of it."""
        return wanted in (kind, "object", *self.parents[kind])


def changed(items: Items, *changes: Items) -> dict[Item, Any]:
    """The items after all changes; the last one holds."""
    result = dict(items)
    for change in changes:
        result |= change
    return {item: value for item, value in result.items() if value is not None}


def texts(items: Items, kind: str, owner: str = "") -> Iterator[str]:
    """The texts of the items of a kind that are there."""
    for item, value in items.items():
        if item[:2] == (kind, owner) and value is not None:
            yield item.text


def write(node: Any) -> str:
    """Nested lists as PDDL, such as (not (on ?x b)); conjuncts and sides of "=" are sorted."""
    if isinstance(node, str):
        return node
    parts = [write(part) for part in node]
    if parts and parts[0] in ("and", "="):
        parts[1:] = sorted(parts[1:])
    return f"({' '.join(parts)})"


def substitute(text: str, binding: Mapping[str, str]) -> str:
    """The text with its variables replaced."""
    return re.sub(r"\?[^\s()]+", lambda found: binding.get(found[0], found[0]), text)
