"""Features of states that YAML names: the number of ways in which a pattern holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from xplain.domains.pddl.changes import expression
from xplain.domains.pddl.task import Atom, Task
from xplain.errors import InputError


def counts(
    key: str,
    patterns: str | Sequence[str],
    task: Task,
    number: Mapping[Atom, int],
    table: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """[S] the number of ways to replace the parameters so that all patterns hold.

    Args:
        key: of the feature in the configuration, for errors.
        patterns: atoms such as (on ?x b).
        task: the robot's.
        number: the column in the table of each atom that can change.
        table: [S, atoms] whether each atom holds.

    Raises:
        InputError: a pattern is not an atom of the task.
    """
    listed = [patterns] if isinstance(patterns, str) else patterns
    if not isinstance(listed, Sequence) or not listed:
        raise InputError(key, patterns, "an atom such as (on ?x b), or a list of them")
    wanted = []
    for text in listed:
        node = expression(key, text)
        if not node or not all(isinstance(x, str) for x in node) or node[0] not in task.predicates:
            known = ", ".join(task.predicates)
            raise InputError(key, text, f"an atom of one of the predicates {known}")
        if len(node) - 1 != len(task.predicates[node[0]]):
            raise InputError(key, text, f"{node[0]} has {len(task.predicates[node[0]])} arguments")
        for argument in node[1:]:
            if not argument.startswith("?") and argument not in task.objects:
                raise InputError(key, text, f"unknown object {argument}")
        wanted.append(tuple(node))
    result = np.zeros(len(table), dtype=np.int64)
    for columns in _ways(wanted, {}, sorted({*number, *task.initial}), number):
        result += table[:, columns].all(axis=1)
    return result


def _ways(
    patterns: Sequence[Atom], binding: Mapping[str, str], atoms: Sequence[Atom],
    number: Mapping[Atom, int],
) -> Iterator[list[int]]:  # fmt: skip
    """The columns that must hold, for each way of replacing the parameters."""
    if not patterns:
        yield []
        return
    for atom in atoms:
        more = _matched(patterns[0], atom, binding)
        if more is not None:
            for columns in _ways(patterns[1:], more, atoms, number):
                # Atoms that never change are here only if they hold in all states.
                yield ([number[atom]] if atom in number else []) + columns


def _matched(pattern: Atom, atom: Atom, binding: Mapping[str, str]) -> dict[str, str] | None:
    """The binding that turns the pattern into this atom; None if there is none."""
    if pattern[0] != atom[0]:
        return None
    more = dict(binding)
    for asked, given in zip(pattern[1:], atom[1:], strict=True):
        if not asked.startswith("?"):
            if asked != given:
                return None
        elif more.setdefault(asked, given) != given:
            return None
    return more
