"""Says what to ask people: ``xplain questions domain=rescue output=questions.csv``.

Prints one list of questions that tells apart all that people might hold wrong, and writes it:
``question``, ``transition`` (its row in the hypotheses), ``text`` (what the robot does), ``image``,
``messages`` (names joined by ``;``), ``told`` (the same in words), and the features, if any.
The last line on standard output is one JSON object: ``output``, ``questions``, ``transitions``,
``candidates`` (that behave differently).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from xplain.domains.users.hypotheses import Hypotheses, hypotheses_of
from xplain.errors import InputError
from xplain.experiment.config import composed
from xplain.explanation.message_sets import names_of
from xplain.questions.designs import Battery, battery
from xplain.questions.own_transitions import read_transitions
from xplain.randomness import run_seed
from xplain.storage import written_whole

Row = dict[str, Any]


def main(arguments: list[str]) -> Row:
    """Writes the list; returns what the command prints. ``arguments`` override
    conf/questions.yaml."""

    cfg = composed("questions", arguments, with_hydra=True)
    run_seed(cfg.seed)
    design = instantiate(cfg.queries)
    if not isinstance(design, Battery):
        raise InputError(
            "queries",
            cfg.hydra.runtime.choices.queries,
            "battery; other questions depend on the answer before (from xplain import "
            "Questionnaire)",
        )
    rows, about = _battery(cfg, design)
    _write(rows, Path(cfg.output))
    _show(rows)
    return {"output": str(cfg.output), "questions": len(rows), **about}


def _battery(cfg: DictConfig, design: Battery) -> tuple[list[Row], Row]:
    """The questions, and what is known of them."""

    known, images, sentences = _known(cfg)
    transitions, told = battery(known, design.redundancy, cfg.seed)
    rows: list[Row] = []
    for number, (t, mask) in enumerate(zip(transitions.tolist(), told.tolist(), strict=True), 1):
        said = {name: sentences.get(name, name) for name in names_of(mask, known.messages)}
        text = known.phrases[t] if known.phrases else f"transition {t}"
        row = _row(number, t, text, images[t] if images else "", said)
        if known.features is not None:
            row |= zip(known.feature_names, known.features[t].tolist(), strict=True)
        rows.append(row)
    if cfg.save is not None:
        known.save(cfg.save)
    candidates = len(np.unique(known.classes))
    return rows, {"transitions": known.n_transitions, "candidates": candidates}


def _known(cfg: DictConfig) -> tuple[Hypotheses, tuple[str, ...], dict[str, str]]:
    """The hypotheses, the transitions' images, and what to say for each message."""

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


def _row(number: int, transition: int, text: str, image: str, told: dict[str, str]) -> Row:
    """A question; ``told``: what is said first, by message."""
    return {
        "question": number,
        "transition": transition,
        "text": text,
        "image": image,
        "messages": ";".join(told),
        "told": " ".join(told.values()),
    }


def _write(rows: list[Row], output: Path) -> None:

    output.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(output) as file:
        pd.DataFrame(rows).to_csv(file, index=False, lineterminator="\n")


def _show(rows: list[Row]) -> None:

    table = Table("", "the robot", "told before")
    for row in rows:
        table.add_row(str(row["question"]), row["text"], row["told"] or "nothing")
    Console().print(table)
