"""The model that both compiled searches read: the process of one problem as arrays, with the
kernels that they share."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.numba_kernels import first_bit, search, small

NO_NEWS = 1e-12
"""A question whose answer is expected to give less information than this, in nats, is not asked."""


class SearchModel(NamedTuple):
    """A :class:`~xplain.solvers.process.Process` and its known values, as kernels read them.
    Tables have a cell for each pair (v, s): the bitmask v of the messages given so far, and the
    hidden state s. This cell has the index s + Σ_{j ∈ v} stride[j, s].

    Attributes:
        answered: [m, cells] P(answer 1).
        explain_cost: [m, cells] the expected cost of *explain*.
        explain: [m, cells] Q of *explain*.
        stride: [n, S] the strides of these three tables.
        value: [m + 1, value cells] V.
        value_stride: [n, S] the strides of ``value``.
        wanted: [m, value cells] bitmask of the messages that are better than *explain* at (v, s);
            SETTLED if no message is better from this step to the end. Empty for HSVI, which does
            not use this table, and empty if messages may be missed.
        relevant: [S] bitmask of the messages that have an effect on s.
        jump: [n, S] the number that an accepted message adds to s; empty if messages always correct
            the fact.
        accept: [S] α; empty if messages always correct the fact.
        forget: [N] φ; 0 if nothing is ever forgotten.
        price: [n] λ C_e.
        asked_answered: [Q, question cells] P(answer 1) of Q questions.
        likelier: [Q, question cells] True if label 1 of a question is likelier than label 0.
        question_stride: [n, S] the strides of ``asked_answered`` and ``likelier``.
        discount, message_discount: γ and γ'.
        question_cost: κ.
        most: the largest number of questions.
        first: True if questions come only before the first step.
        patience: QMDP gives a message only if it saves more than its price times 1 + patience · p,
            where p is the probability that the state is not the most likely state
            (:data:`~xplain.solvers.process.PATIENCE`); 0 if messages always correct the fact.
    """

    answered: NDArray[np.float64]
    explain_cost: NDArray[np.float64]
    explain: NDArray[np.float64]
    stride: NDArray[np.int64]
    value: NDArray[np.float64]
    value_stride: NDArray[np.int64]
    wanted: NDArray[np.int64]
    relevant: NDArray[np.int64]
    jump: NDArray[np.int64]
    accept: NDArray[np.float64]
    forget: NDArray[np.float64]
    price: NDArray[np.float64]
    asked_answered: NDArray[np.float64]
    likelier: NDArray[np.bool_]
    question_stride: NDArray[np.int64]
    discount: float
    message_discount: float
    question_cost: float
    most: int
    first: bool
    patience: float


@small
def find_cell(stride, said, s):  # type: ignore[no-untyped-def]
    """Returns the cell of (v, s) in a table with these strides [n, S]."""
    at = s
    while said:
        at += stride[first_bit(said), s]
        said &= said - 1
    return at


@small
def give(jump, accept, belief):  # type: ignore[no-untyped-def]
    """Updates a belief [S]: a message with these jumps [S] is given once, and accepted with α."""
    for s in range(len(belief)):
        if jump[s] > 0:
            landed = accept[s] * belief[s]
            belief[s] -= landed
            belief[s + jump[s]] += landed


@small
def forget(lose, belief):  # type: ignore[no-untyped-def]
    """Updates a belief [S]: each known fact is forgotten with probability φ, ``lose`` [N]."""
    types = len(lose)
    bit = types
    while bit < len(belief):
        for first in range(0, len(belief), 2 * bit):
            for row in range(first, first + bit, types):
                for t in range(types):
                    lost = lose[t] * belief[row + bit + t]
                    belief[row + bit + t] -= lost
                    belief[row + t] += lost
        bit *= 2


@small
def _entropy(p):  # type: ignore[no-untyped-def]
    """Returns the entropy of a bit that is 1 with probability p, in nats."""
    value = 0.0
    if 0.0 < p < 1.0:
        value = -p * np.log(p) - (1.0 - p) * np.log1p(-p)
    return value


@search
def rank_questions(answered, likelier, cells, belief, news):  # type: ignore[no-untyped-def]
    """Computes the mutual information of each question's answer and the state, in nats. The result
    is written to ``news`` [Q]; it is −1 for questions that cannot be asked now.

    Two questions are alike if label 1 is likelier in the same states. Only the first of several
    alike questions can be asked now. Its result is the largest information of the alike questions,
    because the others can be asked later. A question with the same P(answer 1) in all states is
    never asked.

    Args:
        answered, likelier: [Q, cells] P(answer 1); True if label 1 is likelier.
        cells: [S] the cells at which these tables are read.
        belief: [S].
        news: [Q] before the call, −1 for questions that may not be asked, otherwise 0.
    """
    for q in range(len(news)):
        mean, certain, alike = 0.0, 0.0, True
        for s in range(len(belief)):
            p = answered[q, cells[s]]
            alike &= p == answered[q, cells[0]]
            mean += belief[s] * p
            certain += belief[s] * _entropy(p)
        if alike or news[q] < 0.0:
            news[q] = -1.0
            continue
        news[q] = max(_entropy(mean) - certain, 0.0)
        for other in range(q):
            if news[other] >= 0.0:
                same = True
                for s in range(len(belief)):
                    same &= likelier[q, cells[s]] == likelier[other, cells[s]]
                if same:
                    news[other] = max(news[other], news[q])
                    news[q] = -1.0
                    break
