"""A problem's questions as arrays, and which of them are worth a thought at a belief.

Asked are those that :meth:`xplain.explanation.asking.Questions.open` leaves open, by how much their
answers tell of what is hidden (mutual information).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.problem import Problem
from xplain.numba_kernels import inlined, lean_kernel, shared_kernel
from xplain.solvers.rows import parts_of, places_of, row

NO_NEWS = 1e-12
"""Nats below which an answer tells nothing."""
WORD = 62
"""Questions whose bits one integer holds."""


class Inquiry(NamedTuple):
    """Q questions of N hidden types; Q may be 0.

    Attributes:
        answered: [Q, rows, N] P(answer 1).
        yes: [Q, rows, N] whether the label is likelier 1.
        part: as :class:`~xplain.solvers.rows.Rows` has it, of the questions' rows.
        cost: κ.
        most: asked at most.
        first: whether only before the first step.
        words: integers that a node needs to tell which were asked; 0 where it never matters, as
            who answers for certain answers nothing new by answering again.
    """

    answered: NDArray[np.float64]
    yes: NDArray[np.bool_]
    part: NDArray[np.int64]
    cost: float
    most: int
    first: bool
    words: int


def make_inquiry(problem: Problem) -> Inquiry:
    """Of a problem, whose messages are the same for its questions."""
    asking, types = problem.questions, problem.n_types
    if asking is None:
        none = np.empty((0, 1, types))
        return Inquiry(none, none > 0, np.zeros((1, 1, types), np.int64), 0.0, 0, False, 0)
    table = asking.table
    part = parts_of(places_of(table, problem.n_messages))
    certain = bool(np.isin(table.answered, (0, 1)).all())
    matters = not certain or asking.limits.most < min(len(asking), types - 1)
    return Inquiry(
        np.ascontiguousarray(table.answered),
        np.ascontiguousarray(table.p >= 0.5),
        part,
        float(asking.limits.cost),
        asking.limits.most,
        asking.limits.when == "first",
        words_for(len(asking)) if matters else 0,
    )


def answers_at(inquiry: Inquiry, question: int, given: int) -> NDArray[np.float64]:
    """[N] P(answer 1) to a question, with H given."""
    types = inquiry.answered.shape[2]
    at = [row(inquiry.part, given, t) for t in range(types)]
    return inquiry.answered[question, at, np.arange(types)]


def words_for(count: int) -> int:
    """How many integers it takes to tell which of so many questions were asked."""
    return -(-count // WORD)


def words_of(asked: int, count: int) -> NDArray[np.int64]:
    """A bitmask of questions in so many integers, the first questions first."""
    return np.array([asked >> WORD * w & (1 << WORD) - 1 for w in range(count)], np.int64)


def mask_of(words: NDArray[np.int64]) -> int:
    """The bitmask of :func:`words_of`."""
    return sum(word << WORD * w for w, word in enumerate(words.tolist()))


@inlined
def answer_probability(inquiry, q, given, t):  # type: ignore[no-untyped-def]
    """P(answer 1) to question q of type t, who was given H."""
    return inquiry.answered[q, row(inquiry.part, given, t), t]


@inlined
def hear_answer(inquiry, q, given, answer, belief):  # type: ignore[no-untyped-def]
    """belief [N] ∝ itself × likelihood of an answer that it does not rule out. Returns what it sums
    to before, the probability of the answer."""
    total = 0.0
    for t in range(len(belief)):
        p = answer_probability(inquiry, q, given, t)
        belief[t] *= p if answer else 1.0 - p
        total += belief[t]
    if total > 0.0:
        for t in range(len(belief)):
            belief[t] /= total
    return total


class Room(NamedTuple):
    """What :func:`open_questions` finds, and room for it to work in.

    Attributes:
        asked: [Q] bool, is told which were asked.
        found: [room] questions, the most telling first; those that tell least are left out.
        news: [room] what they tell, in nats.
        kinds: [Q] the nearest of each kind; as ~q while it is known to tell nothing.
    """

    asked: NDArray[np.bool_]
    found: NDArray[np.int64]
    news: NDArray[np.float64]
    kinds: NDArray[np.int64]


NO_ROOM = Room(np.empty(0, np.bool_), np.empty(0, np.int64), np.empty(0), np.empty(0, np.int64))
"""Where there are no questions."""


def make_room(inquiry: Inquiry, asked: int = 0, most: int | None = None) -> Room:
    """Room for so many questions at a belief, or all."""
    count = len(inquiry.answered)
    room = count if most is None else min(most, count)
    flags = np.array([asked >> q & 1 for q in range(count)], np.bool_)
    return Room(flags, np.empty(room, np.int64), np.empty(room), np.empty(count, np.int64))


@shared_kernel
def open_questions(inquiry, step, given, belief, room):  # type: ignore[no-untyped-def]
    """Fills ``room.found`` with the questions that may be asked at (k, H) and tell something at a
    belief [N] that sums to 1. Returns how many.

    A question that tells nothing is among them where another of its kind does, which may be asked
    after it alone; ``room.news`` then has what that one tells.
    """
    left, count, kinds = inquiry.most, 0, 0
    for q in range(len(room.asked)):
        left -= room.asked[q]
    if left <= 0 or (inquiry.first and (step > 0 or given > 0)):
        return 0
    for q in range(len(room.asked)):
        if room.asked[q] or _answered_alike(inquiry, q, given):
            continue
        kind = _kind(inquiry, q, given, room.kinds, kinds)
        if kind < kinds and room.kinds[kind] >= 0:
            continue
        news = _news(inquiry, q, given, belief)
        nearest = q if kind == kinds else ~room.kinds[kind]
        room.kinds[kind] = nearest if news > NO_NEWS else ~nearest
        kinds = max(kinds, kind + 1)
        if news <= NO_NEWS or (count == len(room.found) and news <= room.news[count - 1]):
            continue
        at = min(count, len(room.found) - 1)
        while at > 0 and news > room.news[at - 1]:
            room.found[at], room.news[at] = room.found[at - 1], room.news[at - 1]
            at -= 1
        room.found[at], room.news[at] = nearest, news
        count = min(count + 1, len(room.found))
    return count


@lean_kernel
def look(inquiry, step, given, belief, room):  # type: ignore[no-untyped-def]
    """:func:`open_questions`, for Python."""
    return open_questions(inquiry, step, given, belief, room)


@inlined
def _answered_alike(inquiry, q, given):  # type: ignore[no-untyped-def]
    """Whether all hidden types answer a question alike, with H given."""
    first, alike = answer_probability(inquiry, q, given, 0), True
    for t in range(inquiry.answered.shape[2]):
        alike &= answer_probability(inquiry, q, given, t) == first
    return alike


@inlined
def _kind(inquiry, q, given, kinds, count):  # type: ignore[no-untyped-def]
    """Which of the first so many kinds has a question's column, thresholded; ``count`` for none."""
    for i in range(count):
        other, differs = max(kinds[i], ~kinds[i]), False
        for t in range(inquiry.yes.shape[2]):
            at = row(inquiry.part, given, t)
            if inquiry.yes[q, at, t] != inquiry.yes[other, at, t]:
                differs = True
                break
        if not differs:
            return i
    return count


@inlined
def _news(inquiry, q, given, belief):  # type: ignore[no-untyped-def]
    """The mutual information of an answer and what is hidden, in nats."""
    mean, certain = 0.0, 0.0
    for t in range(len(belief)):
        p = answer_probability(inquiry, q, given, t)
        mean += belief[t] * p
        certain += belief[t] * _entropy(p)
    return _entropy(mean) - certain


@inlined
def _entropy(p):  # type: ignore[no-untyped-def]
    """Of a bit, in nats."""
    if p <= 0.0 or p >= 1.0:
        return 0.0
    return -p * np.log(p) - (1.0 - p) * np.log1p(-p)
