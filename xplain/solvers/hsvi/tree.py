"""The memory of :mod:`xplain.solvers.hsvi.search`: flat arrays that grow, and a hash table."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.numba_kernels import inlined
from xplain.solvers.count_lattice import hash_key, same
from xplain.solvers.hsvi.initial_bounds import BoundTables

ROOT = np.int64(0)
"""The first node. (numba would compile what it is passed to once more for the literal 0.)"""
NONE = -1
"""For an index: not opened, not expanded, not listed; in the hash table, free."""
PLAN = 1 << 62
"""Instead of the action that earns a node's lower bound: its own, or a plan's."""
KEPT = 32
"""Alpha vectors, and upper bounds, kept for each (k, H)."""

NODE = np.dtype(
    [
        ("upper", np.float64),  # bounds of the optimal value
        ("lower", np.float64),
        ("step", np.int64),  # k
        ("given", np.int64),  # H
        ("first_action", np.int64),  # NONE until it is opened
        ("n_actions", np.int64),
        ("asked", np.int64),  # questions, where that matters
        ("earned_by", np.int64),  # the action of a vector of another node; PLAN for none
    ]
)
ACTION = np.dtype(
    [
        ("messages", np.int64),  # the set given, then *explain*; ~q to ask question q
        ("later", np.float64),  # what discounts what comes after it
        ("upper", np.float64),
        ("lower", np.float64),
        ("base", np.float64),  # its expected reward: messages and *explain*
        ("tail_upper", np.float64),  # of the answers that are not told apart
        ("tail_lower", np.float64),
        ("first_answer", np.int64),  # NONE until it is expanded
        ("n_answers", np.int64),
    ]
)
ANSWER = np.dtype(
    [
        ("weight", np.float64),  # its probability, discounted
        ("node", np.int64),  # where it leads
    ]
)
PLACE = np.dtype(
    [
        ("first_candidate", np.int64),  # the sets of messages that may be optimal there
        ("n_candidates", np.int64),
        ("shared", np.int64),  # its row in the shared bounds; NONE until a node there is opened
    ]
)

NODES, ACTIONS, ANSWERS, CANDIDATES, SHARED, OPENED, WORK, HASHED = range(8)
"""What ``Store.used`` counts; OPENED nodes, WORK done, and nodes in the hash table."""


class NodeStore(NamedTuple):
    """Nodes, their actions, these actions' answers; N types, m steps, n messages.

    Attributes:
        used: [8] how much of the rest is in use.
        nodes: [.] NODE, a belief at (k, H).
        belief: [nodes, N].
        evidence: [nodes, N + words] integers that are an exact key of the belief and, in the last
            words, of the questions asked.
        alpha: [nodes, N] values by type of the policy that earns the lower bound.
        actions: [.] ACTION; those of a node lie side by side.
        tail_alpha: [actions, N] what the answers not told apart add to alpha.
        answers: [.] ANSWER; those of an action lie side by side.
        candidates: [.] sets of messages; those of a place lie side by side.
        places: [m, 2^n] PLACE, by (k, H).
        shared_count: [shared, 2] lower and upper bounds ever published at a place; the last
            KEPT of each are here:
        shared_alpha: [shared, KEPT, N] alpha vectors, bounds from below,
        shared_messages: [shared, KEPT] the set that earns each,
        shared_belief: [shared, KEPT, N] a belief, and
        shared_upper: [shared, KEPT] the upper bound there.
        shared_node: [shared, KEPT, 2] the nodes that published a lower and an upper bound.
        hash_table: [.] nodes by (k, H, evidence), open addressing.
    """

    used: NDArray[np.int64]
    nodes: NDArray[np.void]
    belief: NDArray[np.float64]
    evidence: NDArray[np.int64]
    alpha: NDArray[np.float64]
    actions: NDArray[np.void]
    tail_alpha: NDArray[np.float64]
    answers: NDArray[np.void]
    candidates: NDArray[np.int64]
    places: NDArray[np.void]
    shared_count: NDArray[np.int64]
    shared_alpha: NDArray[np.float64]
    shared_messages: NDArray[np.int64]
    shared_belief: NDArray[np.float64]
    shared_upper: NDArray[np.float64]
    shared_node: NDArray[np.int64]
    hash_table: NDArray[np.int32]


_KIND = {
    "nodes": NODES, "belief": NODES, "evidence": NODES, "alpha": NODES,
    "actions": ACTIONS, "tail_alpha": ACTIONS,
    "answers": ANSWERS,
    "candidates": CANDIDATES,
    "shared_count": SHARED, "shared_alpha": SHARED, "shared_messages": SHARED,
    "shared_belief": SHARED, "shared_upper": SHARED, "shared_node": SHARED,
}  # fmt: skip
"""What bounds the length of an array that grows."""


def make_store(tables: BoundTables, nodes: int = 1 << 10) -> NodeStore:
    """An empty store, with room for so many nodes."""
    steps, sets, types = tables.explain.shape
    actions, answers, shared = max(4 * nodes, 2 * sets), 4 * nodes, 16
    places = np.zeros((steps, sets), PLACE)
    places["shared"] = NONE
    return NodeStore(
        used=np.zeros(8, np.int64),
        nodes=np.zeros(nodes, NODE),
        belief=np.zeros((nodes, types)),
        evidence=np.zeros((nodes, types + tables.model.inquiry.words), np.int64),
        alpha=np.zeros((nodes, types)),
        actions=np.zeros(actions, ACTION),
        tail_alpha=np.zeros((actions, types)),
        answers=np.zeros(answers, ANSWER),
        candidates=np.zeros(actions, np.int64),
        places=places,
        shared_count=np.zeros((shared, 2), np.int64),
        shared_alpha=np.zeros((shared, KEPT, types)),
        shared_messages=np.zeros((shared, KEPT), np.int64),
        shared_belief=np.zeros((shared, KEPT, types)),
        shared_upper=np.zeros((shared, KEPT)),
        shared_node=np.zeros((shared, KEPT, 2), np.int64),
        hash_table=np.full(4 * nodes, NONE, np.int32),
    )


def grown(store: NodeStore) -> NodeStore:
    """The same store with twice the room for whatever has used up half of it."""
    arrays: dict[str, Any] = store._asdict()
    size = {kind: len(arrays[name]) for name, kind in _KIND.items()}
    short = {kind for kind in size if 2 * store.used[kind] >= size[kind]} or set(size)
    for name, kind in _KIND.items():
        if kind in short:
            array = arrays[name]
            # Fresh zeros cost nothing until they are touched.
            arrays[name] = np.zeros((2 * len(array), *array.shape[1:]), array.dtype)
            arrays[name][: store.used[kind]] = array[: store.used[kind]]
    arrays["hash_table"] = np.full(4 * len(arrays["nodes"]), NONE, np.int32)
    store.used[HASHED] = 0
    return NodeStore(**arrays)


def store_bytes(store: NodeStore) -> int:
    """What a store takes."""
    return sum(array.nbytes for array in store)


@inlined
def find(store, step, given, evidence):  # type: ignore[no-untyped-def]
    """The slot that holds this belief's node, or the free one where it belongs."""
    mask = np.uint64(len(store.hash_table) - 1)
    slot = hash_key(step, given, evidence) & mask
    while True:
        index = store.hash_table[slot]
        if index < 0:
            return slot
        node = store.nodes[index]
        here = node.step == step and node.given == given
        if here and same(store.evidence[index], evidence):
            return slot
        slot = (slot + np.uint64(1)) & mask


@inlined
def rehash(store):  # type: ignore[no-untyped-def]
    """Enters all nodes that a store's hash table does not hold since it grew."""
    for index in range(store.used[HASHED], store.used[NODES]):
        node = store.nodes[index]
        slot = find(store, node.step, node.given, store.evidence[index])
        store.hash_table[slot] = index
    store.used[HASHED] = store.used[NODES]
