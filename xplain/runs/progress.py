"""Progress over a whole sweep, whatever launcher runs it: the jobs' folders tell it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from xplain.report.stages import stages
from xplain.runs.folder import SweepFolder
from xplain.runs.plan import Job

log = logging.getLogger(__name__)

POLL = 1.0
"""Seconds between looks."""


@contextmanager
def watched(folder: SweepFolder, jobs: Sequence[Job], done: int) -> Iterator[None]:
    """A thread looks at the jobs' folders for the time of the context, and once more at its end.

    Args:
        folder: of the sweep.
        jobs: those to watch.
        done: how many other jobs of the sweep are finished already.
    """
    waiting, failed, every = list(jobs), 0, done + len(jobs)
    progress, started, stop = stages(), time.monotonic(), threading.Event()

    def look() -> None:
        nonlocal waiting, failed
        states = [(job, folder.state(job)) for job in waiting]
        over = [job for job, state in states if state in ("finished", "failed")]
        waiting = [job for job in waiting if job not in over]
        for job, state in states:
            if state == "failed":
                failed += 1
                log.info("failed: %s: %s", job.label, folder.failure(job)["error"])
        count = len(jobs) - len(waiting)
        words = f"{done + count} of {every} jobs done, {failed} failed"
        if count and waiting:
            left = (time.monotonic() - started) / count * len(waiting)
            words += f", about {duration(left)} left"
        progress.note(words)

    def watch() -> None:
        while not stop.wait(POLL):
            look()

    thread = threading.Thread(target=watch, daemon=True)
    with progress.stage("sweep"):
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()
            look()


def duration(seconds: float) -> str:
    """``2 h 05 min``, ``3 min 20 s`` or ``12 s``."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    if whole >= 60:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole} s"
