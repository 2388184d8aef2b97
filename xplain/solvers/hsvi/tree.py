"""The memory of :mod:`xplain.solvers.hsvi.search`: flat arrays that grow, and a hash table."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.numba_kernels import inlined, lean_kernel
from xplain.solvers.count_lattice import hash_key
from xplain.solvers.hsvi.initial_bounds import Tables

KEPT = 32
"""Alpha vectors, and upper bounds, kept for each (k, H)."""


class Store(NamedTuple):
    """Nodes, their actions (sets of messages, then *explain*), these actions' answers.

    ``used`` counts nodes, actions, answers, candidates, places, nodes opened, work done. A node
    not yet opened has ``first`` −1, and so has an action not yet expanded. A place is a (k, H)
    where a node was opened; ``listed`` [m, 2^n, 3] holds its first candidate set, their number,
    and its index; −1 before that.
    """

    used: NDArray[np.int64]
    step: NDArray[np.int64]
    given: NDArray[np.int64]
    belief: NDArray[np.float64]
    evidence: NDArray[np.int64]
    upper: NDArray[np.float64]
    lower: NDArray[np.float64]
    alpha: NDArray[np.float64]
    first: NDArray[np.int64]
    n_actions: NDArray[np.int64]
    action_set: NDArray[np.int64]
    action_upper: NDArray[np.float64]
    action_lower: NDArray[np.float64]
    action_base: NDArray[np.float64]
    action_first: NDArray[np.int64]
    action_answers: NDArray[np.int64]
    action_tail: NDArray[np.float64]
    action_tail_alpha: NDArray[np.float64]
    answer_node: NDArray[np.int32]
    answer_probability: NDArray[np.float64]
    candidates: NDArray[np.int64]
    place_count: NDArray[np.int64]
    place_alpha: NDArray[np.float64]
    place_set: NDArray[np.int64]
    place_belief: NDArray[np.float64]
    place_upper: NDArray[np.float64]
    listed: NDArray[np.int64]
    hash_table: NDArray[np.int32]


NODES, ACTIONS, ANSWERS, CANDIDATES, PLACES, OPENED, WORK = range(7)


def make_store(tables: Tables, nodes: int = 1 << 10) -> Store:
    """An empty store."""
    steps, sets, types = tables.explain.shape
    actions, answers, places = max(4 * nodes, 2 * sets), 4 * nodes, 16
    return Store(
        np.zeros(7, dtype=np.int64),
        np.zeros(nodes, dtype=np.int64),
        np.zeros(nodes, dtype=np.int64),
        np.zeros((nodes, types)),
        np.zeros((nodes, types), dtype=np.int64),
        np.zeros(nodes),
        np.zeros(nodes),
        np.zeros((nodes, types)),
        np.zeros(nodes, dtype=np.int64),
        np.zeros(nodes, dtype=np.int64),
        np.zeros(actions, dtype=np.int64),
        np.zeros(actions),
        np.zeros(actions),
        np.zeros(actions),
        np.zeros(actions, dtype=np.int64),
        np.zeros(actions, dtype=np.int64),
        np.zeros((actions, 2)),
        np.zeros((actions, types)),
        np.zeros(answers, dtype=np.int32),
        np.zeros(answers),
        np.zeros(actions, dtype=np.int64),
        np.zeros((places, 2), dtype=np.int64),
        np.zeros((places, KEPT, types)),
        np.zeros((places, KEPT), dtype=np.int64),
        np.zeros((places, KEPT, types)),
        np.zeros((places, KEPT)),
        np.full((steps, sets, 3), -1, dtype=np.int64),
        np.full(4 * nodes, -1, dtype=np.int32),
    )


def grown(store: Store) -> Store:
    """The same store with twice the room for whatever has used up half of it."""
    room = {NODES: len(store.step), ACTIONS: len(store.action_set)}
    room |= {ANSWERS: len(store.answer_node), CANDIDATES: len(store.candidates)}
    room |= {PLACES: len(store.place_count)}
    short = {kind for kind, size in room.items() if 2 * store.used[kind] >= size}
    short = short or set(room)

    def bigger(name: str, array: NDArray[Any]) -> NDArray[Any]:
        kind = _KIND.get(name.split("_")[0], NODES)
        if kind not in short:
            return array
        # Fresh zeros cost nothing until they are touched.
        more = np.zeros((2 * len(array), *array.shape[1:]), dtype=array.dtype)
        more[: store.used[kind]] = array[: store.used[kind]]
        return more

    fixed = {"used": store.used, "listed": store.listed}
    arrays: dict[str, Any] = {
        n: fixed[n] if n in fixed else bigger(n, a) for n, a in store._asdict().items()
    }
    arrays["hash_table"] = np.full(4 * len(arrays["step"]), -1, dtype=np.int32)
    new = Store(**arrays)
    _rehash(new)
    return new


_KIND = {"action": ACTIONS, "answer": ANSWERS, "candidates": CANDIDATES, "place": PLACES}
"""What an array of the store is about, by the first word of its name; the rest is about nodes."""


def store_bytes(store: Store) -> int:
    """What a store takes."""
    return sum(array.nbytes for array in store)


@lean_kernel
def _rehash(store):  # type: ignore[no-untyped-def]
    for node in range(store.used[NODES]):
        slot = find(store, store.step[node], store.given[node], store.evidence[node])
        store.hash_table[slot] = node


@inlined
def find(store, step, given, evidence):  # type: ignore[no-untyped-def]
    """The slot that holds this belief's node, or the free one where it belongs."""
    mask = np.uint64(len(store.hash_table) - 1)
    slot = hash_key(step, given, evidence) & mask
    while True:
        node = store.hash_table[slot]
        if node < 0:
            return slot
        if store.step[node] == step and store.given[node] == given:
            same = True
            for t in range(len(evidence)):
                if store.evidence[node, t] != evidence[t]:
                    same = False
                    break
            if same:
                return slot
        slot = (slot + np.uint64(1)) & mask


@inlined
def copy(source, target):  # type: ignore[no-untyped-def]
    """Fills an array [N] from another. (``target[:] = source`` would allocate.)"""
    for t in range(len(target)):
        target[t] = source[t]
