"""Shows the current work of a run on standard error: progress lines on a terminal, a few log lines
elsewhere.

Users see within seconds that work continues. A terminal shows the open stages with their seconds
and, if known, their progress. Elsewhere a stage has a line after ten seconds, and another every ten
seconds if there is progress.
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
"""Seconds before the first and between further lines of a stage without a terminal."""


def stages() -> Stages:
    """Returns the display that suits the current standard error."""
    return TerminalStages() if is_terminal(sys.stderr) else Stages()


class Stages(Progress):
    """Shows the stages of a run as log lines. A stage has a line only if it takes long, so a run
    that fails early prints only its error."""

    def __init__(self) -> None:
        self._open: list[str] = []
        self._said = 0.0

    @contextmanager
    def stage(self, what: str, count: int | None = None) -> Iterator[None]:
        """Opens a stage with this name. Logs the name after ten seconds, unless the stage has
        ended or is within another stage."""
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
        """Logs a text about the stage that was opened last, at most every ten seconds."""
        if self._open and text and time.monotonic() - self._said > EVERY:
            self._said = time.monotonic()
            log.info("%s: %s", self._open[-1], text)

    def compiling(self, kernel: str) -> None:
        """Logs that a kernel is compiled; "" logs nothing."""
        self.note(kernel and f"compiling {kernel} (once; later runs load it)")


class TerminalStages(Stages):
    """Shows the stages of a run as progress lines, each from the beginning to the end of its
    stage."""

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
        """Shows a progress line while the stage is open."""
        with nullcontext() if self._tasks else self._show_lines():
            self._tasks.append(self._bars.add_task(what, total=count, note="", kernel=""))
            try:
                yield
            finally:
                self._bars.remove_task(self._tasks.pop())

    def note(self, text: str, done: int | None = None) -> None:
        """Shows a text and the number of finished items in the progress line of the stage that
        was opened last."""
        if self._tasks:
            self._bars.update(self._tasks[-1], completed=done, note=text)

    def compiling(self, kernel: str) -> None:
        """Shows that a kernel is compiled; "" removes this text."""
        if self._tasks:
            text = kernel and f" compiling {kernel} (once)"
            self._bars.update(self._tasks[-1], kernel=text)

    @contextmanager
    def _show_lines(self) -> Iterator[None]:
        """Starts the progress lines; log lines appear above them."""
        logged = logging.getLogger().handlers
        own = [h for h in logged if isinstance(h, logging.StreamHandler) and h.stream is sys.stderr]
        with self._bars:  # rich replaces sys.stderr from here on
            streams = [(handler, handler.setStream(sys.stderr)) for handler in own]
            try:
                yield
            finally:
                for handler, stream in streams:
                    handler.setStream(stream)
