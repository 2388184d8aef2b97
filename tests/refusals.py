"""Errors that a user can correct."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from xplain.errors import InputError, XplainError


@contextmanager
def refused(said: str, key: str = "", kind: type[XplainError] = InputError) -> Iterator[None]:
    """Expects an error of one line with this regular expression, about a key with this
    beginning."""
    with pytest.raises(kind, match=said) as caught:
        yield
    assert "\n" not in str(caught.value)
    assert getattr(caught.value, "key", "").startswith(key)


def line_of(ended: tuple[int, str, str]) -> str:
    """Expects that a command (exit code, standard output, standard error) was refused with one
    line; returns the line."""
    code, out, error = ended
    assert (code, out, error.count("\n")) == (2, "", 1), error
    return error
