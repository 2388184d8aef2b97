"""Checks of what a page sent, of the kinds that any protocol has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from xplain.errors import Refused
from xplain.participants.protocol.plan import Asked, Texts


def choice(value: object, count: int, otherwise: str) -> int:
    """An integer 0 … count − 1 (true booleans count as what they are).

    Raises:
        Refused: anything else, with the words ``otherwise``.
    """
    if not isinstance(value, int) or not 0 <= value < count:
        raise Refused(otherwise)
    return int(value)


def choices(values: object, counts: Sequence[int], otherwise: str) -> tuple[int, ...]:
    """One choice a place, each from 0 … its count − 1.

    Raises:
        Refused: as :func:`choice`, or another number of them.
    """
    if not isinstance(values, list) or len(values) != len(counts):
        raise Refused(otherwise)
    pairs = zip(values, counts, strict=True)
    return tuple(choice(value, count, otherwise) for value, count in pairs)


def consents(texts: Texts, payload: Mapping[str, Any]) -> bool:
    """Whether somebody agrees, to the text as it is now.

    Raises:
        Refused: they do not say, or read another text.
    """
    agreed = choice(payload.get("agree"), 2, texts.words["consent_missing"])
    if payload.get("text") != texts.consent_hash:
        raise Refused(texts.words["consent_changed"])
    return bool(agreed)


def check(questions: Sequence[Asked], payload: Mapping[str, Any], words: Mapping[str, str]) -> None:
    """The lab's own questions.

    Raises:
        Refused: an answer that its question does not allow.
    """
    for asked in questions:
        value, label = payload.get(asked.name, ""), asked.label
        if not isinstance(value, str) or len(value) > asked.max_length:
            raise Refused(words["too_long"].format(label=label, most=asked.max_length))
        if asked.needed and not value:
            raise Refused(words["answer_this"].format(label=label))
        if value and asked.options and value not in asked.options:
            raise Refused(words["choose_one"].format(label=label))
        if value and asked.kind == "number":
            whole = value.isascii() and value.isdigit() and len(value) < 10
            if not whole or not asked.low <= int(value) <= asked.high:
                text = words["whole_number"]
                raise Refused(text.format(label=label, low=asked.low, high=asked.high))
    if payload.keys() - {asked.name for asked in questions}:
        raise Refused(words["not_understood"])
