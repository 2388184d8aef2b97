"""How kernels are compiled and cached: every kernel of the package is made by this file.

numba takes a function from its cache where the function's own file is as it was, whatever became
of the functions that it calls in other files. So kernels are cached below a folder that is named
by a digest of all their sources: an edit of any of them compiles them all anew.
"""

from __future__ import annotations

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
from numba.core import event
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering
from numba.extending import typeof_impl

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
        is_new = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)  # in use now
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(f"{folder} cannot be written")
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home folder
        log.warning("kernels are compiled anew by every process (%s): set NUMBA_CACHE_DIR", error)
        return ""
    if is_new:
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


def kernel(function: Callable[..., Any]) -> Any:
    """Decorates a kernel: compiled at its first call, cached, and run without the GIL."""
    return _compiled(function)


@register_pass(mutates_CFG=True, analysis_only=False)
class _LowerPart(NativeLowering):  # type: ignore[misc]
    """numba links what a kernel calls into the kernel, and optimizes all of it there: whatever is
    only called by kernels need not be optimized before, by itself and in each of its callers."""

    _name = "lower_part"

    def run_pass(self, state: Any) -> bool:
        state.library = state.targetctx.codegen().create_library(state.func_id.func_qualname)
        state.library.enable_object_caching()
        state.library._optimize_final_module = lambda: None
        return bool(super().run_pass(state))


@register_pass(mutates_CFG=True, analysis_only=False)
class _LowerInlined(_LowerPart):
    """Nor is what is never called, but inlined, made into machine code."""

    _name = "lower_inlined"

    def run_pass(self, state: Any) -> bool:
        state.flags.no_compile = True
        done = super().run_pass(state)
        state.library._finalize_specific = lambda: None
        never_called = [].clear  # numba wants a built-in function, another one for each
        state.cr = state.cr._replace(cfunc=never_called)
        state.targetctx.insert_user_function(never_called, state.cr.fndesc, [state.library])
        return done


class _Part(CompilerBase):  # type: ignore[misc]
    """Compiles what is only called by kernels."""

    lowering: type[_LowerPart] = _LowerPart

    def define_pipelines(self) -> list[Any]:
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [
            (self.lowering if each is NativeLowering else each, why) for each, why in passes.passes
        ]
        passes.finalize()
        return [passes]


class _Inlined(_Part):
    """Compiles what is inlined."""

    lowering = _LowerInlined


class shared_kernel:
    """Decorates a lean kernel that several others call: compiled and cached once, without what a
    call from Python would take. Called from Python, it is the plain function."""

    def __init__(self, function: Callable[..., Any]) -> None:
        unwrapped = {"no_cpython_wrapper": True, "pipeline_class": _Part}
        self.compiled = _compiled(function, _nrt=False, **unwrapped)
        self.py_func = function

    def __call__(self, *arguments: Any) -> Any:
        return self.py_func(*arguments)


def lean_kernel(function: Callable[..., Any]) -> Any:
    """Decorates a kernel that makes no array. numba counts references to arrays at every call and
    wherever a row is taken out of one; here it does not (``_nrt``), nor may what it calls."""
    return _compiled(function, _nrt=False)


class inlined:
    """Decorates what is inlined into every lean kernel that calls it: numba passes an array by
    value, seven words. For parts of hot loops; each caller compiles it once more.

    Called from Python, it is the plain function: what numba needs for such a call would take half
    of the time to compile.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        unwrapped = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        options = unwrapped | {"forceinline": True, "_nrt": False, "pipeline_class": _Inlined}
        self.compiled = numba.njit(**options)(function)
        self.py_func = function

    def __call__(self, *arguments: Any) -> Any:
        return self.py_func(*arguments)


@typeof_impl.register(inlined)  # type: ignore[untyped-decorator]
@typeof_impl.register(shared_kernel)  # type: ignore[untyped-decorator]
def _typeof_inlined(value: inlined | shared_kernel, context: Any) -> Any:
    return numba.typeof(value.compiled)


class _Listener(event.Listener):  # type: ignore[misc]
    """Speaks at the first kernel of ours that numba did not find in its cache."""

    told = False

    def on_start(self, event: event.Event) -> None:
        kernel = event.data["dispatcher"].py_func
        if not self.told and kernel.__module__.startswith("xplain."):
            self.told = True
            log.warning("compiling the solvers' kernels, once (seconds; later runs load them)")

    def on_end(self, event: event.Event) -> None:
        pass


@cache
def tell_when_compiling() -> None:
    """From now on, one line is logged in this process when a kernel has to be compiled."""
    event.register("numba:compile", _Listener())
