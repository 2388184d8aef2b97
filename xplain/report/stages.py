"""What a run is at, on standard error: moving lines on a terminal, a few in the log elsewhere.

Whoever waits sees within seconds that work goes on: a terminal shows the stages that are open,
with seconds that count and, where it is known, how far each is. Elsewhere a stage is one line once
it has taken ten seconds, and one more every ten seconds where there is news.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING

from xplain.experiment.progress import Progress, is_terminal

if TYPE_CHECKING:
    from rich.progress import TaskID

log = logging.getLogger("xplain")

EVERY = 10.0
"""Seconds before and between lines of a stage where there is no terminal."""


def stages() -> Stages:
    """Those for the standard error that there is."""
    return TerminalStages() if is_terminal(sys.stderr) else Stages()


class Stages(Progress):
    """Lines in the log for what takes long: an error that comes soon is the only line then."""

    def __init__(self) -> None:
        self._open: list[str] = []
        self._said = 0.0

    @contextmanager
    def stage(self, what: str, count: int | None = None) -> Iterator[None]:
        """See :class:`xplain.experiment.progress.Progress`."""
        timer = threading.Timer(EVERY, log.info, ("%s …", what))
        timer.daemon = True
        if not self._open:
            self._said = time.monotonic()
            timer.start()
        self._open.append(what)
        try:
            yield
        finally:
            self._open.pop()
            timer.cancel()

    def note(self, text: str, done: int | None = None) -> None:
        """See :class:`xplain.experiment.progress.Progress`."""
        if self._open and text and time.monotonic() - self._said > EVERY:
            self._said = time.monotonic()
            log.info("%s: %s", self._open[-1], text)

    def compiling(self, kernel: str) -> None:
        """Tells that a kernel is compiled; an empty text says that it is done."""
        self.note(kernel and f"compiling {kernel} (once; later runs load it)")


class TerminalStages(Stages):
    """A moving line for each stage that is open, gone when it ends."""

    def __init__(self) -> None:
        from rich import progress
        from rich.console import Console

        self._bars = progress.Progress(
            progress.SpinnerColumn("line"),
            progress.TextColumn("{task.description}"),
            progress.TimeElapsedColumn(),
            progress.BarColumn(bar_width=20),
            progress.TextColumn("{task.fields[note]}{task.fields[kernel]}"),
            console=Console(stderr=True, highlight=False),
            transient=True,
        )
        self._tasks: list[TaskID] = []

    @contextmanager
    def stage(self, what: str, count: int | None = None) -> Iterator[None]:
        """See :class:`xplain.experiment.progress.Progress`."""
        with nullcontext() if self._tasks else self._moving():
            self._tasks.append(self._bars.add_task(what, total=count, note="", kernel=""))
            try:
                yield
            finally:
                self._bars.remove_task(self._tasks.pop())

    def note(self, text: str, done: int | None = None) -> None:
        """See :class:`xplain.experiment.progress.Progress`."""
        if self._tasks:
            self._bars.update(self._tasks[-1], completed=done, note=text)

    def compiling(self, kernel: str) -> None:
        """See :class:`Stages`."""
        if self._tasks:
            text = kernel and f" compiling {kernel} (once)"
            self._bars.update(self._tasks[-1], kernel=text)

    @contextmanager
    def _moving(self) -> Iterator[None]:
        """Whoever logs meanwhile writes above the moving lines."""
        logged = logging.getLogger().handlers
        own = [h for h in logged if isinstance(h, logging.StreamHandler) and h.stream is sys.stderr]
        with self._bars:  # from here on sys.stderr is rich's
            streams = [(handler, handler.setStream(sys.stderr)) for handler in own]
            try:
                yield
            finally:
                for handler, stream in streams:
                    handler.setStream(stream)
