"""Tools for compiled kernels: decorators, functions on bitmasks, and random numbers. Of numba they
use the public API and three options that numba's compiler reads for each function: ``_nrt``,
``no_cpython_wrapper`` and ``no_cfunc_wrapper``.

numba caches machine code beside the source, or below ``NUMBA_CACHE_DIR``, and uses it until the
kernel's own file changes. A kernel may call functions in other files, so the name of the cache
entry contains a digest of these files.
"""

import logging
from collections.abc import Callable
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba
from numba import types, uint64
from numba.core import event
from numba.extending import intrinsic

log = logging.getLogger(__name__)

part = numba.njit(inline="always")
"""Decorates a function that gets whole tuples of arrays: numba copies its code into each kernel,
because a call would copy every array of the tuples."""

_OPTIONS = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}

inner = partial(numba.njit, **_OPTIONS, no_cpython_wrapper=True)
"""Decorates a function that only kernels call. numba then makes no entry for Python, which would
take an eighth of the time of compiling."""

small = partial(inner, forceinline=True)
"""Decorates a function that gets numbers and a few arrays: numba compiles it once, and LLVM copies
the result into the kernels. For such functions this takes much less time than ``part``."""


def kernel(function: Callable[..., Any], **options: bool) -> Any:
    """Decorates a kernel: it is compiled at its first call, cached if a folder can be written, and
    runs without the GIL."""
    parts = [getattr(used, "py_func", None) for used in function.__globals__.values()]
    files = {__file__, *(part.__code__.co_filename for part in parts if part)}
    digest = sha256(b"".join(Path(file).read_bytes() for file in sorted(files))).hexdigest()[:12]
    function.__qualname__ += f"_{digest}"
    compiled = numba.njit(**_OPTIONS, **options)(function)
    try:
        compiled.enable_caching()
    except RuntimeError as error:
        log.warning("every process compiles the kernels again (%s): set NUMBA_CACHE_DIR", error)
    return compiled


search = partial(kernel, _nrt=False)
"""Decorates a kernel that allocates no arrays, like :func:`kernel`. numba then counts no references
to arrays; otherwise it would update the counts at every call and for every row of an array. The
kernel's caller keeps the arrays alive. The functions that the kernel calls are compiled in the same
way."""


class _Compilation(event.Listener):  # type: ignore[misc]
    """A listener that logs the first compilation of an xplain kernel."""

    is_logged = False

    def on_start(self, event: event.Event) -> None:
        if not self.is_logged and (
            str(event.data["dispatcher"].py_func.__module__).startswith("xplain.")
        ):
            log.warning("compiling kernels once; later runs load them")
            self.is_logged = True

    def on_end(self, event: event.Event) -> None:
        """Logs nothing."""


event.register("numba:compile", _Compilation())


@intrinsic  # type: ignore[untyped-decorator]
def count_bits(typing: Any, mask: Any) -> Any:
    """Returns the number of bits that are 1."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.int64), generate


@small
def first_bit(mask):  # type: ignore[no-untyped-def]
    """Returns the position of the lowest bit that is 1, by one instruction of the processor."""
    return count_bits(~mask & (mask - 1))


@small
def nth_bit(mask, r):  # type: ignore[no-untyped-def]
    """Returns the position of the r-th bit that is 1 in a mask; r begins at 0."""
    for _ in range(r):
        mask &= mask - 1
    return first_bit(mask)


GOLDEN = 0x9E3779B97F4A7C15
"""The step of a random stream's counter."""


@small
def splitmix64(x):  # type: ignore[no-untyped-def]
    """Computes the random word of a counter (Steele, Lea & Flood 2014). It is also used as a
    hash."""
    x = (x ^ (x >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> uint64(27))) * uint64(0x94D049BB133111EB)
    return x ^ (x >> uint64(31))


@small
def next_uniform(counter):  # type: ignore[no-untyped-def]
    """Returns a random number in [0, 1), from the next word."""
    counter[0] += GOLDEN
    return float(splitmix64(counter[0]) >> uint64(11)) * 2.0**-53
