"""A lab's own transitions for people: a table of steps with images, and the sentences of its facts.

See :mod:`xplain.questions.own_transitions` for the table itself.
"""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from xplain.domains.base import Domain, Parameter
from xplain.domains.users.hypotheses import Hypotheses
from xplain.domains.users.types import TypeSource
from xplain.errors import InputError, first_line
from xplain.explanation.message_sets import names_of
from xplain.people.plan import Picture, Task, Told, Way
from xplain.questions.own_transitions import read_transitions, with_features
from xplain.randomness import stream

KEPT = {"transparency"}
"""What is kept of a picture beside its pixels."""
FORMATS = ("PNG", "JPEG", "WEBP", "GIF")
MAX_IMAGE, MAX_SIDE = 2 << 20, 4096
"""Bytes of one image, and pixels of its longer side."""
DRAWN_ROLES = 4
"""Kinds of simulated people where nobody wrote down which there may be."""


@dataclass(frozen=True, kw_only=True)
class Source(Task):
    """A task that people can be asked about.

    Attributes:
        hypotheses: T transitions with phrases and features.
        roles: {name: bitmask of what it holds wrong}, of simulated people.
        whole, situations, gone, paths: see :class:`xplain.people.collect.plan.CollectPlan`.
        domain, users: of the task, where there is a model of it.
    """

    hypotheses: Hypotheses
    roles: Mapping[str, int]
    whole: Hypotheses | None = None
    situations: Told = ()
    gone: Told = ()
    paths: Way = ()
    domain: Domain | None = None
    users: TypeSource | None = None


def own_table(table: Path, facts: str | None, seed: int) -> Source:
    """One's own transitions, and the sentences of the facts.

    Raises:
        InputError: a table cannot be read, a fact has no sentences, or an image cannot be shown.
    """
    own = read_transitions(table)
    known = with_features(own.hypotheses)
    shown = zip(own.images, own.alts, strict=True)
    pictures = tuple(_picture(table.parent, image, alt) for image, alt in shown)
    return Source(
        name=table.stem,
        hypotheses=known,
        facts=read_facts(facts, known.messages),
        roles=drawn_roles(known, seed),
        pictures=pictures if any(pictures) else (),
    )


def read_facts(path: str | None, names: Sequence[str]) -> tuple[Parameter, ...]:
    """The sentences of facts, from a CSV table with the columns fact, message and belief.

    Raises:
        InputError: no such table, or a fact without a sentence in it.
    """
    wanted = (
        "a .csv file with the columns fact, message, belief: the robot's value, and what "
        f"somebody who holds it wrong would say, of {', '.join(names)}"
    )
    if path is None:
        raise InputError("facts", None, wanted)
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            rows = {(row.get("fact") or "").strip(): row for row in csv.DictReader(file)}
    except (OSError, UnicodeDecodeError, csv.Error):
        raise InputError("facts", str(path), wanted) from None
    found = []
    for name in names:
        row = rows.get(name, {})
        message, belief = ((row.get(key) or "").strip() for key in ("message", "belief"))
        if not message or not belief:
            raise InputError("facts", name, f"a message and a belief in {path}")
        found.append(Parameter(name, True, False, message, belief))
    return tuple(found)


def drawn_roles(known: Hypotheses, seed: int) -> dict[str, int]:
    """Some fact sets that behave differently, none of them empty, for simulated people."""
    sets = np.unique(known.essential[known.essential > 0])
    chosen = stream(seed, "roles").permutation(sets)[:DRAWN_ROLES].tolist()
    return {"+".join(names_of(held, known.messages)): held for held in chosen}


def _picture(folder: Path, image: str, alt: str) -> Picture | None:
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
            # Written anew, a picture has nothing but its pixels: no place and no name in it.
            content = io.BytesIO()
            upright.info = {key: upright.info[key] for key in upright.info.keys() & KEPT}
            upright.save(content, kind, quality=95)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError("transitions.image", image, f"{wanted} ({first_line(error)})") from None
    media = Image.MIME[kind]
    return Picture(media, base64.b64encode(content.getvalue()).decode(), alt)
