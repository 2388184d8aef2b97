"""Features of states that YAML names: the number of ways in which a pattern holds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from xplain.domains.pddl.task import Item, Task, substitute
from xplain.domains.pddl.translator import Source, read_text
from xplain.errors import InputError


def count(
    key: str,
    patterns: str | Sequence[str],
    task: Task,
    atoms: Sequence[str],
    table: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """[S] the number of ways to replace the variables so that all patterns hold.

    Args:
        key: of the feature in the configuration, for errors.
        patterns: atoms such as (on ?x b).
        task: the robot's.
        atoms: those that can change.
        table: [S, atoms] whether each holds.

    Raises:
        InputError: a pattern is not an atom of the task.
    """
    listed = [patterns] if isinstance(patterns, str) else patterns
    if not isinstance(listed, Sequence) or not listed:
        raise InputError(key, patterns, "an atom such as (on ?x b), or a list of them")
    variables = sorted(set(re.findall(r"\?[^\s()?]+", str(listed).lower())))
    wanted = []
    for pattern in listed:
        source = Source(key, pattern, str(pattern).lower())
        wanted.append(read_text(task, [(name, "object") for name in variables], source))
    column = {atom: i for i, atom in enumerate(atoms)}
    result = np.zeros(len(table), dtype=np.int64)
    for objects in product(task.objects, repeat=len(variables)):
        binding = dict(zip(variables, objects, strict=True))
        held = [substitute(text, binding) for text in wanted]
        if all(atom in column or Item("initial", "", atom) in task.items for atom in held):
            # Atoms that never change are here only if they hold in all states.
            result += table[:, [column[atom] for atom in held if atom in column]].all(axis=1)
    return result
