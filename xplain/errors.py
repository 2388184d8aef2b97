"""Errors that a user can correct, and the checks that raise them. The text of an error is one line
with the key, the value, and the allowed values."""

import math
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, wraps
from inspect import signature
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")


class XplainError(ValueError):
    """Base of every error that the user can correct; its text is one line."""


class InputError(XplainError):
    """A value given by the user is not allowed.

    Args:
        key: the user's key, as written (``lambda``, ``domain.map``, ``data``).
        value: the given value.
        allowed: description of the accepted values.
    """

    def __init__(self, key: str, value: object, allowed: str) -> None:
        shown = repr(value)
        if len(shown) > 80:  # keeps both ends, because the end of a path identifies it
            shown = f"{shown[:38]}...{shown[-39:]}"
        super().__init__(f"{key}={shown}: {allowed}")
        self.key = key
        self.value = value
        self.allowed = allowed

    def __reduce__(self) -> tuple[type, tuple[str, object, str]]:
        # Sweeps pickle exceptions, and the default pickles only the text.
        return type(self), (self.key, self.value, self.allowed)


class DomainError(XplainError):
    """The labels of a domain have no meaning: ties are ambiguous, or the goal is not reachable."""


class TooLargeError(XplainError):
    """A problem needs more memory than allowed. The text says how much, and what to do."""


class Refused(Exception):
    """A participant's answer is not accepted. The participant reads the text of this error."""


def escape(node: Any) -> Any:
    """Returns plain data whose texts OmegaConf reads as they are: it would read ``${…}``, for
    example in the name of a folder, as the name of another key."""
    match node:
        case str():
            return re.sub(r"(\\*)\$\{", r"\1\1\\${", node)
        case dict():
            return {key: escape(value) for key, value in node.items()}
        case list():
            return [escape(value) for value in node]
    return node


def quote(text: str, mark: str = "'") -> str:
    """Quotes any text for Hydra's overrides: backslashes are doubled only before a quotation
    mark."""
    ends = rf"(\\*)({mark}|$)"
    escaped = re.sub(ends, lambda found: found[1] * 2 + (f"\\{mark}" if found[2] else ""), text)
    return f"{mark}{escaped}{mark}"


def first_line(error: BaseException) -> str:
    """Returns the first line of an error's text; the name of its class if the text is empty."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


@contextmanager
def leave_at_once() -> Iterator[None]:
    """Makes Ctrl-C during imports end the process with one line. Otherwise a library may replace
    the interruption by another error, or Python prints a traceback."""

    def leave(*_: object) -> None:
        print("xplain: interrupted", file=sys.stderr, flush=True)
        os._exit(130)

    before = signal.getsignal(signal.SIGINT)
    ours = threading.current_thread() is threading.main_thread()
    if not ours or before is not signal.default_int_handler:  # another handler receives Ctrl-C
        yield
        return
    signal.signal(signal.SIGINT, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@dataclass(frozen=True)
class Range:
    """The finite numbers that a parameter may have.

    Attributes:
        low, high: ends of the range, possibly infinite.
        ends: brackets as in [low, high); a round bracket excludes its end.
    """

    low: float = -math.inf
    high: float = math.inf
    ends: Literal["[]", "[)", "(]", "()"] = "[]"

    def check(self, key: str, value: object, whole: bool = False) -> None:
        """Checks that a value is a number, or a whole number, in the range.

        Raises:
            InputError: the check fails.
        """
        fits = isinstance(value, int if whole else (int, float)) and not isinstance(value, bool)
        if not fits or not math.isfinite(value) or not self._contains(value):  # type: ignore[arg-type]
            raise InputError(key, value, self.describe(whole))

    def _contains(self, value: float) -> bool:
        above = value > self.low or (value == self.low and self.ends[0] == "[")
        return above and (value < self.high or (value == self.high and self.ends[1] == "]"))

    def describe(self, whole: bool = False) -> str:
        """Describes the range in words."""
        if self == Range():
            return "a finite number"
        kind = "a whole number" if whole else "a number"
        if self.high == math.inf:
            return f"{kind} {'≥' if self.ends[0] == '[' else '>'} {self.low:g}"
        if whole:
            return f"{kind} in {self.low} … {self.high}"
        return f"{kind} in {self.ends[0]}{self.low:g}, {self.high:.3g}{self.ends[1]}"


Count = Annotated[int, Range(1)]
Whole = Annotated[int, Range(0)]
Positive = Annotated[float, Range(0, ends="(]")]
Probability = Annotated[float, Range(0, 1)]
Slip = Annotated[float, Range(0, 1, "[)")]
Discount = Annotated[float, Range(0, 1, "()")]


def checks(prefix: str = "") -> Callable[[type[T]], type[T]]:
    """Decorates a class. The constructor then checks each argument against its annotation before
    its body runs.

    ``Annotated[int, Range(1)]`` allows whole numbers ≥ 1, ``Annotated[float, Range(0, 1)]`` numbers
    in [0, 1], ``Literal["a", "b"]`` one of two words; ``| None`` also allows None. Other
    annotations are not checked, but their names must exist at run time. The error's key is
    ``prefix.parameter``, or ``parameter`` without a prefix. Put this decorator above
    ``@dataclass``; fields of base classes are then checked too. A subclass with its own constructor
    needs the decorator again.
    """

    def decorate(kind: type[T]) -> type[T]:
        made = kind.__init__
        takes = signature(made)
        # The annotations of a dataclass are read with the names of each base class's module.
        annotated: Any = kind if "__dataclass_params__" in vars(kind) else made

        @wraps(made)
        def init(self: T, *values: object, **named: object) -> None:
            given = takes.bind(self, *values, **named).arguments
            for name, hint in _read_hints(annotated).items():
                if name in given:
                    check(f"{prefix}.{name}".lstrip("."), given[name], hint)
            made(self, *values, **named)

        kind.__init__ = init  # type: ignore[method-assign, assignment]
        return kind

    return decorate


@cache
def _read_hints(of: Any) -> dict[str, Any]:
    return get_type_hints(of, include_extras=True)


def check(key: str, value: object, hint: Any) -> None:
    """Checks a value against its annotation (:func:`checks`).

    Raises:
        InputError: the annotation does not allow it.
    """
    inner = get_args(hint)
    if get_origin(hint) in (Union, UnionType):
        if value is not None or NoneType not in inner:
            for one in inner:
                check(key, value, one)
    elif get_origin(hint) is Literal:
        one_of(key, value, inner)
    elif get_origin(hint) is Annotated and isinstance(inner[1], Range):
        inner[1].check(key, value, whole=inner[0] is int)


def one_of(key: str, value: T, allowed: Iterable[T], what: str = "") -> T:
    """Checks that a value is allowed, and returns it. ``what`` is a noun for such a value in the
    error, as in "unknown predicate".

    Raises:
        InputError: the check fails.
    """
    known = [*allowed]
    if value not in known:
        words = ", ".join(map(str, known)) or "none"
        raise InputError(
            key, value, f"unknown {what}; known: {words}" if what else f"one of {words}"
        )
    return value


def mapping(key: str, value: object, allowed: str) -> Mapping[str, Any]:
    """Checks that a value is a mapping.

    Raises:
        InputError: the check fails.
    """
    if not isinstance(value, Mapping):
        raise InputError(key, value, allowed)
    return value


def require_list(key: str, value: object, allowed: str = "a list") -> Sequence[Any]:
    """Checks that a value is a list and not a text.

    Raises:
        InputError: the check fails.
    """
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise InputError(key, value, allowed)
    return value


def sentence(key: str, value: object, allowed: str = "a sentence") -> str:
    """Checks that a value is a text that is not blank.

    Raises:
        InputError: the check fails.
    """
    if not isinstance(value, str) or not value.strip():
        raise InputError(key, value, allowed)
    return value


def number(key: str, value: object, within: Range = Range()) -> float:
    """Checks that a value is a finite number in a range.

    Raises:
        InputError: the check fails.
    """
    within.check(key, value)
    return float(value)  # type: ignore[arg-type]


def whole_number(key: str, value: object, least: int, most: float = math.inf) -> int:
    """Checks that a value is a whole number from ``least`` to ``most``.

    Raises:
        InputError: the check fails.
    """
    Range(least, most).check(key, value, whole=True)
    return value  # type: ignore[return-value]
