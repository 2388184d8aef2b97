"""From the configuration, and a domain's own phrases, to what a plan stores and people read."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf

from xplain.domains.base import Domain, Parameter, Scene, cell_name
from xplain.errors import InputError, one_of
from xplain.experiment.config import CONF
from xplain.people.plan import Ahead, Task, Texts, Told, Way, facts_of

InWords = Callable[[str], str]
NOT_OF_THE_PLAN = ("consent", "database", "host", "port", "threads", "server", "outputs")
"""Keys that may change between two starts."""


def texts_of(kind: str, wording: Mapping[str, Any], in_words: InWords = str) -> Texts:
    """What the pages say.

    Args:
        kind: study or collect, whose shipped texts name everything that can be said.
        wording: of the configuration.
        in_words: turns a domain's phrases into what people read.

    Raises:
        InputError: the words of a page are missing.
    """
    shared, own = (
        yaml.safe_load((CONF / file).read_text(encoding="utf-8"))
        for file in ("words/en.yaml", f"{kind}/texts/en.yaml")
    )
    words, known = wording["words"], {**shared, **own["words"]}
    for key in known:
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


def worded(
    told: Sequence[Parameter], facts: Mapping[str, Mapping[str, str]], in_words: InWords
) -> tuple[Parameter, ...]:
    """Parameters with the lab's own sentences.

    Raises:
        InputError: sentences for something that there is not.
    """
    names = [one.name for one in told]
    for name in facts:
        one_of(f"wording.facts.{name}", name, names)
    own = [replace(one, **facts.get(one.name, {})) for one in told]
    return tuple(
        replace(one, message=in_words(one.message), belief=in_words(one.belief)) for one in own
    )


def named(scene: Scene, in_words: InWords) -> Scene:
    """The map with its items' names in words, without items that show the value of a parameter:
    a participant may believe another value."""
    kept = [replace(item, name=in_words(item.name)) for item in scene.items if not item.shows]
    return replace(scene, items=tuple(kept))


def fixed(cfg: DictConfig) -> dict[str, Any]:
    """The resolved keys that make the plan."""
    plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    return {key: value for key, value in plain.items() if key not in NOT_OF_THE_PLAN}


def each(sentences: Iterable[Iterable[str]], in_words: InWords) -> Told:
    """Sentences of several transitions or states, in words."""
    return tuple(tuple(map(in_words, of_one)) for of_one in sentences)


def of_states(domain: Domain, method: str, states: Iterable[int]) -> Told:
    """What a domain's optional method says of states; none where it has no such method."""
    told = getattr(domain, method, None)
    return () if told is None else tuple(tuple(told(int(state))) for state in states)


def way_of(domain: Domain, moves: Iterable[Sequence[int]]) -> Way | None:
    """Of each move from a state to another the cells; None where there is no map of them."""
    cells = [(domain.position(before), domain.position(after)) for before, after in moves]
    way = tuple((a, b) for a, b in cells if a is not None and b is not None)
    return way if domain.scene and len(way) == len(cells) else None


def ahead_of(step: Mapping[str, Any], scene: Scene | None, in_words: InWords) -> Ahead:
    """The practice step whose reason comes later, as a lab's texts have it.

    Raises:
        InputError: it is not on this map.
    """
    way = tuple(((a, b), (c, d)) for (a, b), (c, d) in step["way"])
    walls = set(scene.walls) if scene else set()
    for row, column in (cell for move in way for cell in move):
        if (
            scene is None
            or (row, column) in walls
            or not (0 <= row < scene.rows and 0 <= column < scene.columns)
        ):
            wanted = "a cell of this map where the robot can be; wording.ahead=null for none"
            raise InputError("wording.ahead.way", [row, column], wanted)
    return Ahead(tuple(map(in_words, step["steps"])), way)


def parts(
    kind: str, config: Mapping[str, Any], wording: Mapping[str, Any], task: Task, does: str
) -> tuple[dict[str, Any], InWords]:
    """Fields of any plan, and what turns a domain's phrases into words.

    Args:
        kind: study or collect: whose texts name every word that is needed.
        config: of the plan.
        wording: its texts.
        task: what is shown.
        does: a sentence about the robot, with a place for the ``phrase``.

    Raises:
        InputError: a text is missing, or of something that there is not.
    """
    scene = task.scene
    in_words = phrases_of(wording["phrases"], scene is not None)
    return {
        "seed": config["seed"],
        "config": config,
        "domain": task.name,
        "facts": facts_of(worded(task.facts, wording["facts"], in_words)),
        "texts": texts_of(kind, wording, in_words),
        "changes": each(task.changes, in_words),
        "pictures": task.pictures,
        "ahead": wording["ahead"]
        and ahead_of(wording["ahead"], scene, lambda phrase: does.format(phrase=in_words(phrase))),
        "scene": scene and named(scene, in_words),
        "icons": {in_words(name): path for name, path in wording["icons"].items()},
    }, in_words
