"""Random words and bit masks: what simulations are drawn with.

The random stream is splitmix64 (Steele, Lea & Flood 2014): a counter of 64 bits, held in an array
of one element, and a function that mixes it into a word.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types, uint64
from numba.extending import intrinsic

from xplain.numba_kernels import inlined

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""What the counter advances by."""


@intrinsic  # type: ignore[untyped-decorator]
def first_bit(typing: Any, mask: Any) -> Any:
    """The position of the lowest bit set; undefined for 0."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), generate


@intrinsic  # type: ignore[untyped-decorator]
def count_bits(typing: Any, mask: Any) -> Any:
    """How many bits are set."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.int64), generate


@inlined
def nth_bit(mask, r):  # type: ignore[no-untyped-def]
    """The position of the r-th bit set in a mask, from 0."""
    for _ in range(r):
        mask &= mask - 1
    return first_bit(mask)


@inlined
def splitmix64(x):  # type: ignore[no-untyped-def]
    """The word of a counter. Also a hash."""
    x = (x ^ (x >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> uint64(27))) * uint64(0x94D049BB133111EB)
    return x ^ (x >> uint64(31))


@inlined
def next_below(counter, count):  # type: ignore[no-untyped-def]
    """A random number in 0 … count − 1, from the next word."""
    counter[0] += GOLDEN
    return np.int64(((splitmix64(counter[0]) >> uint64(32)) * uint64(count)) >> uint64(32))


@inlined
def next_uniform(counter):  # type: ignore[no-untyped-def]
    """A random number in [0, 1), from the next word."""
    counter[0] += GOLDEN
    return np.float64(splitmix64(counter[0]) >> uint64(11)) * 2.0**-53
