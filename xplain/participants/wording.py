"""From the texts of the configuration, and a domain's own phrases, to what people read."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import yaml

from xplain.config import CONF
from xplain.domains.base import Parameter, Scene, cell_name
from xplain.errors import InputError
from xplain.participants.protocol.plan import Fact, Texts

InWords = Callable[[str], str]


def texts_of(wording: Mapping[str, Any], english: Path, in_words: InWords = str) -> Texts:
    """What the pages say.

    Args:
        wording: of the configuration.
        english: file of the protocol's own texts, which names every word that is needed; so does
            conf/words/en.yaml for the pages that protocols share.
        in_words: turns a domain's phrases into what people read.

    Raises:
        InputError: the words of a page are missing.
    """
    shared, own = (
        yaml.safe_load(file.read_text(encoding="utf-8"))
        for file in (CONF / "words" / "en.yaml", english)
    )
    words = wording["words"]
    for key in (*shared, *own["words"]):
        if not str(words.get(key) or "").strip():
            raise InputError(f"wording.words.{key}", words.get(key), "what the page says here")
    paragraphs = ("consent", "introduction", "task", "debriefing")
    return Texts(
        title=wording["title"],
        contact=wording["contact"],
        words=words,
        **{key: tuple(in_words(text) for text in wording[key]) for key in paragraphs},
    )


def phrases_of(phrases: Mapping[str, str], on_a_map: bool) -> InWords:
    """Turns a domain's phrases into what people read.

    Args:
        phrases: parts of phrases, and what they become; the longest that fits is taken.
        on_a_map: whether (row, column) and "row r, column c", from 0, become a letter and a number
            as on the map.
    """
    parts = sorted(phrases, key=len, reverse=True)
    pattern = re.compile("|".join(rf"(?<!\w){re.escape(part)}(?!\w)" for part in parts))

    def cell(found: re.Match[str]) -> str:
        row, column = (int(number) for number in found.groups())
        return cell_name(row, column)

    def in_words(text: str) -> str:
        if parts:
            text = pattern.sub(lambda found: phrases[found[0]], text)
        if on_a_map:
            text = re.sub(r"\((\d+), (\d+)\)", cell, text)
            text = re.sub(r"row (\d+), column (\d+)", cell, text)
        return text

    return in_words


Told = TypeVar("Told", Parameter, Fact)


def worded(
    told: Sequence[Told], facts: Mapping[str, Mapping[str, str]], in_words: InWords
) -> tuple[Told, ...]:
    """Parameters or facts with the lab's own sentences.

    Raises:
        InputError: sentences for something that there is not.
    """
    names = [one.name for one in told]
    for name in facts:
        if name not in names:
            raise InputError(f"wording.facts.{name}", name, ", ".join(names))
    own = [replace(one, **facts.get(one.name, {})) for one in told]
    return tuple(
        replace(one, message=in_words(one.message), belief=in_words(one.belief)) for one in own
    )


def named(scene: Scene, hide: Sequence[str], in_words: InWords) -> Scene:
    """The map with its items' names in words, without the items of some symbols.

    Raises:
        InputError: there is no such symbol on the map.
    """
    symbols = [item.symbol for item in scene.items]
    for symbol in hide:
        if symbol not in symbols:
            raise InputError("wording.hide", symbol, f"symbols on the map: {', '.join(symbols)}")
    kept = [replace(i, name=in_words(i.name)) for i in scene.items if i.symbol not in hide]
    return replace(scene, items=tuple(kept))
