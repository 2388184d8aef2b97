"""Progress over a whole sweep, whatever launcher runs it: the jobs' folders tell it."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Protocol

from xplain.runs.folder import State, SweepFolder
from xplain.runs.plan import Job

log = logging.getLogger(__name__)


class Listener(Protocol):
    """Whoever wants to know how far the jobs are; called from one thread."""

    def start(self) -> None:
        """Called once, before the first look at the jobs' folders."""
        ...

    def update(self, job: Job, state: State) -> None:
        """Called when a job has come into another state."""
        ...


POLL = 0.5
"""Seconds between looks, at least."""
SLOWEST = 3.0
"""Seconds between looks, at most."""
SAY = 15.0
"""Seconds between lines where there is no terminal."""


class Watch:
    """A thread that looks at the jobs' folders until it is told to stop.

    Args:
        folder: of the sweep.
        jobs: those to watch; ``done`` others are finished already.
        listener: hears of every change of a job's state, in the thread of the watch.
        done: how many jobs of the sweep need no watching.
    """

    def __init__(
        self, folder: SweepFolder, jobs: Sequence[Job], listener: Listener, done: int
    ) -> None:
        self._folder, self._jobs, self._listener = folder, jobs, listener
        self._before = done
        self._states: dict[str, State] = {job.fingerprint: "waiting" for job in jobs}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._started = self._said = time.monotonic()
        self._show: Callable[[], None] = self._line

    def __enter__(self) -> Watch:
        if sys.stderr.isatty():
            self._bar()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._look()
        self._close()

    def counts(self) -> Counter[State]:
        """How many of the watched jobs are in each state."""
        return Counter(self._states.values())

    def _watch(self) -> None:
        self._listener.start()  # takes seconds, while the jobs run already
        pause = POLL
        while not self._stop.wait(pause):
            before = time.thread_time()
            self._look()
            # A hundredth of a core is enough: a look at a thousand jobs takes long.
            pause = min(max(POLL, 100 * (time.thread_time() - before)), SLOWEST)

    def _look(self) -> None:
        for job in self._jobs:
            old = self._states[job.fingerprint]
            if old == "finished":
                continue
            new = self._folder.state(job)
            if new != old:
                self._states[job.fingerprint] = new
                self._listener.update(job, new)
                if new == "failed":
                    log.info("failed: %s: %s", job.label, self._folder.failure(job)["error"])
        self._show()

    def _line(self) -> None:
        now = time.monotonic()
        if now - self._said < SAY:
            return
        self._said = now
        log.info(self._words())

    def _words(self) -> str:
        counts = self.counts()
        ended = counts["finished"] + counts["failed"]
        total = self._before + len(self._jobs)
        text = f"{self._before + ended} of {total} jobs done, {counts['failed']} failed"
        if ended and ended < len(self._jobs):
            elapsed = time.monotonic() - self._started
            left = elapsed / ended * (len(self._jobs) - ended)
            text += f", about {duration(left)} left"
        return text

    def _bar(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        progress = Progress(
            TextColumn("{task.description}"), BarColumn(), console=Console(stderr=True)
        )
        task = progress.add_task("", total=self._before + len(self._jobs))
        progress.start()

        def show() -> None:
            counts = self.counts()
            ended = counts["finished"] + counts["failed"]
            progress.update(task, completed=self._before + ended, description=self._words())

        self._show, self._close = show, progress.stop  # type: ignore[method-assign]

    def _close(self) -> None:
        """Replaced where there is a bar."""


def duration(seconds: float) -> str:
    """``2 h 05 min``, ``3 min 20 s`` or ``12 s``."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    if whole >= 60:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole} s"
