"""Features of states that YAML names: the number of ways in which a pattern holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

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
    atoms = sorted({*number, *task.initial})
    for chosen in product(*([atom for atom in atoms if atom[0] == x[0]] for x in wanted)):
        if _match(wanted, chosen):
            # Atoms that never change are here only if they hold in all states.
            columns = [number[atom] for atom in chosen if atom in number]
            result += table[:, columns].all(axis=1)
    return result


def _match(patterns: Sequence[Atom], atoms: Sequence[Atom]) -> bool:
    """Whether one binding of the parameters turns each pattern into its atom."""
    binding: dict[str, str] = {}
    return all(
        (binding.setdefault(asked, given) if asked.startswith("?") else asked) == given
        for pattern, atom in zip(patterns, atoms, strict=True)
        for asked, given in zip(pattern, atom, strict=True)
    )
