"""Progress over a whole sweep, whatever launcher runs it: the jobs' folders tell it."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Sequence

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from xplain.runs.folder import SweepFolder
from xplain.runs.plan import Job

log = logging.getLogger(__name__)

POLL = 1.0
"""Seconds between looks."""
SAY = 15.0
"""Seconds between lines where there is no terminal."""


class Watch:
    """A thread that looks at the jobs' folders until it is told to stop.

    Args:
        folder: of the sweep.
        jobs: those to watch.
        ended: hears of every job that is finished or failed, in the thread of the watch.
        done: how many other jobs of the sweep are finished already.
    """

    def __init__(
        self, folder: SweepFolder, jobs: Sequence[Job], ended: Callable[[Job], None], done: int
    ) -> None:
        self._folder, self._ended, self._done = folder, ended, done
        self._waiting, self._all, self._failed = list(jobs), len(jobs), 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._started = self._said = time.monotonic()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            console=Console(stderr=True),
            disable=not sys.stderr.isatty(),
        )
        self._task = self._bar.add_task("", total=done + len(jobs))

    def __enter__(self) -> Watch:
        self._bar.start()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._look()
        self._bar.stop()

    def _watch(self) -> None:
        while not self._stop.wait(POLL):
            self._look()

    def _look(self) -> None:
        states = [(job, self._folder.state(job)) for job in self._waiting]
        ended = [job for job, state in states if state in ("finished", "failed")]
        self._waiting = [job for job in self._waiting if job not in ended]
        for job, state in states:
            if state == "failed":
                self._failed += 1
                log.info("failed: %s: %s", job.label, self._folder.failure(job)["error"])
        now, count = time.monotonic(), self._all - len(self._waiting)
        words = f"{self._done + count} of {self._done + self._all} jobs done, {self._failed} failed"
        if count and self._waiting:
            left = (now - self._started) / count * len(self._waiting)
            words += f", about {duration(left)} left"
        self._bar.update(self._task, completed=self._done + count, description=words)
        if self._bar.disable and now - self._said >= SAY:
            self._said = now
            log.info(words)
        for job in ended:  # last: it may take long
            self._ended(job)


def duration(seconds: float) -> str:
    """``2 h 05 min``, ``3 min 20 s`` or ``12 s``."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    if whole >= 60:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole} s"
