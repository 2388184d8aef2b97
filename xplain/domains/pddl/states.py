"""The states that the robot's task or a believed one reaches, as sets of atoms in machine words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.domains.pddl.grounding import Ground
from xplain.domains.pddl.task import Atom, Literal
from xplain.errors import TooLargeError

Words = NDArray[np.uint64]
LARGEST_BATCH = 1 << 18
"""Pairs of a state and an action that are looked at at once."""


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
        masks = [sum({1 << self.number[x] for x in atoms if x in self.number}) for atoms in sets]
        packed = b"".join(mask.to_bytes(8 * self.width, "little") for mask in masks)
        return np.frombuffer(packed, "<u8").astype(np.uint64).reshape(-1, self.width)

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
        return _meet(rows, holds, lacks)


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
    variants = np.flatnonzero(allowed)
    found = {row.tobytes(): s for s, row in enumerate(seeds)}
    states, degrees, used, reached = list(seeds), [], [], []
    together, done = max(1, LARGEST_BATCH // max(1, len(variants))), 0
    while done < len(states) <= limit:
        rows = np.array(states[done : done + together])
        can = _meet(rows[:, None], compiled.holds[variants], compiled.lacks[variants])
        if len(ends[0]):
            can[_meet(rows[:, None], *ends).all(axis=1)] = False
        source, at = np.nonzero(can)  # by state, then by variant
        after, which = np.unique(
            _after(compiled, rows[source], variants[at]), axis=0, return_inverse=True
        )
        numbers = np.array([found.get(row.tobytes(), -1) for row in after], dtype=np.int32)
        _, first = np.unique(which, return_index=True)
        for new in sorted(np.flatnonzero(numbers < 0), key=first.__getitem__):
            numbers[new] = found[after[new].tobytes()] = len(states)
            states.append(after[new])
        degrees.append(can.sum(axis=1))
        used.append(variants[at])
        reached.append(numbers[which])
        done += len(rows)
    if len(states) > limit:
        raise TooLargeError(
            f"domain.max_states={limit}: the robot's and the believed tasks reach more states; use "
            "fewer objects, or allow more (memory and time grow with them)"
        )
    return Reached(
        np.array(states),
        np.concatenate([[0], np.cumsum(np.concatenate(degrees))]),
        np.concatenate(used).astype(np.int32),
        np.concatenate(reached),
    )


def _after(compiled: Compiled, states: Words, variants: NDArray[np.int64]) -> Words:
    """[n, W] the states [n, W] after these variants [n], which they meet."""
    count = np.diff(compiled.first)[variants]
    start = np.cumsum(count) - count
    edge = np.repeat(np.arange(len(variants)), count)
    effect = np.arange(len(edge)) - start[edge] + compiled.first[variants][edge]
    happens = _meet(states[edge], compiled.if_holds[effect], compiled.if_lacks[effect])
    edge, effect, result = edge[happens], effect[happens], states.copy()
    np.bitwise_and.at(result, edge, ~compiled.deletes[effect])
    np.bitwise_or.at(result, edge, compiled.adds[effect])  # what is added stays
    return result


def _meet(states: Words, holds: Words, lacks: Words) -> NDArray[np.bool_]:
    """Whether states have all atoms of ``holds`` and none of ``lacks``: the last axis is W."""
    return np.asarray((((states & holds) == holds) & ((states & lacks) == 0)).all(axis=-1))
