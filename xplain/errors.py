"""Errors that a person can act on: one line with the key, the value, and what is allowed."""

from __future__ import annotations


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
        if len(shown) > 80:
            shown = shown[:77] + "..."
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
