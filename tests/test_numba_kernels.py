"""Kernels: cached machine code is that of the sources as they are, whichever file was edited."""

from __future__ import annotations

import ast
import gc
import logging
import os
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numba
import pytest
from numba.core import event
from packaging.requirements import Requirement

from xplain import numba_kernels
from xplain.numba_kernels import (
    PACKAGE,
    _Compilation,
    _compilation,
    _tell_once,
    cache_folder,
    kernel,
    kernel_sources,
)

CALLEE = """
from xplain.numba_kernels import inlined, kernel

@{decorator}
def callee(x):
    return x + {number}
"""
CALLER = """
from xplain.callee import callee
from xplain.numba_kernels import {decorator}, tell_when_compiling

tell_when_compiling()

@{decorator}
def caller(x):
    return 2 * callee(x)

if __name__ == "xplain.caller":
    print(caller(1))
"""


def run(folder: Path, code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Runs code with the package found in a folder first. No bytecode: of two edits of one size
    in a second Python would see one."""
    own = {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    env = os.environ | own | environment
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env=env,
        check=True,
        capture_output=True,
        text=True,
    )


@pytest.mark.parametrize(("outer", "inner"), [("kernel", "kernel"), ("lean_kernel", "inlined")])
def test_an_edited_callee_in_another_file_is_seen(tmp_path: Path, outer: str, inner: str) -> None:
    """And nothing is compiled where nothing was edited, also not back at the first sources."""
    copy, cache = tmp_path / "xplain", str(tmp_path / "cache")
    copy.mkdir()
    for name in ("__init__.py", "numba_kernels.py"):
        shutil.copy(PACKAGE / name, copy / name)
    (copy / "caller.py").write_text(CALLER.format(decorator=outer))
    outputs = []
    for number in (10, 10, 70, 10):
        (copy / "callee.py").write_text(CALLEE.format(decorator=inner, number=number))
        done = run(tmp_path, "import xplain.caller", NUMBA_CACHE_DIR=cache)
        outputs.append((int(done.stdout), "compiling" in done.stderr))
    assert outputs == [(22, True), (22, False), (142, True), (22, False)]


FOLDERS = """
import subprocess, sys
from xplain.numba_kernels import cache_folder
ask = "from xplain.numba_kernels import cache_folder; print(cache_folder())"
print(cache_folder())
print(subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True).stdout.strip())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="XDG_CACHE_HOME is Linux's")
@pytest.mark.parametrize(
    ("variable", "other"), [("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"), ("XDG_CACHE_HOME", "HOME")]
)
def test_every_process_started_finds_the_same_folder(
    tmp_path: Path, variable: str, other: str
) -> None:
    """Below NUMBA_CACHE_DIR, or else below the user's cache folder; not one below another."""
    chosen = {"NUMBA_CACHE_DIR": "", other: str(tmp_path / "b"), variable: str(tmp_path / "a")}
    here, child = run(PACKAGE.parent, FOLDERS, **chosen).stdout.split()
    assert here == child
    assert Path(here).parent == tmp_path / "a" / "xplain" / "kernels"


def test_works_where_nothing_can_be_written(tmp_path: Path) -> None:
    """Said in one line; the kernel compiles, and is not cached beside its source instead."""
    (tmp_path / "file").touch()
    (tmp_path / "mine.py").write_text(
        "from xplain.numba_kernels import kernel\n@kernel\ndef double(x):\n    return 2 * x\n"
        "print(double(4))"
    )
    paths = os.pathsep.join([str(tmp_path), str(PACKAGE.parent)])
    done = run(tmp_path, "import mine", PYTHONPATH=paths, NUMBA_CACHE_DIR=str(tmp_path / "file"))
    assert done.stdout.strip() == "8"
    assert len(done.stderr.splitlines()) == 1
    assert "NUMBA_CACHE_DIR" in done.stderr
    assert not (tmp_path / "__pycache__").exists()


def test_other_packages_cache_where_they_did() -> None:
    """Our decorator leaves numba's setting alone."""
    before = numba.config.CACHE_DIR
    kernel(lambda x: x)
    assert before == numba.config.CACHE_DIR


def test_machine_code_long_unused_is_removed_and_its_folder_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What another checkout used lately stays."""
    base = tmp_path / "xplain" / "kernels"
    for name, days in (("old", 31), ("recent", 29)):
        (base / name / "solvers_1").mkdir(parents=True)
        (base / name / "solvers_1" / "f-1.py311.nbi").touch()
        used = time.time() - days * 86_400
        os.utime(base / name, (used, used))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    folder = Path(cache_folder.__wrapped__())
    assert sorted(path.name for path in base.iterdir()) == sorted(["old", "recent", folder.name])
    assert [path.parent.parent.name for path in base.rglob("*.nbi")] == ["recent"]
    assert (base / "old" / "solvers_1").is_dir()


def trees() -> Iterator[tuple[str, ast.Module]]:
    """Every file of the package, by its path below it."""
    for path in sorted(PACKAGE.rglob("*.py")):
        yield path.relative_to(PACKAGE).as_posix(), ast.parse(path.read_bytes())


def test_all_kernels_are_made_by_our_decorators() -> None:
    """A kernel with a decorator of numba's own would be cached beside its source."""
    makers = {"njit", "jit", "vectorize", "guvectorize", "stencil", "cfunc", "jitclass"}
    for name, tree in trees():
        used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
        used |= {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        assert name == "numba_kernels.py" or not used & makers, name


def test_what_kernels_take_from_other_files_is_in_the_digest() -> None:
    """numba makes constants of the global names that a kernel uses, wherever they come from."""
    sources, seen = kernel_sources(), 0
    for name, tree in trees():
        origin = {
            alias.asname or alias.name: (node.module or "").split(".")
            for node in tree.body
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        for function in ast.walk(tree):
            if not isinstance(function, ast.FunctionDef):
                continue
            marks = {node.id for node in function.decorator_list if isinstance(node, ast.Name)}
            if not marks & {"kernel", "lean_kernel", "inlined", "intrinsic"}:
                continue
            seen += 1
            assert name in sources
            names = {node.id for body in function.body for node in ast.walk(body)
                     if isinstance(node, ast.Name)}  # fmt: skip
            for used in names & origin.keys():
                package, *path = origin[used]
                assert package != "xplain" or "/".join(path) + ".py" in sources, (name, used)
    assert seen > 20


@pytest.fixture
def compilation() -> Iterator[_Compilation]:
    """Another listener than the process's own, which has perhaps told of something."""
    event.unregister("numba:compile", _compilation)
    with event.install_listener("numba:compile", _Compilation()) as alone:
        yield alone
    event.register("numba:compile", _compilation)


def test_tells_of_a_compilation_once(
    compilation: _Compilation, caplog: pytest.LogCaptureFixture
) -> None:
    """One line for the first kernel of ours; none for another package's."""

    def add(x):  # type: ignore[no-untyped-def]
        return x + 1

    caplog.set_level(logging.WARNING)
    compilation.say = _tell_once
    numba.njit(add)(1)
    assert not caplog.messages
    add.__module__ = "xplain.somewhere"
    numba.njit(add)(1)
    numba.njit(add)(1.5)
    assert len(caplog.messages) == 1
    assert "compiling" in caplog.messages[0]


def test_tells_which_kernel_of_how_many_is_compiled_and_when_it_is_done(
    compilation: _Compilation,
) -> None:
    """A number never exceeds its total, whatever is compiled beside the kernels of the package."""
    said: list[str] = []
    compilation.say = said.append

    def first(x):  # type: ignore[no-untyped-def]
        return x + 1

    def second(x):  # type: ignore[no-untyped-def]
        return x + 2

    for function in (first, second):
        function.__module__ = "xplain.somewhere"
        numba.njit(function)(1)
    begun = [text for text in said if text]
    assert said[1::2] == ["", ""]
    assert [text.split()[1] for text in begun] == ["1", "2"]
    assert all(f"({name})" in text for name, text in zip(("first", "second"), begun, strict=True))
    assert all(int(text.split()[1]) <= int(text.split()[5]) for text in begun)


def test_numba_is_bounded_by_the_version_that_is_tested() -> None:
    """The compiler's inner parts may change with any version: none is installed untried."""
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    (bound,) = [Requirement(one) for one in project["dependencies"] if one.startswith("numba>")]
    major, minor = (int(part) for part in numba.__version__.split(".")[:2])
    assert bound.specifier.contains(numba.__version__)
    assert not bound.specifier.contains(f"{major}.{minor + 1}.0")


def test_the_cache_is_numbas_own_index_below_our_folder() -> None:
    """What a kernel of the package is cached in."""
    from xplain.solvers.pomcp.kernel import simulate

    assert str(simulate.stats.cache_path).startswith(cache_folder())
    assert cache_folder() != ""
    assert numba_kernels.sources_digest() in cache_folder()


@pytest.mark.parametrize("collects", [True, False])
def test_compiling_leaves_the_process_as_it_was(collects: bool) -> None:
    """Garbage collection and numba's setting come back, also after what does not compile, and of
    another package's function they are not touched."""
    seen: list[tuple[bool, int]] = []

    class Look(event.Listener):  # type: ignore[misc]
        def on_start(self, event: event.Event) -> None:
            seen.append((gc.isenabled(), numba.config.LOOP_VECTORIZE))

        on_end = on_start

    def add(x):  # type: ignore[no-untyped-def]
        return x + 1

    before = gc.isenabled(), numba.config.LOOP_VECTORIZE
    (gc.enable if collects else gc.disable)()
    try:
        with event.install_listener("numba:run_pass", Look()):
            numba.njit(add)(1)
            assert set(seen) == {(collects, before[1])}
            seen.clear()
            add.__module__ = "xplain.somewhere"
            numba.njit(add)(1)
            with pytest.raises(numba.TypingError):
                numba.njit(add)("no number")
            assert set(seen) == {(False, 0)}
        assert (gc.isenabled(), numba.config.LOOP_VECTORIZE) == (collects, before[1])
    finally:
        (gc.enable if before[0] else gc.disable)()
