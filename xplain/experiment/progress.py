"""How long work tells that it goes on; the terminal's side is :mod:`xplain.report.stages`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol, TypeVar

T = TypeVar("T")


class Progress(Protocol):
    """Whoever wants to know what is done and how far it is. None of it changes a result."""

    def track(self, items: Iterable[T], what: str, count: int) -> Iterator[T]:
        """Yields the items: ``what`` is done to each of ``count``."""
        ...

    def stage(self, what: str) -> AbstractContextManager[None]:
        """For the time of the context, ``what`` is done; how far it is, nobody knows."""
        ...

    def note(self, text: str) -> None:
        """What there is to say of the innermost stage by now."""
        ...


class NoProgress:
    """Tells nobody."""

    def track(self, items: Iterable[T], what: str, count: int) -> Iterator[T]:
        """The items."""
        return iter(items)

    def stage(self, what: str) -> AbstractContextManager[None]:
        """Nothing."""
        return nullcontext()

    def note(self, text: str) -> None:
        """Nothing."""


SILENT: Progress = NoProgress()
