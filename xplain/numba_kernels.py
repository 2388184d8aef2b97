"""Tools for compiled kernels, made with numba's public API: decorators, functions on bitmasks, and
random numbers.

numba caches machine code beside the source, or below ``NUMBA_CACHE_DIR``, and uses it until the
kernel's own file changes. A kernel may call functions in other files, so the name of the cache
entry contains a digest of these files.
"""

import logging
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types, uint64
from numba.core import cgutils, event
from numba.extending import intrinsic

log = logging.getLogger(__name__)

part = numba.njit(inline="always")
"""Decorates a function that gets whole tuples of arrays: numba copies its code into each kernel,
because a call would copy every array of the tuples."""

small = numba.njit(nogil=True, error_model="numpy", forceinline=True)
"""Decorates a function that gets numbers and a few arrays: numba compiles it once, and LLVM copies
the result into the kernels. For such functions this takes much less time than ``part``."""


def kernel(function: Callable[..., Any]) -> Any:
    """Decorates a kernel: it is compiled at its first call, cached if a folder can be written, and
    runs without the GIL."""
    files = {__file__}
    for used in function.__globals__.values():
        if code := getattr(getattr(used, "py_func", None), "__code__", None):
            files.add(code.co_filename)
    digest = sha256(b"".join(Path(file).read_bytes() for file in sorted(files))).hexdigest()[:12]
    function.__qualname__ += f"_{digest}"
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError as error:
        log.warning("every process compiles the kernels again (%s): set NUMBA_CACHE_DIR", error)
        return numba.njit(nogil=True, error_model="numpy")(function)


class _Compilation(event.Listener):  # type: ignore[misc]
    """A listener that logs the first compilation of an xplain kernel."""

    is_logged = False

    def on_start(self, event: event.Event) -> None:
        function = event.data["dispatcher"].py_func
        if not self.is_logged and str(function.__module__).startswith("xplain."):
            log.warning("compiling kernels once; later runs load them")
            self.is_logged = True

    def on_end(self, event: event.Event) -> None:
        """Logs nothing."""


@cache
def tell_when_compiling() -> None:
    """Makes this process log, from now on, when kernels are compiled for the first time."""
    event.register("numba:compile", _Compilation())


@intrinsic  # type: ignore[untyped-decorator]
def borrow(typing: Any, value: Any) -> Any:
    """Returns the same arrays, in tuples of any depth, without reference counts: numba would update
    the counts at every call and for every row. The kernel's caller keeps the arrays alive."""

    def drop_counts(context: Any, builder: Any, kind: Any, own: Any) -> Any:
        if isinstance(kind, types.Array):
            array = context.make_array(kind)(context, builder, own)
            array.meminfo = cgutils.get_null_value(array.meminfo.type)
            array.parent = cgutils.get_null_value(array.parent.type)
            return array._getvalue()
        for i, each in enumerate(kind if isinstance(kind, types.BaseTuple) else ()):
            inner = drop_counts(context, builder, each, builder.extract_value(own, i))
            own = builder.insert_value(own, inner, i)
        return own

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return drop_counts(context, builder, value, arguments[0])

    return value(value), generate


@intrinsic  # type: ignore[untyped-decorator]
def first_bit(typing: Any, mask: Any) -> Any:
    """Returns the position of the lowest bit that is 1; undefined for 0."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), generate


@intrinsic  # type: ignore[untyped-decorator]
def count_bits(typing: Any, mask: Any) -> Any:
    """Returns the number of bits that are 1."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.int64), generate


@small
def nth_bit(mask, r):  # type: ignore[no-untyped-def]
    """Returns the position of the r-th bit that is 1 in a mask; r begins at 0."""
    for _ in range(r):
        mask &= mask - 1
    return first_bit(mask)


GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""The step of a random stream's counter."""


@small
def splitmix64(x):  # type: ignore[no-untyped-def]
    """Computes the random word of a counter (Steele, Lea & Flood 2014). It is also used as a
    hash."""
    x = (x ^ (x >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> uint64(27))) * uint64(0x94D049BB133111EB)
    return x ^ (x >> uint64(31))


@small
def next_below(counter, count):  # type: ignore[no-untyped-def]
    """Returns a random number in 0 … count − 1, from the next word."""
    counter[0] += GOLDEN
    return np.int64(((splitmix64(counter[0]) >> uint64(32)) * uint64(count)) >> uint64(32))


@small
def next_uniform(counter):  # type: ignore[no-untyped-def]
    """Returns a random number in [0, 1), from the next word."""
    counter[0] += GOLDEN
    return np.float64(splitmix64(counter[0]) >> uint64(11)) * 2.0**-53
