"""Explanation problems in ``.npz`` files: arrays of numbers and text only, never unpickled."""

from __future__ import annotations

import zipfile
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.explanation.asking import PREFIX, Questions
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem, numbers

DENSE = ("p_explicable",)
BY_TYPE = ("relevant", "p_relevant")
"""The arrays of a table, of both forms."""


def save(problem: Problem, path: str | Path) -> None:
    """Writes a file that :func:`load` reads.

    The table is ``p_explicable`` [N, m, 2^n] where messages are few, else ``relevant`` [N, r] and
    ``p_relevant`` [N, m, 2^r]. Where users fail there are ``p_answered``, of the same shape, and
    ``habits`` [4, F], the fields of :class:`~xplain.explanation.habits.Habits`; where something may
    be asked, the arrays of :meth:`~xplain.explanation.asking.Questions.arrays`.
    """
    table, habits = problem.table.compact(problem.n_messages), problem.habits
    p = table.p.transpose(2, 0, 1)
    dense = table.is_dense(problem.n_messages)
    arrays = {"p_explicable": p} if dense else {"relevant": table.relevant, "p_relevant": p}
    if table.answers.size:
        arrays["p_answered"] = table.answers.transpose(2, 0, 1)
    if not (habits.never_err and habits.take_all_in):
        arrays["habits"] = np.stack([habits.error, habits.accept, habits.forget, habits.prior])
    np.savez_compressed(
        path,
        **arrays,
        message_cost=problem.message_cost,
        inexplicability_cost=problem.inexplicability_cost,
        trade_off=problem.trade_off,
        discount=problem.discount,
        discount_per=problem.discount_per,
        prior=problem.prior,
        message_names=np.array(problem.message_names, dtype=np.str_),
        type_names=np.array(problem.type_names, dtype=np.str_),
        copies=problem.copies,
        whose=problem.whose,
        as_found=problem.as_found,
        **(problem.questions.arrays() if problem.questions else {}),
    )


def load(path: str | Path) -> Problem:
    """Reads a file of :func:`save`, or of anyone: only ``message_cost`` and either ``p_explicable``
    or ``relevant`` and ``p_relevant`` are mandatory.

    Raises:
        InputError: no such file, not an ``.npz``, a missing or unknown array, or values out of
            range.
    """
    arrays = _arrays(path)
    questions = Questions.of_arrays(arrays)
    values: dict[str, Any] = {k: v for k, v in arrays.items() if not k.startswith(PREFIX)}
    form = BY_TYPE if values.keys() & {*BY_TYPE} else DENSE
    if missing := {"message_cost", *form} - values.keys():
        raise InputError("problem", str(path), f"lacks {', '.join(sorted(missing))}")
    known = {field.name for field in fields(Problem)} - {"table", "questions"}
    known |= {*DENSE, *BY_TYPE, "p_answered"}
    if unknown := values.keys() - known:
        wanted = f"unknown array; known: {', '.join(sorted(known))}"
        raise InputError("problem", sorted(unknown)[0], wanted)
    if {*DENSE, *BY_TYPE} <= values.keys():
        raise InputError("problem", "p_explicable", "not beside relevant and p_relevant")
    for key in ("inexplicability_cost", "trade_off", "discount", "discount_per"):
        if key in values and values[key].ndim == 0:
            values[key] = values[key].item()
    for key in ("message_names", "type_names"):
        if key in values:
            values[key] = tuple(str(name) for name in values[key].tolist())
    if "habits" in values:
        values["habits"] = Habits(*numbers("habits", values["habits"]))
    p, answers = values.pop(form[-1]), values.pop("p_answered", None)
    if form == BY_TYPE:
        p = LabelTable.by_type(values.pop("relevant"), p, answers)
    elif answers is not None:
        p = LabelTable.dense(p, answers)
    return Problem(p, questions=questions, **values)


def _arrays(path: str | Path) -> dict[str, NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {key: file[key] for key in file.files}
    except (OSError, zipfile.BadZipFile, EOFError, ValueError, TypeError) as error:
        # A ValueError means that numpy would have to unpickle, which is never done here; a
        # TypeError, that it holds one array.
        reason = getattr(error, "strerror", None) or "it must hold named arrays of numbers"
        raise InputError("problem", str(path), f"not a readable .npz file ({reason})") from None
