"""What a user knows, where messages may be missed or forgotten (docs/method.md, section 5).

Then a message said is no fact known. Hidden are the type t, with its habits, and K, the facts set
right that the user has right now; of these only the ones relevant to t matter, and the row of a
label table (:mod:`xplain.explanation.label_table`) is such a K. So a belief is a table
[rows, N], and what happens to it is linear: saying a message moves a part α of the rows without
the fact to those with it, and forgetting moves a part φ back.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Relevant = NDArray[np.int64]
Table = NDArray[np.float64]


def say(belief: Table, relevant: Relevant, message: int, accept: Table) -> Table:
    """The belief [rows, N] after a message was said once.

    Args:
        belief: before.
        relevant: [N, r] messages of the bits of a row.
        message: j.
        accept: [N] α.
    """
    after = belief.copy()
    for bit in np.flatnonzero((relevant == message).any(axis=0)).tolist():
        landing = np.where(relevant[:, bit] == message, accept, 0.0)
        without, having = _halves(after, bit)
        having += landing * without
        without *= 1 - landing
    return after


def forget(belief: Table, relevant: Relevant, lose: Table) -> Table:
    """The belief [rows, N] after a step at whose end each fact known is lost with φ, ``lose``
    [N]."""
    after = belief.copy()
    for bit in range(relevant.shape[1]):
        without, having = _halves(after, bit)
        without += lose * having
        having *= 1 - lose
    return after


def expected_after_forgetting(values: Table, relevant: Relevant, lose: Table) -> Table:
    """E[v(K') | K] of values [rows, N], K' what is left of K."""
    after = values.copy()
    for bit in range(relevant.shape[1]):
        without, having = _halves(after, bit)
        having *= 1 - lose
        having += lose * without
    return after


def with_message(values: Table, relevant: Relevant, message: int) -> Table:
    """v(K ∪ {j}) for all K, of values [rows, N]; a type to which j is not relevant stays."""
    after = values.copy()
    for bit in np.flatnonzero((relevant == message).any(axis=0)).tolist():
        own = relevant[:, bit] == message
        without, having = _halves(after, bit)
        without[..., own] = having[..., own]
    return after


def _halves(table: Table, bit: int) -> tuple[Table, Table]:
    """Views of the rows without and with a bit."""
    pairs = table.reshape(len(table) >> bit + 1, 2, 1 << bit, table.shape[1])
    return pairs[:, 0], pairs[:, 1]
