"""Makes the content of plans and pages from the configuration and a domain's own phrases."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf
from PIL import Image, ImageOps

from xplain.domains.base import (
    Domain,
    Parameter,
    Scene,
    cell_name,
    changes_of,
    transition_feature_names,
    transition_features,
)
from xplain.domains.users.hypotheses import Hypotheses, hypotheses_of
from xplain.domains.users.setting import Setting, UserType
from xplain.domains.users.types import TypeSource
from xplain.errors import InputError, first_line, one_of, sentence
from xplain.experiment.config import CONF
from xplain.experiment.from_config import component
from xplain.experiment.pipeline import observe
from xplain.explanation.message_sets import indices, mask_of, names_of
from xplain.learning.data.label_file import read_cells
from xplain.learning.saved import LearnedTypes
from xplain.people.plan import Ahead, Clip, Example, Picture, Texts, Told, Way
from xplain.questions.own_transitions import read_transitions, with_features
from xplain.randomness import stream

KEPT = {"transparency"}
"""Metadata of a picture that is kept."""
FORMATS = ("PNG", "JPEG", "WEBP", "GIF")
MAX_IMAGE, MAX_SIDE = 2 << 20, 4096
"""Maximum bytes of one image, and maximum pixels of its longer side."""
DRAWN_ROLES = 4
"""Number of random types of simulated people, if no types are configured."""


Transitions = NDArray[np.int64]
"""Rows of a material, starting at 0."""


@dataclass(frozen=True, kw_only=True)
class Material:
    """T transitions of a task, from a domain or from a lab's own table, with the texts and pictures
    that people see, and the labels of simulated people.

    Attributes:
        name: name of the task.
        facts: [n] facts that people may believe incorrectly, with their sentences.
        types: M types of simulated people.
        clips: [T] the transitions as pages show them, before a lab's words replace the texts.
        features: [T, F] features of the transitions.
        feature_names: F names.
        scene: the map, or None.
        hypotheses: sets of facts that people may believe incorrectly, for the T transitions.
        whole: hypotheses for all transitions of a domain; None if there are no other transitions.
        setting: the domain with its models, if traces are drawn from the domain. Its reachable
            transitions are then the T transitions.
    """

    name: str
    facts: tuple[Parameter, ...]
    types: tuple[UserType, ...]
    clips: tuple[Clip, ...]
    features: NDArray[np.float64]
    feature_names: tuple[str, ...]
    scene: Scene | None = None
    hypotheses: Hypotheses | None = None
    whole: Hypotheses | None = None
    setting: Setting | None = None

    @classmethod
    def of(cls, setting: Setting) -> Material:
        """Makes the material of every transition that the robot of a domain can make."""
        domain, every = setting.domain, setting.reachable
        return cls(
            name=domain.name,
            facts=domain.parameters,
            types=setting.types,
            clips=clips_of(domain, [domain.describe(one) for one in every], every),
            features=transition_features(domain, every),
            feature_names=tuple(transition_feature_names(domain)),
            scene=domain.scene,
            setting=setting,
        )

    @classmethod
    def of_domain(cls, domain: Domain, users: TypeSource, seed: int) -> Material:
        """Makes the material of a domain's transitions, without transitions that questions cannot
        distinguish by their features (``Hypotheses.drop_indistinguishable``)."""
        whole = hypotheses_of(domain, None)
        known = whole.drop_indistinguishable()
        assert known.states is not None, "hypotheses of a domain know states"
        assert known.features is not None, "and features"
        # Phrases of domains without a map name the action first.
        named = [
            next((a for a, name in enumerate(domain.actions) if phrase.startswith(name)), 0)
            for phrase in known.phrases
        ]
        transitions = np.insert(known.states, 1, named, axis=1)
        return cls(
            name=domain.name,
            facts=domain.parameters,
            types=users.types(domain, stream(seed, "users")),
            clips=clips_of(domain, known.phrases, transitions),
            features=known.features,
            feature_names=known.feature_names,
            scene=domain.scene,
            hypotheses=known,
            whole=whole,
        )

    def labels(self, rows: Transitions) -> NDArray[np.uint8]:
        """Returns [M, m, 2^n], the true labels of the transitions with the indices ``rows`` [m], by
        type and message set."""
        if self.setting:
            return self.setting.label_table(self.setting.reachable[rows])
        known = self.hypotheses
        assert known is not None, "a table comes with hypotheses"
        held = [mask_of(one.inaccurate, known.messages) for one in self.types]
        told = np.arange(1 << len(known.messages))
        return np.stack([known.labels[known.row(one & ~told)][:, rows].T for one in held])

    def rows_of(self, steps: NDArray[np.int64]) -> Transitions:
        """Finds the index of each of the given transitions [m, 3] of a domain."""
        assert self.setting, "transitions of a domain"
        row_of = {tuple(one): row for row, one in enumerate(self.setting.reachable.tolist())}
        return np.array([row_of[tuple(step)] for step in steps.tolist()], np.int64)

    def list_taken(self, trace: Transitions) -> Told:
        """Returns m + 1 lists: the names of the items that are no longer on the map after 0 … m
        steps of a trace. Returns an empty tuple without a domain, or if the domain does not name
        such items."""
        if self.setting is None:
            return ()
        steps = self.setting.reachable[trace]
        states = [*steps[:, 0].tolist(), int(steps[-1, 2])]
        return of_states(self.setting.domain, "gone", states)


def clips_of(
    domain: Domain, phrases: Sequence[str], transitions: NDArray[np.int64]
) -> tuple[Clip, ...]:
    """Describes transitions [T, 3] of a domain, with their cells if the domain has a map."""
    begin, cells = transitions[:, 0].tolist(), domain.position
    situations, gone = (of_states(domain, what, begin) for what in ("situation", "gone"))
    changes = () if domain.scene else changes_of(domain, transitions)
    none: Told = ((),) * len(begin)
    moves = [(cells(before), cells(after)) for before, after in transitions[:, [0, 2]].tolist()]
    ways: list[Way] = [((a, b),) if domain.scene and a and b else () for a, b in moves]
    return tuple(map(Clip, phrases, ways, situations or none, gone or none, changes or none))


def read_own_task(cfg: DictConfig) -> Material | None:
    """Reads the task from a lab's own tables (``transitions`` and ``facts``); None if the task is a
    domain.

    Raises:
        InputError: a table cannot be read, or keys exclude each other.
    """
    one_of("briefing", cfg.briefing, ("assigned", "none"))
    if cfg.transitions is None:
        if cfg.facts is not None:
            wanted = "only with transitions=TABLE; a domain has sentences"
            raise InputError("facts", cfg.facts, wanted)
        return None
    if cfg.briefing == "assigned":
        wanted = "none for your own transitions: they name no types"
        raise InputError("briefing", "assigned", wanted)
    return read_own_table(Path(cfg.transitions), cfg.facts, cfg.seed)


def read_own_table(table: Path, facts: str | None, seed: int) -> Material:
    """Reads a lab's own transitions and the sentences of the facts.

    Raises:
        InputError: a table cannot be read, a fact has no sentences, or an image cannot be shown.
    """
    own = read_transitions(table)
    known = with_features(own.hypotheses)
    assert known.features is not None, "just made"
    shown = zip(own.hypotheses.phrases, own.images, own.alts, strict=True)
    drawn = draw_roles(known, seed).items()
    return Material(
        name=table.stem,
        facts=read_facts(facts, known.messages),
        types=tuple(
            UserType(name, {known.messages[j]: False for j in indices(held)})
            for name, held in drawn
        ),
        clips=tuple(
            Clip(phrase, picture=_read_picture(table.parent, image, alt))
            for phrase, image, alt in shown
        ),
        features=known.features,
        feature_names=known.feature_names,
        hypotheses=known,
    )


def read_facts(path: str | None, names: Sequence[str]) -> tuple[Parameter, ...]:
    """Reads the sentences of facts from a CSV table with the columns fact, message and belief.

    Raises:
        InputError: the table cannot be read, or lacks a sentence of a fact.
    """
    if path is None:
        raise InputError(
            "facts",
            None,
            "a .csv file with the columns fact, message (the true sentence) and belief (the "
            f"sentence of people who believe the fact incorrectly), for {', '.join(names)}",
        )
    table = read_cells(Path(path), "facts").to_dict("records")
    rows, found = {str(row.get("fact", "")).strip(): row for row in table}, []
    for name in names:
        row = rows.get(name, {})
        message, belief = (str(row.get(key, "")).strip() for key in ("message", "belief"))
        if not message or not belief:
            raise InputError("facts", name, f"a message and a belief in {path}")
        found.append(Parameter(name, True, False, message, belief))
    return tuple(found)


def draw_roles(known: Hypotheses, seed: int) -> dict[str, int]:
    """Draws non-empty fact sets with different labels, for simulated people."""
    sets = np.unique(known.essential[known.essential > 0])
    chosen = stream(seed, "roles").permutation(sets)[:DRAWN_ROLES].tolist()
    return {"+".join(names_of(held, known.messages)): held for held in chosen}


def _read_picture(folder: Path, image: str, alt: str) -> Picture | None:
    if not image:
        return None
    path = folder / image
    wanted = (
        f"a picture ({', '.join(FORMATS)}) in {folder}, no link, of at most {MAX_IMAGE >> 20} MB "
        f"and {MAX_SIDE} × {MAX_SIDE} pixels"
    )
    try:
        inside = not path.is_symlink() and path.resolve().is_relative_to(folder.resolve())
        if not inside or path.stat().st_size > MAX_IMAGE:
            raise ValueError("not allowed")
        with Image.open(path, formats=FORMATS) as read:
            if max(read.size) > MAX_SIDE:
                raise ValueError(f"{read.width} × {read.height} pixels")
            upright, kind = ImageOps.exif_transpose(read), str(read.format)
            # Saving the picture again removes its other data, such as its place and author.
            content = io.BytesIO()
            upright.info = {key: upright.info[key] for key in upright.info.keys() & KEPT}
            upright.save(content, kind, quality=95)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError("transitions.image", image, f"{wanted} ({first_line(error)})") from None
    media = Image.MIME[kind]
    return Picture(media, base64.b64encode(content.getvalue()).decode(), alt)


def learn_domain_types(cfg: DictConfig, domain: Domain) -> tuple[Setting, LearnedTypes]:
    """Learns the types of a domain from simulated observers, as experiments do."""
    users, observers, queries = (component(cfg, key) for key in ("users", "observers", "queries"))
    observed = observe(domain, users, observers, queries, cfg.seed)
    assert observed.setting is not None, "of simulated observers"
    finder = component(cfg, "clusterer", labeler=component(cfg, "labeler"))
    found = finder.find(observed, cfg.seed)
    return observed.setting, LearnedTypes.of(found, observed.dataset)


InWords = Callable[[str], str]
NOT_OF_THE_PLAN = ("consent", "database", "host", "port", "server", "outputs")
"""Keys that are not part of the plan: they may change between two starts."""


def texts_of(kind: str, wording: Mapping[str, Any], in_words: InWords = str) -> Texts:
    """Collects the texts of the pages.

    Args:
        kind: study or collect; the shipped texts of this kind define the required keys.
        wording: texts of the configuration.
        in_words: converts a domain's phrases to texts for people.

    Raises:
        InputError: the text of a page is missing.
    """
    shared, own = (
        yaml.safe_load((CONF / file).read_text(encoding="utf-8"))
        for file in ("words/en.yaml", f"{kind}/texts/en.yaml")
    )
    words, known = wording["words"], {**shared, **own["words"]}
    for key in known:
        if not str(words.get(key) or "").strip():
            raise InputError(f"wording.words.{key}", words.get(key), "the text of a page")
    paragraphs = ("consent", "introduction", "task", "debriefing")
    return Texts(
        title=wording["title"],
        contact=wording["contact"],
        words=words,
        **{key: tuple(in_words(text) for text in wording[key]) for key in paragraphs},
    )


def phrases_of(phrases: Mapping[str, str], on_a_map: bool) -> InWords:
    """Makes a function that turns a domain's phrases into texts for people, with single spaces, as
    browsers show them.

    Args:
        phrases: parts of phrases with their replacements; the longest match is used.
        on_a_map: True if (row, column) and "row r, column c", counted from 0, become a letter and
            a number as on the map.
    """
    parts = sorted(phrases, key=len, reverse=True)
    pattern = "|".join(rf"(?<!\w){re.escape(part)}(?!\w)" for part in parts) or "(?!)"
    cell = r"\((\d+), (\d+)\)|row (\d+), column (\d+)" if on_a_map else "(?!)"

    def named(found: re.Match[str]) -> str:
        return cell_name(*(int(number) for number in found.groups() if number is not None))

    def in_words(text: str) -> str:
        return " ".join(
            re.sub(cell, named, re.sub(pattern, lambda found: phrases[found[0]], text)).split()
        )

    return in_words


def reword_parameters(
    told: Sequence[Parameter], facts: Mapping[str, Mapping[str, str]], in_words: InWords
) -> tuple[Parameter, ...]:
    """Gives parameters the lab's own sentences.

    Raises:
        InputError: the lab has sentences for an unknown parameter, or there is no sentence of
            people who believe a parameter incorrectly.
    """
    names = [one.name for one in told]
    for name in facts:
        one_of(f"wording.facts.{name}", name, names)
    own = [replace(one, **facts.get(one.name, {})) for one in told]
    for one in own:
        wanted = "a sentence of a user who believes it incorrectly; the pages need it"
        sentence(f"domain.values.{one.name}.belief", one.belief, wanted)
    return tuple(
        replace(one, message=in_words(one.message), belief=in_words(one.belief)) for one in own
    )


def name_items(scene: Scene, in_words: InWords) -> Scene:
    """Returns the map with its items' names in words. Items that show the value of a parameter are
    left out, because a participant may believe another value."""
    kept = [replace(item, name=in_words(item.name)) for item in scene.items if not item.shows]
    return replace(scene, items=tuple(kept))


def select_plan_keys(cfg: DictConfig) -> dict[str, Any]:
    """Returns the keys of a configuration that belong to the plan, with resolved values: all keys
    except NOT_OF_THE_PLAN."""
    plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    return {key: value for key, value in plain.items() if key not in NOT_OF_THE_PLAN}


def of_states(domain: Domain, method: str, states: Iterable[int]) -> Told:
    """Calls a domain's optional method for each state, and returns the results. Returns an empty
    tuple if the domain has no such method."""
    told = getattr(domain, method, None)
    return () if told is None else tuple(tuple(told(int(state))) for state in states)


def ahead_of(step: Mapping[str, Any], scene: Scene | None, in_words: InWords) -> Ahead:
    """Reads from a lab's texts the practice step that looks wrong, but is right because of later
    steps.

    Raises:
        InputError: the step is not on this map.
    """
    way = tuple(((a, b), (c, d)) for (a, b), (c, d) in step["way"])
    for row, column in (cell for move in way for cell in move):
        inside = scene and 0 <= row < scene.rows and 0 <= column < scene.columns
        if scene is None or not inside or (row, column) in scene.walls:
            wanted = "a cell of this map where the robot can be; wording.ahead=null for none"
            raise InputError("wording.ahead.way", [row, column], wanted)
    return Ahead(tuple(map(in_words, step["steps"])), way)


def make_plan_fields(
    kind: str, config: Mapping[str, Any], wording: Mapping[str, Any], task: Material, does: str
) -> tuple[dict[str, Any], InWords]:
    """Makes the fields that all plans have, and the function that turns a domain's phrases into
    words.

    Args:
        kind: study or collect; the shipped texts of this kind define the required keys.
        config: configuration of the plan.
        wording: texts of the configuration.
        task: the material.
        does: a sentence about the robot that contains ``{phrase}``, its action.

    Raises:
        InputError: a text is missing, or describes something that does not exist.
    """
    scene = task.scene
    in_words = phrases_of(wording["phrases"], scene is not None)
    return {
        "seed": config["seed"],
        "config": config,
        "domain": task.name,
        "facts": reword_parameters(task.facts, wording["facts"], in_words),
        "texts": texts_of(kind, wording, in_words),
        "example": Example(**wording["example"]),
        "ahead": wording["ahead"]
        and ahead_of(wording["ahead"], scene, lambda phrase: does.format(phrase=in_words(phrase))),
        "scene": scene and name_items(scene, in_words),
        "icons": {in_words(name): path for name, path in wording["icons"].items()},
    }, in_words
