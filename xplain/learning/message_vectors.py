"""The vector of an observer: the smallest message set that makes every transition explicable to
the observer's own labeler (docs/method.md, section 4; paper, "Learning the set of labeling
models").

Exact: fewest inexplicable transitions first (0 where possible), then fewest messages, then the
order of the messages (of {0, 5} and {1, 2} the first, for it has the first message).
"""

from __future__ import annotations

from itertools import combinations
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import TooLargeError
from xplain.explanation.message_sets import indices
from xplain.learning.data.dataset import Dataset, inputs
from xplain.learning.labelers import LabelerTrainer
from xplain.learning.tree_leaves import cubes
from xplain.numba_kernels import lean_kernel

MAX_PREDICTIONS = 1 << 28
"""A classifier that is no tree is asked at most this often (some minutes)."""


def minimal_message_sets(dataset: Dataset, trainer: LabelerTrainer, seed: int) -> NDArray[np.int64]:
    """The vector of each observer, as a message set: [O].

    Each observer's classifier is fitted to all of the observer's own labels; it is only asked
    about them, so nothing is held out. All are fitted with the same seed: observers who answered
    alike get the same vector. An observer without labels gets the empty set.

    Raises:
        TooLargeError: as :func:`minimal_message_set`.
    """
    x = inputs(dataset.features[dataset.transition], dataset.message_set, dataset.n_messages)
    found = np.zeros(len(dataset.observers), dtype=np.int64)
    order = np.argsort(dataset.observer, kind="stable")
    edges = np.searchsorted(dataset.observer[order], np.arange(len(found) + 1))
    for o in range(len(found)):
        own = order[edges[o] : edges[o + 1]]
        if len(own):
            classifier = trainer.fitted(x[own], dataset.label[own], seed)
            features = dataset.features[np.unique(dataset.transition[own])]
            found[o] = minimal_message_set(classifier, features, dataset.n_messages)
    return found


def minimal_message_set(classifier: Any, features: NDArray[np.float64], n_messages: int) -> int:
    """The smallest message set that makes every transition [T, F] explicable, as a bitmask.

    Args:
        classifier: fitted on :func:`xplain.learning.data.dataset.inputs`. A decision tree is
            searched by its paths, n = 30 in milliseconds; any other classifier by its predictions.
        features: of the distinct transitions.
        n_messages: n.

    Raises:
        TooLargeError: the classifier is no tree, the messages are many, and no small set will do.
    """
    if hasattr(classifier, "tree_"):
        return _by_paths(classifier, features, n_messages)
    return _by_predictions(classifier, features, n_messages)


def _by_paths(classifier: Any, features: NDArray[np.float64], n_messages: int) -> int:
    """Covering search: every transition must reach one of its explicable leaves."""
    tree = classifier.tree_
    every = cubes(tree, features, n_messages)
    explicable = classifier.classes_[tree.value[:, 0, :].argmax(axis=1)] == 1
    keep = explicable[every.leaf]
    pairs = np.stack([every.ones, every.zeros], axis=1)[keep]
    edges = np.searchsorted(every.transition[keep], np.arange(len(features) + 1))
    # Transitions that reach the same explicable cubes are one clause, weighted. Those that reach
    # none, or all, are so whatever is said.
    clauses: dict[bytes, int] = {}
    for t in range(len(features)):
        own = pairs[edges[t] : edges[t + 1]]
        key = own[np.lexsort(own.T)].tobytes()
        clauses[key] = clauses.get(key, 0) + 1
    for same in (b"", bytes(16)):
        clauses.pop(same, None)
    if not clauses:
        return 0
    parts = [np.frombuffer(key, dtype=np.int64).reshape(-1, 2) for key in clauses]
    start = np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)
    weight = np.array(list(clauses.values()), dtype=np.int64)
    ones, zeros = (np.ascontiguousarray(column) for column in np.concatenate(parts).T)
    relevant = int(np.bitwise_or.reduce(ones))
    order = np.array(indices(relevant), dtype=np.int64)
    terms = start, ones, zeros, weight, order
    room = np.zeros((3, len(order) + 1), dtype=np.int64)
    return int(_search(*terms, _greedy(*terms), room))


@lean_kernel
def _unmet(start, ones, zeros, weight, given):  # type: ignore[no-untyped-def]
    """Weight of the clauses that hold in none of their terms under this message set."""
    total = 0
    for c in range(len(weight)):
        met = False
        for i in range(start[c], start[c + 1]):
            if given & ones[i] == ones[i] and given & zeros[i] == 0:
                met = True
                break
        if not met:
            total += weight[c]
    return total


@lean_kernel
def _size(mask):  # type: ignore[no-untyped-def]
    count = 0
    while mask:
        mask &= mask - 1
        count += 1
    return count


@lean_kernel
def _greedy(start, ones, zeros, weight, order):  # type: ignore[no-untyped-def]
    """A good message set to start from: single messages turned while that helps."""
    given = 0
    cost = _unmet(start, ones, zeros, weight, given)
    size = 0
    improved = True
    while improved:
        improved = False
        for j in order:
            turned = given ^ (np.int64(1) << j)
            new_cost = _unmet(start, ones, zeros, weight, turned)
            new_size = _size(turned)
            if new_cost < cost or (new_cost == cost and new_size < size):
                given, cost, size, improved = turned, new_cost, new_size, True
    return given


@lean_kernel
def _search(start, ones, zeros, weight, order, first, room):  # type: ignore[no-untyped-def]
    """Branch and bound over the messages in order, "given" tried first: of equally good message
    sets the first one met is the first in message order.

    The bound at a node: clauses without a term left are lost; as long as that is all that may be
    lost, the clause that lacks most messages tells how many must still be given. A message that
    no living term asks for is never given. ``room`` [3, depth + 1] is all 0.
    """
    best = first
    best_cost = _unmet(start, ones, zeros, weight, first)
    best_size = _size(first)
    met_equal = False
    given, refused, turn = room[0], room[1], room[2]  # turn: 0 fresh, 1 "given" done, 2 both done
    level = 0
    while level >= 0:
        if turn[level] == 0:
            cost = 0
            lacks = 0
            wanted = 0
            for c in range(len(weight)):
                least = 64
                for i in range(start[c], start[c + 1]):
                    if given[level] & zeros[i] == 0 and refused[level] & ones[i] == 0:
                        missing = ones[i] & ~given[level]
                        wanted |= missing
                        least = min(least, _size(missing))
                if least == 64:
                    cost += weight[c]
                else:
                    lacks = max(lacks, least)
            size = _size(given[level])
            worse = cost > best_cost or (
                cost == best_cost
                and (size + lacks > best_size or (size + lacks == best_size and met_equal))
            )
            if worse:
                level -= 1
                continue
            if lacks == 0:
                # Nothing more is needed: the rest stays unsaid.
                best, best_cost, best_size, met_equal = given[level], cost, size, True
                level -= 1
                continue
            bit = np.int64(1) << order[level]
            turn[level] = 1
            if wanted & bit:
                given[level + 1] = given[level] | bit
                refused[level + 1] = refused[level]
                level += 1
                turn[level] = 0
                continue
        if turn[level] == 1:
            turn[level] = 2
            given[level + 1] = given[level]
            refused[level + 1] = refused[level] | (np.int64(1) << order[level])
            level += 1
            turn[level] = 0
            continue
        level -= 1
    return best


def _by_predictions(classifier: Any, features: NDArray[np.float64], n: int) -> int:
    """Sets of growing size, each dropped as soon as it has more inexplicable transitions than the
    best so far; the search ends with the first size at which nothing stays inexplicable."""
    best, best_cost, asked = 0, len(features) + 1, 0
    for size in range(n + 1):
        if asked + comb(n, size) > MAX_PREDICTIONS:
            raise TooLargeError(
                f"labeler: no set of {size - 1} of {n} messages makes every transition explicable "
                "to this classifier, and larger ones are too many to try; use a decision tree"
            )
        masks = np.array(
            [sum(1 << j for j in members) for members in combinations(range(n), size)],
            dtype=np.int64,
        )
        cost = np.zeros(len(masks), dtype=np.int64)
        alive = np.arange(len(masks))
        for row in features:
            asked += len(alive)
            rows = np.broadcast_to(row, (len(alive), len(row)))
            cost[alive] += classifier.predict(inputs(rows, masks[alive], n)) == 0
            alive = alive[cost[alive] < best_cost]
            if not len(alive):
                break
        if len(alive) and cost[alive].min() < best_cost:
            # combinations() yields message order, so the first of the least is the one wanted.
            winner = alive[cost[alive].argmin()]
            best, best_cost = int(masks[winner]), int(cost[winner])
        if best_cost == 0:
            break
    return best
