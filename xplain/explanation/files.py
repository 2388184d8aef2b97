"""Explanation problems in files.

- ``.npz``: arrays of numbers and text only, never unpickled; can be read and written.
- ``.pomdp``: Cassandra's text format of other POMDP programs; can be written. It is the reduced
  problem without structure: states are (k, H, type) and one absorbing end; actions are *explain*
  and the n messages; observations are "nothing" and the distinguishable answers at each (k, H),
  numbered. All entries are explicit numbers without names, because parsers read these fast. Only
  rewards have wildcards, one line for each (state, action): SARSOP refuses rewards with an end
  state and an observation. The format cannot exclude actions. So a message that was already given,
  or that has no effect, leads to the end at a price above any cost, and no optimal policy gives it.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from dataclasses import asdict, fields
from itertools import product
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, TooLargeError
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem, numbers

DENSE = ("p_explicable",)
BY_TYPE = ("relevant", "p_relevant")
"""The arrays of a table in either form."""
PREFIX = "question_"
"""Prefix of the names of the arrays of questions."""
EXPLAIN, NOTHING = 0, 0
"""Numbers of an action and an observation in the text."""
MAX_LINES = 20_000_000


def save(problem: Problem, path: str | Path) -> None:
    """Writes a file for :func:`load`.

    The table is ``p_explicable`` [N, m, 2^n] for few messages, else ``relevant`` [N, r] and
    ``p_relevant`` [N, m, 2^r]. If users err or miss messages there are ``p_answered``, of the same
    shape, and ``habits`` [4, F], the fields of :class:`~xplain.explanation.habits.Habits`. With
    questions there are the same arrays of the questions' table, by type, with the fields of
    :class:`~xplain.explanation.asking.Questions` and its limits, each with PREFIX.
    """
    habits, questions = problem.habits, problem.questions
    arrays: dict[str, Any] = {
        field.name: getattr(problem, field.name)
        for field in fields(problem)
        if field.name not in ("table", "habits", "questions")
    }
    arrays |= _arrays_of(problem.table.compact(problem.n_messages), problem.n_messages)
    if not (habits.never_err and habits.take_all_in):
        arrays["habits"] = np.stack([habits.error, habits.accept, habits.forget, habits.prior])
    if questions:
        asked = _arrays_of(questions.table) | asdict(questions.limits)
        asked |= {key: getattr(questions, key) for key in ("shows", "texts", "right")}
        arrays |= {PREFIX + key: value for key, value in asked.items()}
    texts = {k: np.array(v, np.str_) for k, v in arrays.items() if isinstance(v, tuple)}
    np.savez_compressed(path, **arrays | texts)


def _arrays_of(table: LabelTable, dense_of: int = -1) -> dict[str, NDArray[Any]]:
    """The arrays of a table; dense if it covers all of ``dense_of`` messages."""
    p = table.p.transpose(2, 0, 1)
    dense = table.is_dense(dense_of)
    arrays = {"p_explicable": p} if dense else {"relevant": table.relevant, "p_relevant": p}
    answers = {"p_answered": table.answers.transpose(2, 0, 1)} if table.answers.size else {}
    return arrays | answers


def load(path: str | Path) -> Problem:
    """Reads a file of :func:`save`, or of another program: only ``message_cost`` and either
    ``p_explicable`` or ``relevant`` and ``p_relevant`` are required.

    Raises:
        InputError: no such file, not an ``.npz``, a missing or unknown array, or values out of
            range.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: _as_python(value) for key, value in file.items()}
    except (OSError, zipfile.BadZipFile, EOFError, ValueError, TypeError) as error:
        # A ValueError means that numpy would have to unpickle, which is forbidden here; a
        # TypeError means that the file has a single array.
        reason = getattr(error, "strerror", None) or "it must hold named arrays of numbers"
        raise InputError("problem", str(path), f"not a readable .npz file ({reason})") from None
    own = {k.removeprefix(PREFIX): arrays.pop(k) for k in [*arrays] if k.startswith(PREFIX)}
    table = _table_of(arrays, {"message_cost"}, Problem)
    if own:
        needed = {*BY_TYPE, *(field.name for field in fields(Limits))}
        questions = _table_of(own, needed, Questions, Limits)
        limits = Limits(**{field.name: own.pop(field.name) for field in fields(Limits)})
        arrays["questions"] = Questions(questions, limits, **own)
    if "habits" in arrays:
        arrays["habits"] = Habits(*numbers("habits", arrays["habits"]))
    return Problem(table, **arrays)


def _as_python(array: NDArray[Any]) -> Any:
    """A single number or text, or several texts, as Python values."""
    if not array.ndim:
        return array.item()
    return tuple(array.tolist()) if array.dtype.kind == "U" else array


def _table_of(arrays: dict[str, Any], needed: set[str], *kinds: Any) -> Any:
    """Makes a table from these arrays and removes them; the others must be fields of these classes.

    Raises:
        InputError: a missing or unknown array, or an invalid table.
    """
    form = BY_TYPE if arrays.keys() & {*BY_TYPE} else DENSE
    if missing := {*needed, *form} - arrays.keys():
        raise InputError("problem", sorted(arrays), f"lacks {', '.join(sorted(missing))}")
    known = {field.name for kind in kinds for field in fields(kind)} - {"table", "questions"}
    known |= {*form, "p_answered"}
    if unknown := arrays.keys() - known:
        wanted = f"unknown array; known: {', '.join(sorted(known))}"
        raise InputError("problem", sorted(unknown)[0], wanted)
    p, answers = arrays.pop(form[-1]), arrays.pop("p_answered", None)
    if form == BY_TYPE:
        return LabelTable.by_type(arrays.pop("relevant"), p, answers)
    return p if answers is None else LabelTable.dense(p, answers)


def pomdp_lines(problem: Problem) -> Iterator[str]:
    """The lines of a ``.pomdp`` file.

    Raises:
        InputError: only steps discount, or there are questions; the format has neither.
        TooLargeError: more than MAX_LINES lines.
    """
    if problem.discount_per == "step" and problem.discount < 1:
        raise InputError(
            "discount_per", "step", "the format discounts every action; needs action, or γ = 1"
        )
    if problem.questions:
        raise InputError(
            "problem", "has questions", "one without: no question discounts or is asked twice"
        )
    types, steps, n = problem.n_types, problem.n_steps, problem.n_messages
    sets = 1 << n
    end = types * steps * sets
    fewest = 3 * end * (n + 1)
    _check_lines(fewest)
    answers = {
        (k, shown): _answers_of(problem, k, shown)
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


def _answers_of(problem: Problem, step: int, shown: int) -> list[list[float]]:
    """P(answer | type) for the distinguishable answers to *explain* at (k, H). Transitions with
    equal columns are answered by their number of labels 1; those that all types label alike are
    left out."""
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
