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
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from xplain.experiment.progress import Progress, is_terminal

if TYPE_CHECKING:
    from rich.progress import TaskID

log = logging.getLogger("xplain")

EVERY = 10.0
"""Seconds before and between lines of a stage where there is no terminal."""


def stages() -> TerminalStages | Lines:
    """Those for the standard error that there is."""
    return TerminalStages() if is_terminal(sys.stderr) else Lines()


class Lines(Progress):
    """Lines in the log for what takes long: an error that comes soon is the only line then."""

    def __init__(self) -> None:
        self._open: list[str] = []
        self._said = self._compiling_since = 0.0

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
        if self._open and time.monotonic() - self._said > EVERY:
            self._said = time.monotonic()
            log.info("%s: %s", self._open[-1], text)

    def compiling(self, text: str) -> None:
        """A kernel is compiled; an empty text where it is done."""
        if text:
            self._compiling_since = self._compiling_since or time.monotonic()
            seconds = time.monotonic() - self._compiling_since
            self.note(f"compiling (once; later runs load) {text}, {seconds:.0f} s since the first")


class TerminalStages(Progress):
    """A moving line for each stage that is open, gone when it ends."""

    def __init__(self) -> None:
        from rich import progress
        from rich.console import Console

        self._bars = progress.Progress(
            progress.SpinnerColumn("line"),
            progress.TextColumn("{task.description}"),
            progress.TimeElapsedColumn(),
            progress.BarColumn(bar_width=20),
            progress.TextColumn("{task.fields[note]}"),
            console=Console(stderr=True, highlight=False),
            transient=True,
        )
        self._open: list[TaskID] = []
        self._compiling: TaskID | None = None
        self._streams: list[tuple[logging.StreamHandler[Any], Any]] = []

    @contextmanager
    def stage(self, what: str, count: int | None = None) -> Iterator[None]:
        """See :class:`xplain.experiment.progress.Progress`."""
        if not self._open:
            self._start()
        task = self._bars.add_task(what, total=count, note="")
        self._open.append(task)
        try:
            yield
        finally:
            self._open.remove(task)
            self._bars.remove_task(task)
            if not self._open:
                self._stop()

    def note(self, text: str, done: int | None = None) -> None:
        """See :class:`xplain.experiment.progress.Progress`."""
        if self._open:
            self._bars.update(self._open[-1], completed=done, note=text)

    def compiling(self, text: str) -> None:
        """A kernel is compiled; an empty text where it is done."""
        if self._compiling is not None:
            self._bars.update(self._compiling, note=text, visible=bool(text))
        elif self._open and text:
            what = "compiling (once)"
            self._compiling = self._bars.add_task(what, total=None, note=text)

    def _start(self) -> None:
        """Whoever logs meanwhile writes above the moving lines."""
        logged = logging.getLogger().handlers
        own = [h for h in logged if isinstance(h, logging.StreamHandler) and h.stream is sys.stderr]
        self._bars.start()  # from here on sys.stderr is rich's
        self._streams = [(handler, handler.setStream(sys.stderr)) for handler in own]

    def _stop(self) -> None:
        if self._compiling is not None:
            self._bars.remove_task(self._compiling)
            self._compiling = None
        self._bars.stop()
        for handler, stream in self._streams:
            handler.setStream(stream)
