"""Errors that a person can act on: one line with the key, the value, and what is allowed.

The checks below raise them.
"""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class XplainError(ValueError):
    """Base of every error that the user can mend; its text is one line."""


class InputError(XplainError):
    """A value given by the user is not allowed.

    Args:
        key: what the user set, as they wrote it (``lambda``, ``domain.map``, ``data``).
        value: what they gave.
        allowed: what would be accepted.
    """

    def __init__(self, key: str, value: object, allowed: str) -> None:
        shown = repr(value)
        if len(shown) > 80:  # both ends: a path ends with what tells it from others
            shown = f"{shown[:38]}...{shown[-39:]}"
        super().__init__(f"{key}={shown}: {allowed}")
        self.key = key
        self.value = value
        self.allowed = allowed

    def __reduce__(self) -> tuple[type, tuple[str, object, str]]:
        # Exceptions cross process borders in sweeps; the default would replay only the text.
        return type(self), (self.key, self.value, self.allowed)


class DomainError(XplainError):
    """A domain makes labels meaningless: ambiguous ties, no way to the goal."""


class TooLargeError(XplainError):
    """A problem needs more memory than allowed; the text says how much, and what can be done."""


class Refused(Exception):
    """An answer of a participant that is not accepted; the text is for them."""


@contextmanager
def left_at_once() -> Iterator[None]:
    """While modules are imported, Ctrl-C ends the process with one line: an exception in the middle
    of an import becomes another one, or a traceback."""

    def leave(*_: object) -> None:
        print("xplain: interrupted", file=sys.stderr, flush=True)
        os._exit(130)

    before = signal.getsignal(signal.SIGINT)
    ours = threading.current_thread() is threading.main_thread()
    if not ours or before is not signal.default_int_handler:  # someone else hears it
        yield
        return
    signal.signal(signal.SIGINT, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def number(key: str, value: object) -> float:
    """A finite number.

    Raises:
        InputError: it is none.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InputError(key, value, "a finite number")
    return float(value)


def whole_number(key: str, value: object, least: int) -> int:
    """A whole number, ``least`` or more.

    Raises:
        InputError: it is none.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise InputError(key, value, f"a whole number ≥ {least}")
    return value


def discount_factor(key: str, value: object) -> float:
    """A discount in (0, 1).

    Raises:
        InputError: it is none.
    """
    if not 0 < (gamma := number(key, value)) < 1:
        raise InputError(key, value, "a number in (0, 1), both ends excluded")
    return gamma
