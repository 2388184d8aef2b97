"""How kernels are compiled and cached: every kernel of the package is made by this file.

numba takes a function from its cache where the function's own file is as it was, whatever became
of the functions that it calls in other files. So kernels are cached below a folder that is named
by a digest of all their sources: an edit of any of them compiles them all anew.
"""

from __future__ import annotations

import gc
import hashlib
import logging
import os
import re
import sys
import threading
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from llvmlite import ir
from numba import types, uint64
from numba.core import cgutils, event
from numba.core.compiler import Compiler
from numba.extending import intrinsic, typeof_impl

log = logging.getLogger(__name__)

PACKAGE = Path(__file__).parent
IMPORTS_NUMBA = re.compile(rb"(?m)^\s*(?:from|import) [\w., ]*\bnumba")
UNUSED_DAYS = 30
"""Machine code of sources that no process has loaded for so long is removed."""


def kernel_sources() -> dict[str, bytes]:
    """The package's files that can be part of machine code, as they import numba or this file:
    their content, by their path below the package."""
    texts = {path: path.read_bytes() for path in sorted(PACKAGE.rglob("*.py"))}
    return {
        path.relative_to(PACKAGE).as_posix(): text
        for path, text in texts.items()
        if IMPORTS_NUMBA.search(text)
    }


def sources_digest() -> str:
    """Digest of the kernels' sources, and of numpy and llvmlite, whose versions numba's cache does
    not look at (it does at numba's own, at Python's and at the processor): 16 hex digits."""
    digest = hashlib.sha256(f"{np.__version__} {llvmlite.__version__}".encode())
    for name, text in kernel_sources().items():
        digest.update(f"\0{name} {len(text)}\0".encode() + text)
    return digest.hexdigest()[:16]


@cache
def cache_folder() -> str:
    """Where this process caches kernels: ``xplain/kernels/<digest>`` below ``NUMBA_CACHE_DIR``, or
    else below the user's cache folder; empty, with a warning, where nothing can be written.

    No environment variable is set, so every process that a process starts finds the same folder.
    """
    try:
        base = Path(numba.config.CACHE_DIR or _user_cache_folder()) / "xplain" / "kernels"
        folder = base / sources_digest()
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)  # in use now
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(f"{folder} cannot be written")
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home folder
        log.warning("kernels are compiled anew by every process (%s): set NUMBA_CACHE_DIR", error)
        return ""
    _remove_unused(base)
    return str(folder)


def _user_cache_folder() -> Path:
    if sys.platform == "win32" and os.environ.get("LOCALAPPDATA"):
        return Path(os.environ["LOCALAPPDATA"])
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    chosen = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return chosen if chosen.is_absolute() else Path.home() / ".cache"


def _remove_unused(base: Path) -> None:
    """Removes the files of digests not used for UNUSED_DAYS. Folders stay: a process that has been
    running for longer than that finds no file and compiles, but it must be able to write one."""
    oldest = time.time() - UNUSED_DAYS * 86_400
    for folder in base.iterdir():
        try:
            if folder.stat().st_mtime < oldest:
                for path in folder.rglob("*.nb[ic]"):
                    path.unlink()
        except OSError:  # another process was first, or it is not ours to remove
            continue


_lock = threading.Lock()


def _compiled(function: Callable[..., Any], **options: Any) -> Any:
    """njit, with its cache in our folder. numba reads the setting when a function is decorated;
    functions of other packages stay where they were."""
    folder = cache_folder()
    with _lock:
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, folder
        options |= {"cache": bool(folder), "nogil": True, "no_cfunc_wrapper": True}  # no C calls us
        try:
            return numba.njit(**options)(function)
        finally:
            numba.config.CACHE_DIR = before


_entries: list[str] = []
"""Names of the kernels that Python calls, of the modules imported so far."""


def kernel(function: Callable[..., Any]) -> Any:
    """Decorates a kernel: compiled at its first call, cached, and run without the GIL."""
    _entries.append(function.__name__)
    return _compiled(function)


class _PartCompiler(Compiler):  # type: ignore[misc]
    """Compiles what is only called by kernels, and leaves it unoptimized: numba links it into each
    kernel, and optimizes all of it there. Half of the time that kernels take to compile.

    The one place that changes an inner part of numba, which has no setting for it.
    """

    def define_pipelines(self) -> Any:
        state = self.state
        library = state.targetctx.codegen().create_library(state.func_id.func_qualname)
        library.enable_object_caching()
        library._optimize_final_module = lambda: None
        state.library = library
        return super().define_pipelines()


def lean_kernel(function: Callable[..., Any]) -> Any:
    """Decorates a kernel that makes no array. numba counts references to arrays at every call and
    wherever a row is taken out of one; here it does not (``_nrt``), nor may what it calls."""
    _entries.append(function.__name__)
    return _compiled(function, _nrt=False)


_NO_CALL_FROM_PYTHON = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_LEAN_PART = {"_nrt": False, "no_cpython_wrapper": True, "pipeline_class": _PartCompiler}


class Part:
    """What only kernels call. From Python it is the plain function: what numba needs for such a
    call would take half of the time to compile.

    Attributes:
        compiled: numba's dispatcher, which kernels see.
        py_func: the plain function.
    """

    def __init__(self, compiled: Any, function: Callable[..., Any]) -> None:
        self.compiled = compiled
        self.py_func = function

    def __call__(self, *arguments: Any) -> Any:
        return self.py_func(*arguments)


@typeof_impl.register(Part)  # type: ignore[untyped-decorator]
def _typeof_part(value: Part, context: Any) -> Any:
    return numba.typeof(value.compiled)


def called(function: Callable[..., Any]) -> Part:
    """Decorates what kernels call."""
    return Part(numba.njit(nogil=True, **_NO_CALL_FROM_PYTHON)(function), function)


def shared_kernel(function: Callable[..., Any]) -> Part:
    """Decorates what several lean kernels call: compiled and cached once for all of them."""
    return Part(_compiled(function, **_LEAN_PART), function)


def inlined(function: Callable[..., Any]) -> Part:
    """Decorates what is inlined into every lean kernel that calls it: numba passes an array by
    value, seven words. For parts of hot loops; each caller compiles it once more."""
    part = numba.njit(forceinline=True, no_cfunc_wrapper=True, **_LEAN_PART)(function)
    return Part(part, function)


class _Compilation(event.Listener):  # type: ignore[misc]
    """Hears of each kernel of ours that numba did not find in its cache: tells of it, and lets it
    be compiled in about three quarters of the time. Garbage is not looked for: a compilation makes
    millions of objects, hardly any of them garbage. And loops are not vectorized: those of solvers
    run over some five types, the wide code would not be reached.

    Attributes:
        say: hears which kernel of how many, and "" when it is done; None: nobody is told.
    """

    def __init__(self) -> None:
        self.say: Callable[[str], None] | None = None
        self.nested = self.number = 0
        self.before = True, 1

    def on_start(self, event: event.Event) -> None:
        function = event.data["dispatcher"].py_func
        if self.nested == 0:
            if not str(function.__module__).startswith("xplain."):
                return
            self.before = gc.isenabled(), numba.config.LOOP_VECTORIZE
            gc.disable()
            numba.config.LOOP_VECTORIZE = 0
            if self.say is not None:
                self.number += 1
                of = max(len(_entries), self.number)
                self.say(f"kernel {self.number} of at most {of} ({function.__name__.strip('_')})")
        self.nested += 1

    def on_end(self, event: event.Event) -> None:
        if self.nested == 0:
            return
        self.nested -= 1
        if self.nested == 0:
            collects, numba.config.LOOP_VECTORIZE = self.before
            if collects:
                gc.enable()
            if self.say is not None:
                self.say("")


_compilation = _Compilation()
event.register("numba:compile", _compilation)


def _tell_once(text: str) -> None:
    if text.startswith("kernel 1 "):
        log.warning("compiling the solvers' kernels, once (seconds; later runs load them)")


def tell_when_compiling(say: Callable[[str], None] | None = None) -> None:
    """From now on this process tells when kernels have to be compiled.

    Args:
        say: hears which kernel of how many, and "" when it is done; None leaves it to whoever was
            given before, or else to one line in the log.
    """
    _compilation.say = say or _compilation.say or _tell_once


part = numba.njit(inline="always")
"""Decorates what a kernel is made of: it is compiled with each kernel that calls it."""


@intrinsic  # type: ignore[untyped-decorator]
def borrow(typing: Any, value: Any) -> Any:
    """The same arrays, in tuples of any depth, without counting references to them: numba would
    count at every call and for every row. Whoever called the kernel holds them meanwhile."""

    def uncounted(context: Any, builder: Any, kind: Any, own: Any) -> Any:
        if isinstance(kind, types.Array):
            array = context.make_array(kind)(context, builder, own)
            array.meminfo = cgutils.get_null_value(array.meminfo.type)
            array.parent = cgutils.get_null_value(array.parent.type)
            return array._getvalue()
        for i, each in enumerate(kind if isinstance(kind, types.BaseTuple) else ()):
            inner = uncounted(context, builder, each, builder.extract_value(own, i))
            own = builder.insert_value(own, inner, i)
        return own

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return uncounted(context, builder, value, arguments[0])

    return value(value), generate


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


@part
def nth_bit(mask, r):  # type: ignore[no-untyped-def]
    """The position of the r-th bit set in a mask, from 0."""
    for _ in range(r):
        mask &= mask - 1
    return first_bit(mask)


GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""What the counter of a random stream advances by."""


@part
def splitmix64(x):  # type: ignore[no-untyped-def]
    """The word of a counter (Steele, Lea & Flood 2014). Also a hash."""
    x = (x ^ (x >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> uint64(27))) * uint64(0x94D049BB133111EB)
    return x ^ (x >> uint64(31))


@part
def next_below(counter, count):  # type: ignore[no-untyped-def]
    """A random number in 0 … count − 1, from the next word."""
    counter[0] += GOLDEN
    return np.int64(((splitmix64(counter[0]) >> uint64(32)) * uint64(count)) >> uint64(32))


@part
def next_uniform(counter):  # type: ignore[no-untyped-def]
    """A random number in [0, 1), from the next word."""
    counter[0] += GOLDEN
    return np.float64(splitmix64(counter[0]) >> uint64(11)) * 2.0**-53
