"""Mutants tried one by one, each in a scratch copy of the repository; the work tree is only read.

What came out is kept at once in a session, a file of JSON lines: a campaign that was interrupted
goes on where it was.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from queue import SimpleQueue

from tests.mutants import operators
from tests.mutants.areas import Areas, Mutant, Stage

KILLED, SURVIVED, TIMEOUT = "killed", "survived", "timeout"
MEMORY = 8 << 30
"""Bytes that a process may take: a loop that never ends may fill the memory first."""
SLACK = 20
"""Seconds that a stage may take beyond four times what it takes without a mutant."""
NONE_COLLECTED = 5
"""pytest's exit code where all tests of a file are slow or need a browser."""
_LEFT_BEHIND = (".*", "outputs", "build", "dist", "*.egg-info")
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of a mutant: by which test it was killed, in how many seconds."""

    mutant: Mutant
    outcome: str
    killer: str
    seconds: float


class Interrupted(Exception):
    """The campaign is told to stop."""


class Copy:
    """A scratch copy of a repository, for one mutant at a time.

    Args:
        root: of the repository.
        folder: a new one, for the copy and all that its tests write.
    """

    def __init__(self, root: Path, folder: Path) -> None:
        self.root, self.folder = folder / "repository", folder
        # With times of change and __pycache__: kernels compiled in the work tree stay good.
        shutil.copytree(root, self.root, ignore=shutil.ignore_patterns(*_LEFT_BEHIND))
        (self.root / "outputs").mkdir()
        (folder / "tmp").mkdir()
        self.process: subprocess.Popen[bytes] | None = None

    @contextlib.contextmanager
    def mutated(self, mutant: Mutant, kernels: list[str]) -> Iterator[None]:
        """With the mutant in the copy. Kernels compiled from ``kernels`` are put aside: numba
        does not notice a change in what it inlined from another file."""
        path = self.root / mutant.path
        source, times = path.read_text("utf-8"), path.stat()
        mutated = operators.mutate(source, mutant.operator, mutant.occurrence)
        assert mutated is not None
        aside = self.folder / "compiled"
        aside.mkdir()
        for compiled in self._compiled(kernels):
            compiled.rename(aside / str(compiled.relative_to(self.root)).replace("/", "!"))
        try:
            path.write_text(mutated, "utf-8")
            self._forget(path)
            yield
        finally:
            path.write_text(source, "utf-8")
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
            self._forget(path)
            for compiled in self._compiled(kernels):
                compiled.unlink()
            for compiled in aside.iterdir():
                compiled.rename(self.root / compiled.name.replace("!", "/"))
            aside.rmdir()

    def run(self, stage: Stage, limit: float | None = None) -> tuple[str, str, float]:
        """Outcome of the stage's tests, the test that failed, and seconds."""
        shutil.rmtree(self.root / ".hypothesis", ignore_errors=True)
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
        command += ["-m", "not slow and not browser", "--basetemp", str(self.folder / "tmp/tests")]
        environment = os.environ | {
            "PYTHONPATH": str(self.root),
            "TMPDIR": str(self.folder / "tmp"),
            "COLUMNS": "1000",
        }
        if not stage.compiled:
            # Compiled code wraps around at 64 bits without a word.
            command += ["-W", "ignore::RuntimeWarning"]
            environment["NUMBA_DISABLE_JIT"] = "1"
        began = time.monotonic()
        with (self.folder / "output").open("w+b") as output:
            self.process = subprocess.Popen(
                [*command, *stage.tests],
                cwd=self.root,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                with contextlib.suppress(ProcessLookupError):
                    resource.prlimit(self.process.pid, resource.RLIMIT_AS, (MEMORY, MEMORY))
                code = self.process.wait(limit)
            except subprocess.TimeoutExpired:
                return TIMEOUT, "", time.monotonic() - began
            finally:
                self.stop()
            seconds = time.monotonic() - began
            output.seek(0)
            text = output.read().decode(errors="replace")
        if code in (0, NONE_COLLECTED):
            return SURVIVED, "", seconds
        failed = _FAILED.search(text)
        return KILLED, failed[1] if failed else f"pytest ended with {code}", seconds

    def stop(self) -> None:
        """Ends the tests that run, and all that they started."""
        if self.process is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()

    def _compiled(self, modules: list[str]) -> list[Path]:
        return [
            found
            for module in modules
            for found in (self.root / module).parent.glob(
                f"__pycache__/{Path(module).stem}.*.nb[ic]"
            )
        ]

    def _forget(self, path: Path) -> None:
        # A .pyc tells a change by size and second alone.
        for compiled in path.parent.glob(f"__pycache__/{path.stem}.*.pyc"):
            compiled.unlink()


class Campaign:
    """Tries mutants, and writes what came out to a session.

    Args:
        areas: of the repository.
        session: its file; made where there is none.
        say: is told each outcome.
    """

    def __init__(self, areas: Areas, session: Path, say: Callable[[str], None] = print) -> None:
        self.areas, self.session, self.say = areas, session, say
        self._baseline: dict[tuple[Copy, Stage], float | None] = {}
        self._lock = threading.Lock()
        self._stopped = threading.Event()

    def outcomes(self) -> dict[str, Outcome]:
        """What the session holds, the last of each mutant."""
        found: dict[str, Outcome] = {}
        if self.session.exists():
            for line in self.session.read_text("utf-8").splitlines(keepends=True):
                if not line.endswith("}\n"):
                    continue  # cut short by a crash
                entry = json.loads(line)
                outcome = Outcome(**entry | {"mutant": Mutant(**entry["mutant"])})
                found[outcome.mutant.key] = outcome
        return found

    def run(self, mutants: list[Mutant], jobs: int) -> None:
        """Tries them all.

        Raises:
            KeyboardInterrupt: on Ctrl-C, once all that was started has ended and the copies are
                gone; what was found until then is in the session.
        """
        self.session.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="mutants-") as scratch:
            copies = [Copy(self.areas.root, Path(scratch, str(job))) for job in range(jobs)]
            free: SimpleQueue[Copy] = SimpleQueue()
            for copy in copies:
                free.put(copy)
            with ThreadPoolExecutor(jobs) as pool:
                tasks = [pool.submit(self._one, mutant, free) for mutant in mutants]
                try:
                    for task in as_completed(tasks):
                        task.result()
                finally:
                    self._stopped.set()
                    for task in tasks:
                        task.cancel()
                    for copy in copies:
                        copy.stop()

    def _one(self, mutant: Mutant, free: SimpleQueue[Copy]) -> None:
        copy = free.get()
        try:
            outcome = self._try(mutant, copy)
        finally:
            free.put(copy)
        with self._lock, self.session.open("a", encoding="utf-8") as file:
            file.write(json.dumps(dataclasses.asdict(outcome)) + "\n")
        self.say(
            f"{outcome.outcome:8} {outcome.seconds:5.0f} s  {mutant.path}:{mutant.line}  "
            f"{mutant.operator}  {outcome.killer}"
        )

    def _try(self, mutant: Mutant, copy: Copy) -> Outcome:
        kernels = self.areas.kernels_behind(mutant.path)
        total = 0.0
        for stage in self.areas.stages(mutant.area, mutant.path):
            stage, limit = self._sound(stage, copy)
            if not stage.tests:
                continue
            if kernels and stage.compiled:
                limit += 120  # to compile anew
            with copy.mutated(mutant, kernels):
                outcome, killer, seconds = copy.run(stage, limit)
            self._go_on()
            total += seconds
            if outcome != SURVIVED:
                return Outcome(mutant, outcome, killer, total)
        return Outcome(mutant, SURVIVED, "", total)

    def _sound(self, stage: Stage, copy: Copy) -> tuple[Stage, float]:
        """The stage without tests that fail without a mutant, and the seconds it may take.

        Each file is run once in each copy: that also compiles the kernels there.
        """
        taken = {}
        for test in stage.tests:
            alone = Stage((test,), stage.compiled)
            if (copy, alone) not in self._baseline:
                outcome, failed, seconds = copy.run(alone)
                if outcome != SURVIVED:
                    self._go_on()
                    outcome, failed, seconds = copy.run(alone)
                self._go_on()
                if outcome != SURVIVED:
                    self.say(f"left out, fails without a mutant: {failed or test}")
                self._baseline[copy, alone] = seconds if outcome == SURVIVED else None
            if (seconds := self._baseline[copy, alone]) is not None:
                taken[test] = seconds
        return Stage(tuple(taken), stage.compiled), SLACK + 4 * sum(taken.values())

    def _go_on(self) -> None:
        if self._stopped.is_set():
            raise Interrupted
