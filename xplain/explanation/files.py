"""Explanation problems in files.

- ``.npz``: arrays of numbers and text only, never unpickled; can be read and written.
- ``.pomdp``: Cassandra's text format, for other POMDP programs; can be written. States are (k, H,
  type) and one absorbing end; actions are *explain* and the n messages; observations are "nothing"
  and the distinguishable answers at each (k, H), numbered. All entries are explicit numbers without
  names, because parsers read numbers fast. Only rewards have wildcards, one line for each (state,
  action): SARSOP refuses rewards with an end state and an observation. The format cannot exclude
  actions. So a message that was already given, or that has no effect, leads to the end at a price
  above any cost, and no optimal policy gives it.
"""

import json
import zipfile
from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import product
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, TooLargeError
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.storage import decode, encode

WHOLE = "problem"
"""In a file of :func:`save`: the name of the text that assigns the arrays to fields."""
DENSE, BY_TYPE = {"p_explicable"}, {"relevant", "p_relevant"}
"""Names of the arrays of a label table in files of other programs, for the two forms of a table."""
EXPLAIN, NOTHING = 0, 0
"""Numbers of the action *explain* and of the observation "nothing" in a ``.pomdp`` file."""
MAX_LINES = 20_000_000


def save(problem: Problem, path: str | Path) -> None:
    """Writes a file that :func:`load` reads: all arrays of the problem, and ``problem``, a text in
    JSON with everything else."""
    arrays: dict[str, Any] = {}
    kept = problem
    if problem.messages_land:  # otherwise a row is a part of the hidden state
        kept = replace(problem, table=problem.table.compact(problem.n_messages))
    arrays[WHOLE] = np.array(json.dumps(encode(kept, arrays)))
    np.savez_compressed(path, **arrays)


def load(path: str | Path) -> Problem:
    """Reads a file of :func:`save` or of another program.

    A file of another program has the arrays ``message_cost`` and either ``p_explicable`` [N, m,
    2^n] or ``relevant`` [N, r] and ``p_relevant`` [N, m, 2^r] (:meth:`LabelTable.by_type`), and may
    have the numbers, texts and arrays of :class:`~xplain.explanation.problem.Problem`.

    Raises:
        InputError: no such file, not an ``.npz``, a missing or unknown array, or values out of
            range.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: _convert_to_python(value) for key, value in file.items()}
    except (OSError, zipfile.BadZipFile, EOFError, ValueError, TypeError) as error:
        # A ValueError means that numpy would have to unpickle, which is forbidden here; a
        # TypeError means that the file has a single array.
        reason = getattr(error, "strerror", None) or "it must hold named arrays of numbers"
        raise InputError("problem", str(path), f"not a readable .npz file ({reason})") from None
    if WHOLE in arrays:
        try:
            problem: Problem = decode(Problem, json.loads(arrays[WHOLE]), arrays)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError("problem", str(path), f"a file of save() ({error!r})") from None
        return problem
    form = BY_TYPE if arrays.keys() & BY_TYPE else DENSE
    if missing := {"message_cost", *form} - arrays.keys():
        raise InputError("problem", sorted(arrays), f"lacks {', '.join(sorted(missing))}")
    known = form | {field.name for field in fields(Problem)} - {"table", "habits", "questions"}
    if unknown := arrays.keys() - known:
        wanted = f"unknown array; known: {', '.join(sorted(known))}"
        raise InputError("problem", sorted(unknown)[0], wanted)
    if form == DENSE:
        return Problem(arrays.pop("p_explicable"), **arrays)
    table = LabelTable.by_type(arrays.pop("relevant"), arrays.pop("p_relevant"))
    return Problem(table, **arrays)


def _convert_to_python(array: NDArray[Any]) -> Any:
    """Converts a single number or text, or several texts, to Python values."""
    if not array.ndim:
        return array.item()
    return tuple(array.tolist()) if array.dtype.kind == "U" else array


def pomdp_lines(problem: Problem) -> Iterator[str]:
    """Yields the lines of a ``.pomdp`` file.

    Raises:
        InputError: the problem has questions, or messages that may be missed or forgotten; or its
            discount applies only to *explain* and not to messages. The file allows none of these.
        TooLargeError: more than MAX_LINES lines.
    """
    if problem.discount_per == "step" and problem.discount < 1:
        raise InputError(
            "discount_per", "step", "the format discounts every action; needs action, or γ = 1"
        )
    if problem.questions or not problem.messages_land:
        found = "with questions" if problem.questions else "with messages that may be missed"
        raise InputError("problem", found, "without: the file has no states for these")
    types, steps, n = problem.n_types, problem.n_steps, problem.n_messages
    sets = 1 << n
    end = types * steps * sets
    fewest = 3 * end * (n + 1)
    _check_lines(fewest)
    answers = {
        (k, shown): _list_answers(problem, k, shown)
        for k in range(steps - 1)
        for shown in range(sets)
    }
    _check_lines(fewest + types * sum(len(answer) for answer in answers.values()))

    def state(k: int, shown: int, t: int) -> int:
        return (k * sets + shown) * types + t if k < steps else end

    observations = 1 + max((len(answer) for answer in answers.values()), default=0)
    yield f"discount: {problem.discount!r}"
    yield "values: reward"
    yield f"states: {end + 1}"
    yield f"actions: {n + 1}"
    yield f"observations: {observations}"
    start = np.zeros(end + 1)
    start[:types] = problem.prior
    yield "start: " + " ".join(repr(float(p)) for p in start)

    prices = problem.trade_off * problem.message_cost
    effective = problem.messages_with_effect
    forbidden = -1.0 - float(prices.sum()) - problem.inexplicability_cost * steps * (steps + 1) / 2
    for k, shown, t in product(range(steps), range(sets), range(types)):
        here, after = state(k, shown, t), state(k + 1, shown, t)
        zeros = float((1 - problem.table.label_probabilities(k + 1, shown)[t]).sum())
        yield f"T: {EXPLAIN} : {here} : {after} 1.0"
        yield f"R: {EXPLAIN} : {here} : * : * {-problem.inexplicability_cost * zeros!r}"
        # At the last step the answers change nothing.
        for o, weights in enumerate(answers.get((k, shown), []), start=1):
            if weights[t] > 0:
                yield f"O: {EXPLAIN} : {after} : {o} {weights[t]!r}"
        if k == 0:
            yield f"O: {EXPLAIN} : {here} : {NOTHING} 1.0"
        for j in range(n):
            may_be_said = j in effective and not shown >> j & 1
            reward = -float(prices[j]) if may_be_said else forbidden
            after = state(k, shown | 1 << j, t) if may_be_said else end
            yield f"T: {j + 1} : {here} : {after} 1.0"
            yield f"R: {j + 1} : {here} : * : * {reward!r}"
            yield f"O: {j + 1} : {here} : {NOTHING} 1.0"
    for action in range(n + 1):
        yield f"T: {action} : {end} : {end} 1.0"
        yield f"O: {action} : {end} : {NOTHING} 1.0"


def _check_lines(expected: int) -> None:
    if expected > MAX_LINES:
        raise TooLargeError(
            f"format=pomdp: about {expected:.1e} lines, more than {MAX_LINES:.0e}; "
            "fewer messages or a shorter trace fit"
        )


def _list_answers(problem: Problem, step: int, shown: int) -> list[list[float]]:
    """Computes P(answer | type) of the distinguishable answers to *explain* at (k, H).

    Two transitions cannot be distinguished if every type answers 1 with the same probability to
    both. An answer to *explain* is then the number of answers 1 in each group of such transitions.
    A transition gives no information if all types answer 1 with the same probability; it is left
    out.

    Args:
        problem: the problem.
        step: k.
        shown: H, as a bitmask.

    Returns:
        For each distinguishable answer, its probability for each type.
    """
    labels = problem.table.answer_probabilities(step + 1, shown)
    columns: dict[tuple[float, ...], int] = {}
    for i in range(step + 1):
        column = tuple(labels[:, i].tolist())
        if len(set(column)) > 1:
            columns[column] = columns.get(column, 0) + 1
    found = []
    for ones in product(*(range(size + 1) for size in columns.values())):
        weights = [1.0] * problem.n_types
        for (column, size), count in zip(columns.items(), ones, strict=True):
            for t, p in enumerate(column):
                weights[t] *= comb(size, count) * p**count * (1 - p) ** (size - count)
        found.append(weights)
    return found
