"""Dijkstra's algorithm on edges in arrays, compiled."""

from __future__ import annotations

import numpy as np

from xplain.numba_kernels import kernel


@kernel
def shortest_ways(first, order, source, variant, cost, goal, distance):  # type: ignore[no-untyped-def]
    """Dijkstra (1959) backwards from all goals at once; fills distance [S], ∞ on entry.

    The heap holds a state again for each shorter way found, and skips the outdated ones.
    """
    capacity = 64
    keys = np.empty(capacity)
    items = np.empty(capacity, dtype=np.int64)
    size = 0
    for s in range(len(goal)):
        if goal[s]:
            distance[s] = 0.0
            if size == capacity:
                keys, items = _grown(keys, items)
                capacity *= 2
            keys[size] = 0.0  # equal keys are a heap in any order
            items[size] = s
            size += 1
    while size > 0:
        key, reached = keys[0], items[0]
        size -= 1
        if size > 0:
            _sift_down(keys, items, size, keys[size], items[size])
        if key > distance[reached]:
            continue
        for at in range(first[reached], first[reached + 1]):
            edge = order[at]
            step = cost[variant[edge]]
            if step == np.inf:
                continue
            s = source[edge]
            if key + step < distance[s]:
                distance[s] = key + step
                if size == capacity:
                    keys, items = _grown(keys, items)
                    capacity *= 2
                _sift_up(keys, items, size, key + step, s)
                size += 1


@kernel
def _grown(keys, items):  # type: ignore[no-untyped-def]
    """Both twice as long."""
    more_keys = np.empty(2 * len(keys))
    more_items = np.empty(2 * len(items), dtype=np.int64)
    more_keys[: len(keys)] = keys
    more_items[: len(items)] = items
    return more_keys, more_items


@kernel
def _sift_up(keys, items, place, key, item):  # type: ignore[no-untyped-def]
    while place > 0:
        parent = (place - 1) // 2
        if keys[parent] <= key:
            break
        keys[place], items[place] = keys[parent], items[parent]
        place = parent
    keys[place], items[place] = key, item


@kernel
def _sift_down(keys, items, size, key, item):  # type: ignore[no-untyped-def]
    place = 0
    while True:
        child = 2 * place + 1
        if child >= size:
            break
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[place], items[place] = keys[child], items[child]
        place = child
    keys[place], items[place] = key, item
