"""The states that the robot's task or a believed one reaches, as sets of atoms in machine words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.domains.pddl.grounding import Ground
from xplain.domains.pddl.task import Atom, Literal
from xplain.errors import TooLargeError
from xplain.numba_kernels import kernel

Words = NDArray[np.uint64]


class Bits:
    """Sets of atoms as rows of W 64-bit words."""

    def __init__(self, atoms: Sequence[Atom]) -> None:
        """Numbers the atoms."""
        self.atoms = tuple(atoms)
        self.number = {atom: i for i, atom in enumerate(atoms)}
        self.width = max(1, -(-len(atoms) // 64))

    def row(self, atoms: Iterable[Atom]) -> Words:
        """[W] the set of these atoms, without those that have no number."""
        return np.asarray(self.rows([atoms])[0])

    def rows(self, sets: Iterable[Iterable[Atom]]) -> Words:
        """[n, W] one row for each set."""
        listed = list(sets)
        result = np.zeros((len(listed), self.width), dtype=np.uint64)
        for i, atoms in enumerate(listed):
            for atom in atoms:
                if (bit := self.number.get(atom)) is not None:
                    result[i, bit // 64] |= np.uint64(1 << bit % 64)
        return result

    def table(self, rows: Words) -> NDArray[np.bool_]:
        """[n, atoms] whether each row has each atom."""
        bits = np.arange(len(self.atoms))
        return (rows[:, bits // 64] >> (bits % 64).astype(np.uint64) & np.uint64(1)).astype(bool)

    def meets(self, rows: Words, literals: Iterable[Literal]) -> NDArray[np.bool_]:
        """[n] whether each row meets all literals; an atom without a number never holds."""
        listed = list(literals)
        if any(x.positive and x.atom not in self.number for x in listed):
            return np.zeros(len(rows), dtype=bool)
        holds = self.row(x.atom for x in listed if x.positive)
        lacks = self.row(x.atom for x in listed if not x.positive)
        return np.asarray(((rows & holds) == holds).all(axis=1) & ((rows & lacks) == 0).all(axis=1))


@dataclass(frozen=True)
class Compiled:
    """Variants of ground actions for the kernel: [V, W] the preconditions of each, and [X, W] the
    effects, those of variant v from first[v] to first[v + 1]."""

    holds: Words
    lacks: Words
    first: NDArray[np.int64]
    if_holds: Words
    if_lacks: Words
    adds: Words
    deletes: Words

    @classmethod
    def of(cls, bits: Bits, variants: Sequence[Ground]) -> Compiled:
        """In the order given."""
        effects = [effect for variant in variants for effect in variant.effects]
        return cls(
            bits.rows(variant.holds for variant in variants),
            bits.rows(variant.lacks for variant in variants),
            np.cumsum([0, *(len(variant.effects) for variant in variants)]),
            *(bits.rows(effect[i] for effect in effects) for i in range(4)),
        )


@dataclass(frozen=True)
class Reached:
    """What :func:`explore` found: [S, W] states, and the edges, rising by state and variant:
    [S + 1] the first of each state, [E] variants, [E] successors."""

    states: Words
    first: NDArray[np.int64]
    variant: NDArray[np.int32]
    successor: NDArray[np.int32]


def explore(
    compiled: Compiled,
    seeds: Words,
    allowed: NDArray[np.bool_],
    ends: tuple[Words, Words],
    limit: int,
) -> Reached:
    """All states reached from the seeds, breadth first; the seeds come first, in their order.

    Args:
        compiled: V variants.
        seeds: [n, W] distinct states.
        allowed: [V] the variants to use.
        ends: [G, W] the atoms that hold and [G, W] those that do not hold in each of G goals; a
            state that meets all G has no edges. With G = 0 all states have edges.
        limit: largest number of states.

    Raises:
        TooLargeError: there are more states.
    """
    found = _explore(
        compiled.holds, compiled.lacks, compiled.first, compiled.if_holds, compiled.if_lacks,
        compiled.adds, compiled.deletes, seeds, np.flatnonzero(allowed), ends[0], ends[1], limit,
    )  # fmt: skip
    states, first, variant, successor = found
    if len(states) > limit:
        raise TooLargeError(
            f"domain.max_states={limit}: the robot's and the believed tasks reach more states; use "
            "fewer objects, or allow more (memory and time grow with them)"
        )
    return Reached(states, first, variant, successor)


@kernel
def _explore(  # type: ignore[no-untyped-def]
    holds, lacks, first_effect, if_holds, if_lacks, adds, deletes, seeds, allowed,
    end_holds, end_lacks, limit,
):  # fmt: skip
    """Stops when there are more states than ``limit``."""
    width = seeds.shape[1]
    capacity = max(1024, 2 * len(seeds))
    states = np.zeros((capacity, width), dtype=np.uint64)
    table = np.full(4 * capacity, -1, dtype=np.int64)
    first = np.zeros(capacity + 1, dtype=np.int64)
    variant = np.empty(4 * capacity, dtype=np.int32)
    successor = np.empty(4 * capacity, dtype=np.int32)
    count, edges = 0, 0
    for i in range(len(seeds)):
        states[count] = seeds[i]
        place = _place(states, table, states[count])
        table[place] = count
        count += 1
    after = np.zeros(width, dtype=np.uint64)
    removed = np.zeros(width, dtype=np.uint64)
    s = 0
    while s < count and count <= limit:
        first[s] = edges
        if len(end_holds) == 0 or not _meets_all(states[s], end_holds, end_lacks):
            for v in allowed:
                if not _meets(states[s], holds[v], lacks[v]):
                    continue
                after[:] = 0
                removed[:] = 0
                for x in range(first_effect[v], first_effect[v + 1]):
                    if _meets(states[s], if_holds[x], if_lacks[x]):
                        for w in range(width):
                            after[w] |= adds[x, w]
                            removed[w] |= deletes[x, w]
                for w in range(width):
                    after[w] |= states[s, w] & ~removed[w]  # what is added stays
                place = _place(states, table, after)
                if table[place] < 0:
                    if count == capacity:
                        capacity *= 2
                        more = np.zeros((capacity, width), dtype=np.uint64)
                        more[:count] = states
                        states = more
                        more_first = np.zeros(capacity + 1, dtype=np.int64)
                        more_first[: count + 1] = first
                        first = more_first
                        table = np.full(4 * capacity, -1, dtype=np.int64)
                        for i in range(count):
                            table[_place(states, table, states[i])] = i
                        place = _place(states, table, after)
                    states[count] = after
                    table[place] = count
                    count += 1
                if edges == len(variant):
                    variant = _doubled(variant)
                    successor = _doubled(successor)
                variant[edges] = v
                successor[edges] = table[place]
                edges += 1
        s += 1
    for rest in range(s, count + 1):
        first[rest] = edges
    return (
        states[:count].copy(),
        first[: count + 1].copy(),
        variant[:edges].copy(),
        successor[:edges].copy(),
    )


@kernel
def _place(states, table, row):  # type: ignore[no-untyped-def]
    """The slot of a state in the table of numbers, or its free slot: open addressing."""
    mixed = np.uint64(0x9E3779B97F4A7C15)
    key = np.uint64(0)
    for word in row:
        key = (key ^ word) * mixed
        key ^= key >> np.uint64(29)
    place = np.int64(key % np.uint64(len(table)))
    while table[place] >= 0:
        same = True
        for w in range(len(row)):
            if states[table[place], w] != row[w]:
                same = False
                break
        if same:
            break
        place = np.int64(0) if place + 1 == len(table) else np.int64(place + 1)
    return place


@kernel
def _meets(state, holds, lacks):  # type: ignore[no-untyped-def]
    for w in range(len(state)):
        if (state[w] & holds[w]) != holds[w] or (state[w] & lacks[w]) != 0:
            return False
    return True


@kernel
def _meets_all(state, holds, lacks):  # type: ignore[no-untyped-def]
    met = 0
    for goal in range(len(holds)):
        met += _meets(state, holds[goal], lacks[goal])
    return met == len(holds)


@kernel
def _doubled(values):  # type: ignore[no-untyped-def]
    more = np.empty(2 * len(values), dtype=values.dtype)
    more[: len(values)] = values
    return more
