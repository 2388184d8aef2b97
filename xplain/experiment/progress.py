"""The progress of long work; its display is in :mod:`xplain.report.stages`."""

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar

T = TypeVar("T")


class Progress:
    """Receives the progress and ignores it; subclasses display it. No result depends on it."""

    def track(self, items: Iterable[T], what: str, count: int) -> Iterator[T]:
        """Yields the items, and reports the progress after each item.

        Args:
            items: the items.
            what: name of the stage, such as "certificates".
            count: number of items.
        """
        with self.stage(what):
            for done, item in enumerate(items, start=1):
                yield item
                self.note(f"{done} of {count}")

    def stage(self, what: str) -> AbstractContextManager[Any]:
        """Opens a context with ``what`` as the current activity."""
        return nullcontext()

    def note(self, text: str) -> None:
        """Reports a text about the most recent open stage."""


SILENT = Progress()


def is_terminal(stream: object) -> bool:
    """True if a stream is an open terminal."""
    asked = getattr(stream, "isatty", None)
    return asked is not None and bool(asked())
