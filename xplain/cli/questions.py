"""Says what to ask people: ``xplain questions domain=rescue output=questions.csv``.

Prints one list of questions that tells apart all that people might hold wrong, and writes it:
``question``, ``transition`` (its row in the hypotheses), ``text`` (what the robot does), ``image``,
``messages`` (names joined by ``;``), ``told`` (the same in words), and the features, if any.
The last line on standard output is one JSON object: ``output``, ``questions``, ``transitions``,
``candidates`` (that behave differently).
"""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.utils import instantiate
from omegaconf import DictConfig

from xplain.config import composed, require_seed
from xplain.errors import InputError

if TYPE_CHECKING:
    from xplain.questions.hypotheses import Hypotheses

Row = dict[str, Any]


def questions(arguments: list[str]) -> Row:
    """Writes the list; returns what the command prints. ``arguments`` override
    conf/questions.yaml."""
    import numpy as np

    from xplain.questions.battery import battery
    from xplain.questions.designs import Battery

    cfg = composed("questions", arguments, with_hydra=True)
    require_seed(cfg)
    design = instantiate(cfg.queries)
    if not isinstance(design, Battery):
        raise InputError(
            "queries",
            cfg.hydra.runtime.choices.queries,
            "battery; other questions depend on answers (from xplain import Questionnaire)",
        )
    known, images, sentences = _known(cfg)
    transitions, told = battery(known, design.redundancy, cfg.seed)
    rows = [
        _row(known, images, sentences, number, int(t), int(mask))
        for number, (t, mask) in enumerate(zip(transitions, told, strict=True), 1)
    ]
    _write(rows, Path(cfg.output))
    if cfg.save is not None:
        known.save(cfg.save)
    _show(rows)
    return {
        "output": str(cfg.output),
        "questions": len(rows),
        "transitions": known.n_transitions,
        "candidates": len(np.unique(known.classes)),
    }


def _known(cfg: DictConfig) -> tuple[Hypotheses, tuple[str, ...], dict[str, str]]:
    """The hypotheses, the transitions' images, and what to say for each message."""
    from xplain.questions.designs import hypotheses_of
    from xplain.questions.own_transitions import read_transitions

    path = cfg.hypotheses if cfg.hypotheses is not None else cfg.queries.hypotheses
    if path is not None and cfg.transitions is not None:
        raise InputError("transitions", cfg.transitions, "either transitions or hypotheses")
    if cfg.transitions is not None:
        own = read_transitions(cfg.transitions)
        return own.hypotheses, own.images, {}
    if path is not None:
        return hypotheses_of(None, path), (), {}
    domain = instantiate(cfg.domain)
    return hypotheses_of(domain, None), (), {p.name: p.message for p in domain.parameters}


def _row(
    known: Hypotheses,
    images: tuple[str, ...],
    sentences: dict[str, str],
    number: int,
    transition: int,
    mask: int,
) -> Row:
    from xplain.message_sets import names_of

    names = names_of(mask, known.messages)
    row: Row = {
        "question": number,
        "transition": transition,
        "text": known.phrases[transition] if known.phrases else f"transition {transition}",
        "image": images[transition] if images else "",
        "messages": ";".join(names),
        "told": " ".join(sentences.get(name, name) for name in names),
    }
    if known.features is not None:
        row |= zip(known.feature_names, known.features[transition].tolist(), strict=True)
    return row


def _write(rows: list[Row], output: Path) -> None:
    from xplain.storage import written_whole

    output.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(output) as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _show(rows: list[Row]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("", "the robot", "told before")
    for row in rows:
        table.add_row(str(row["question"]), row["text"], row["told"] or "nothing")
    Console().print(table)


def main(arguments: list[str]) -> None:
    """Writes and prints the list, and prints the JSON line."""
    print(json.dumps(questions(arguments)))
