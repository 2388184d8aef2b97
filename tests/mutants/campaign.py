"""Mutants tried one by one, each in a scratch copy of the repository; the work tree is only read.

What came out is kept at once in a session, a file of JSON lines: a campaign that was interrupted
goes on where it was.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from tests.mutants.areas import Areas, Mutant, Stage
from tests.mutants.scratch import SURVIVED, Copy

SLACK = 60
"""Seconds of processor time that a mutant may take beyond four times what the tests take without
one: as much as to compile the kernels."""

TOGETHER = 20
"""Seconds of processor time of the tests that one process runs: to start one takes a few."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of a mutant: by which test it was killed, in how many seconds of processor
    time."""

    mutant: Mutant
    outcome: str
    killer: str
    seconds: float


class Interrupted(Exception):
    """The campaign is told to stop."""


class Session:
    """A file of JSON lines: outcomes, and what tests take without a mutant."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()

    def outcomes(self) -> dict[str, Outcome]:
        """By the mutant's key, the last of each."""
        found = {}
        for entry in self._read("outcome"):
            outcome = Outcome(**entry | {"mutant": Mutant(**entry["mutant"])})
            found[outcome.mutant.key] = outcome
        return found

    def baselines(self) -> dict[Stage, tuple[float, float]]:
        """Seconds of processor time and of waiting that tests took without a mutant."""
        return {
            Stage((entry["test"],), entry["compiled"]): (entry["cpu"], entry["wall"])
            for entry in self._read("baseline")
        }

    def add(self, kind: str, **entry: Any) -> None:
        """Appends a line."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self._lock, self.path.open("a+", encoding="utf-8") as file:
            file.seek(0)
            cut_short = not ("\n" + file.read()).endswith("\n")
            file.write("\n" * cut_short + json.dumps({"kind": kind} | entry) + "\n")

    def _read(self, kind: str) -> list[dict[str, Any]]:
        if not self.path.exists():
            return []
        # A crash may have cut a line short.
        lines = self.path.read_text("utf-8").splitlines()
        entries = [json.loads(line) for line in lines if line.endswith("}")]
        return [
            {key: value for key, value in entry.items() if key != "kind"}
            for entry in entries
            if entry["kind"] == kind
        ]


class Campaign:
    """Tries mutants, and writes what came out to a session.

    Args:
        areas: of the repository.
        session: is read and written.
        say: is told each outcome.
    """

    def __init__(
        self, areas: Areas, session: Session, say: Callable[[str], object] = print
    ) -> None:
        self.areas, self.session, self.say = areas, session, say
        self._baseline: dict[Stage, tuple[float, float] | None] = dict(session.baselines())
        self._stopped = threading.Event()

    def run(self, mutants: list[Mutant], jobs: int) -> None:
        """Tries them all.

        Raises:
            KeyboardInterrupt: on Ctrl-C, once all that was started has ended and the copies are
                gone; what was found until then is in the session.
        """
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
                        copy.end()

    def _one(self, mutant: Mutant, free: SimpleQueue[Copy]) -> None:
        copy = free.get()
        try:
            found = self._try(mutant, copy)
        finally:
            free.put(copy)
        self.session.add("outcome", **dataclasses.asdict(found))
        self.say(
            f"{found.outcome:8} {found.seconds:5.0f} s  {mutant.path}:{mutant.line}  "
            f"{mutant.operator}  {found.killer}"
        )

    def _try(self, mutant: Mutant, copy: Copy) -> Outcome:
        total = 0.0
        for stage in self.areas.stages(mutant.area, mutant.path):
            for part, cpu, wall in self._quickest_first(stage, copy):
                with copy.mutated(mutant):
                    run = copy.run(part, SLACK + 4 * cpu, 5 * SLACK + 10 * wall)
                self._go_on()
                total += run.cpu
                if run.outcome != SURVIVED:
                    return Outcome(mutant, run.outcome, run.failed, total)
        return Outcome(mutant, SURVIVED, "", total)

    def _quickest_first(self, stage: Stage, copy: Copy) -> Iterator[tuple[Stage, float, float]]:
        """The stage's tests that pass without a mutant, as many as take seconds in one process,
        with the processor time and the waiting that they take."""
        sound = {
            test: limits for test in stage.tests if (limits := self._limits(test, stage, copy))
        }
        left = sorted(sound, key=lambda test: sound[test])
        while left:
            sums = list(itertools.accumulate(sound[test][0] for test in left))
            count = max(1, sum(cpu <= TOGETHER for cpu in sums))
            part, left = left[:count], left[count:]
            cpu, wall = map(sum, zip(*(sound[test] for test in part), strict=True))
            yield Stage(tuple(part), stage.compiled), cpu, wall

    def _limits(self, test: str, stage: Stage, copy: Copy) -> tuple[float, float] | None:
        """Seconds of processor time and of waiting that a test of the stage takes without a
        mutant; None where it fails even so."""
        alone = Stage((test,), stage.compiled)
        if alone not in self._baseline:
            run = copy.run(alone)
            self._go_on()
            if run.outcome == SURVIVED:
                self._baseline[alone] = run.cpu, run.wall
                entry = {"cpu": run.cpu, "wall": run.wall}
                self.session.add("baseline", test=test, compiled=stage.compiled, **entry)
            else:
                self._baseline[alone] = None
                self.say(f"left out, fails without a mutant: {run.failed or test}")
        return self._baseline[alone]

    def _go_on(self) -> None:
        if self._stopped.is_set():
            raise Interrupted
