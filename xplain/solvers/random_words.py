"""Random words: what simulations are drawn with.

The random stream is splitmix64 (Steele, Lea & Flood 2014): a counter of 64 bits, held in an array
of one element, and a function that mixes it into a word.
"""

from __future__ import annotations

import numpy as np
from numba import uint64

from xplain.numba_kernels import inlined

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""What the counter advances by."""


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
