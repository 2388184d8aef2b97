"""How long work tells that it goes on; the terminal's side is :mod:`xplain.report.stages`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar

T = TypeVar("T")


class Progress:
    """Hears what is done and how far it is, and tells nobody; subclasses do. None of it changes a
    result."""

    def track(self, items: Iterable[T], what: str, count: int) -> Iterator[T]:
        """Yields the items: ``what`` is done to each of ``count``."""
        with self.stage(what, count):
            for done, item in enumerate(items, start=1):
                yield item
                self.note(f"{done} of {count}", done)

    def stage(self, what: str, count: int | None = None) -> AbstractContextManager[Any]:
        """For the time of the context, ``what`` is done, to so many items where that is known."""
        return nullcontext()

    def note(self, text: str, done: int | None = None) -> None:
        """What there is to say of the innermost stage by now, and how many items are done."""


SILENT = Progress()


def is_terminal(stream: object) -> bool:
    """Whether a stream is a terminal: not one that is closed, or that a program put in place."""
    asked = getattr(stream, "isatty", None)
    return asked is not None and bool(asked())
