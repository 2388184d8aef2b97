"""Scratch copies of the repository, and tests run in them."""

from __future__ import annotations

import contextlib
import math
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tests.mutants import operators
from tests.mutants.areas import Mutant, Stage

KILLED, SURVIVED, TIMEOUT = "killed", "survived", "timeout"
MEMORY = 8 << 30
"""Bytes that a process may take: a loop that never ends may fill the memory first."""
NONE_COLLECTED = 5
"""pytest's exit code where all tests of a file are slow or need a browser."""
_LEFT_BEHIND = (".*", "outputs", "build", "dist", "*.egg-info")
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)


class Run(NamedTuple):
    """How tests ended: the one that failed, seconds of processor time and of waiting."""

    outcome: str
    failed: str
    cpu: float
    wall: float


class Copy:
    """A scratch copy of a repository, for one mutant at a time.

    Args:
        root: of the repository.
        folder: a new one, for the copy and all that its tests write.
    """

    def __init__(self, root: Path, folder: Path) -> None:
        self.root, self.folder = folder / "repository", folder
        shutil.copytree(root, self.root, ignore=shutil.ignore_patterns(*_LEFT_BEHIND))
        (self.root / "outputs").mkdir()
        (folder / "tmp").mkdir()
        self._process: subprocess.Popen[bytes] | None = None
        self._ended = False

    @contextlib.contextmanager
    def mutated(self, mutant: Mutant) -> Iterator[None]:
        """With the mutant in the copy. Kernels that are compiled with it are removed after it."""
        path = self.root / mutant.path
        source, times = path.read_text("utf-8"), path.stat()
        mutated = operators.mutate(source, mutant.operator, mutant.occurrence)
        assert mutated is not None
        compiled = self._compiled()
        try:
            path.write_text(mutated, "utf-8")
            self._forget(path)
            yield
        finally:
            path.write_text(source, "utf-8")
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
            self._forget(path)
            for new in self._compiled() - compiled:
                shutil.rmtree(new)

    def run(self, stage: Stage, cpu: float | None = None, wall: float | None = None) -> Run:
        """The stage's tests.

        Args:
            stage: which, and how.
            cpu: seconds of processor time that they may take, whatever else the machine does.
            wall: seconds that they may take, where they wait for what never comes.
        """
        shutil.rmtree(self.root / ".hypothesis", ignore_errors=True)
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
        command += ["-m", "not slow and not browser", "--basetemp", str(self.folder / "tmp/tests")]
        environment = os.environ | {
            "PYTHONPATH": str(self.root),
            "TMPDIR": str(self.folder / "tmp"),
            "NUMBA_CACHE_DIR": str(self.folder / "compiled"),
            "COLUMNS": "1000",
        }
        if not stage.compiled:
            # Compiled code wraps around at 64 bits without a word.
            command += ["-W", "ignore::RuntimeWarning"]
            environment["NUMBA_DISABLE_JIT"] = "1"
        with (self.folder / "output").open("w+b") as output:
            began = time.monotonic()
            self._process = subprocess.Popen(
                [*command, *stage.tests],
                cwd=self.root,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            if self._ended:
                self._kill()
            with contextlib.suppress(ProcessLookupError):
                resource.prlimit(self._process.pid, resource.RLIMIT_AS, (MEMORY, MEMORY))
                if cpu is not None:
                    limits = math.ceil(cpu), math.ceil(cpu) + 5
                    resource.prlimit(self._process.pid, resource.RLIMIT_CPU, limits)
            code, used = self._wait(wall)
            waited = time.monotonic() - began
            output.seek(0)
            text = output.read().decode(errors="replace")
        if code in (0, NONE_COLLECTED):
            return Run(SURVIVED, "", used, waited)
        if code in (None, -signal.SIGXCPU, -signal.SIGKILL):
            return Run(TIMEOUT, "", used, waited)
        failed = _FAILED.search(text)
        return Run(KILLED, failed[1] if failed else f"pytest ended with {code}", used, waited)

    def _wait(self, wall: float | None) -> tuple[int | None, float]:
        """Exit code, None where it took too long, and processor time of it and its children."""
        assert self._process is not None
        ends = time.monotonic() + (wall or math.inf)
        late = False
        while True:
            pid, status, used = os.wait4(self._process.pid, os.WNOHANG)
            if pid:
                break
            if not late and time.monotonic() > ends:
                late = True
                self._kill()
            time.sleep(0.05)
        self._process.returncode = os.waitstatus_to_exitcode(status)
        self._kill()  # what the tests have left running
        return None if late else self._process.returncode, used.ru_utime + used.ru_stime

    def _kill(self) -> None:
        """Ends the tests and all that they started, also what has a session of its own: it is
        known by the folder for temporary files that it was given."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
        mark = f"\0TMPDIR={self.folder / 'tmp'}\0".encode()
        while found := [pid for pid in _processes() if mark in _environment(pid)]:
            for pid in found:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(0.01)

    def end(self) -> None:
        """Ends the tests that run, and all that they started; later ones end at once."""
        self._ended = True
        self._kill()

    def _compiled(self) -> set[Path]:
        # Each in a folder that is named by all kernels' sources: those of a mutant in its own.
        return set(self.folder.glob("compiled/xplain/kernels/*"))

    def _forget(self, path: Path) -> None:
        # A .pyc tells a change by size and second alone.
        for compiled in path.parent.glob(f"__pycache__/{path.stem}.*.pyc"):
            compiled.unlink()


def _processes() -> list[int]:
    return [int(path.name) for path in Path("/proc").glob("[0-9]*")]


def _environment(pid: int) -> bytes:
    """With a zero before and after each variable; none of a process that has ended."""
    try:
        return b"\0" + Path(f"/proc/{pid}/environ").read_bytes()
    except OSError:
        return b""
