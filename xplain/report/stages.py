"""Shows the current work of a run on standard error: a progress line on a terminal, a few log lines
elsewhere.

Users see within seconds that work continues. A terminal shows the open stages with their progress
and the seconds since the start. Elsewhere a stage has a line after ten seconds, and another every
ten seconds if there is progress.
"""

import logging
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from typing import Any

from xplain.experiment.progress import Progress, is_terminal

log = logging.getLogger("xplain")

EVERY = 10.0
"""Seconds before the first and between further lines of a stage without a terminal."""


class Stages(Progress):
    """Shows the stages of a run. Without a terminal, a stage has a line only if it takes long, so a
    run that fails early prints only its error."""

    def __init__(self) -> None:
        self._open: list[str] = []
        self._said = 0.0
        self._line: Any = None
        if is_terminal(sys.stderr):
            from rich import progress
            from rich.console import Console

            self._line = progress.Progress(
                progress.SpinnerColumn("line"),
                progress.TextColumn("{task.description}", markup=False),
                progress.TimeElapsedColumn(),
                console=Console(stderr=True, highlight=False),
                transient=True,
            )
            self._task = self._line.add_task("")

    @contextmanager
    def stage(self, what: str) -> Iterator[None]:
        """Opens a stage with this name."""
        with nullcontext() if self._open else self._show(what):
            self._open.append(what)
            self.note("")
            try:
                yield
            finally:
                self._open.pop()
                self.note("")

    def note(self, text: str) -> None:
        """Shows a text about the stage that was opened last: in the terminal's line, which also has
        the names of all open stages, or in a log line, at most every ten seconds."""
        if self._line is not None:
            words = ": ".join(filter(None, [*self._open, text]))
            self._line.update(self._task, description=words)
        elif text and self._open and time.monotonic() - self._said > EVERY:
            self._said = time.monotonic()
            log.info("%s: %s", self._open[-1], text)

    @contextmanager
    def _show(self, what: str) -> Iterator[None]:
        """Shows the terminal's line, with log lines above it. Elsewhere logs the name of the stage
        after ten seconds, unless the stage has ended."""
        self._said = time.monotonic()
        with ExitStack() as stack:
            if self._line is None:
                timer = threading.Timer(EVERY, log.info, ("%s …", what))
                timer.daemon = True
                timer.start()
                stack.callback(timer.cancel)
            else:
                handlers = [
                    handler
                    for handler in logging.getLogger().handlers
                    if isinstance(handler, logging.StreamHandler) and handler.stream is sys.stderr
                ]
                stack.enter_context(self._line)  # rich replaces sys.stderr from here on
                for handler in handlers:
                    stack.callback(handler.setStream, handler.setStream(sys.stderr))
            yield
