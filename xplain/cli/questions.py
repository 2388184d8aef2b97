"""Says what to ask people: ``xplain questions domain=rescue output=questions.csv``.

Prints one list of questions that tells apart all that people might hold wrong, and writes it:
``question``, ``transition`` (its row in the hypotheses), ``text`` (what the robot does), ``image``,
``messages`` (names joined by ``;``), ``told`` (the same in words), and the features, if any.
The last line on standard output is one JSON object: ``output``, ``questions``, ``transitions``,
``candidates`` (that behave differently).

Where nobody knows what people might hold wrong (``queries=adaptive queries.hypotheses=none``), it
is the next screen of questions to one ``observer``, by the answers so far (``data``). Its columns
``observer`` and ``label`` (empty) make it a form: filled in and put below the answers so far, it is
the ``data`` of the next screen, and of ``xplain discover``. The JSON object then has ``output``,
``questions``, ``transitions``, ``observer``, ``answers`` (so far).
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
from xplain.domains.users.setting import Setting
from xplain.errors import InputError
from xplain.experiment.config import composed
from xplain.explanation.message_sets import names_of
from xplain.learning.data.encoding import align, columns_of
from xplain.learning.data.label_file import read_table
from xplain.questions.battery import battery
from xplain.questions.candidates import Candidates
from xplain.questions.committee import next_screen_of
from xplain.questions.designs import WITHOUT, Adaptive, Battery
from xplain.questions.own_transitions import read_transitions
from xplain.randomness import run_seed, stream
from xplain.storage import written_whole

Row = dict[str, Any]


def main(arguments: list[str]) -> Row:
    """Writes the list; returns what the command prints. ``arguments`` override
    conf/questions.yaml."""

    cfg = composed("questions", arguments, with_hydra=True)
    run_seed(cfg.seed)
    design = instantiate(cfg.queries)
    if isinstance(design, Battery):
        rows, about = _battery(cfg, design)
    elif getattr(design, "hypotheses", None) == WITHOUT:
        rows, about = _screen(cfg, design)
    else:
        raise InputError(
            "queries",
            cfg.hydra.runtime.choices.queries,
            "battery, or adaptive with queries.hypotheses=none, a screen at a time; with "
            "hypotheses each question depends on the answer before (from xplain import "
            "Questionnaire)",
        )
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


def _screen(cfg: DictConfig, design: Adaptive) -> tuple[list[Row], Row]:
    """As :func:`_battery`, of the next screen."""

    for key in ("hypotheses", "save"):
        if cfg[key] is not None:
            raise InputError(key, cfg[key], "null; queries.hypotheses=none does without them")
    if not cfg.observer:
        raise InputError("observer", cfg.observer, "the name of who is asked next")
    pool, texts, images, sentences = _pool(cfg)
    answers = pool.unanswered(tuple(sentences))
    columns = columns_of(answers)
    if cfg.data is not None:
        read = read_table(cfg.data, tuple(sentences), list(columns), under_way=True)
        answers = pool.answered(align(read, pool.feature_names))
    rng = stream(cfg.seed, "queries", "committee", cfg.observer, len(answers))
    transitions, told = next_screen_of(pool, answers, cfg.observer, design.screen, rng)
    rows: list[Row] = []
    for number, (t, mask) in enumerate(zip(transitions.tolist(), told.tolist(), strict=True), 1):
        names = names_of(mask, tuple(sentences))
        row = _row(number, t, texts[t], images[t], {name: sentences[name] for name in names})
        # The text itself is a feature where the table has no other.
        row |= {name: own[pool.which[t]] for name, own in columns.items() if name != "text"}
        rows.append(row | {"observer": cfg.observer, "label": ""})
    size = len(pool.features)
    return rows, {"transitions": size, "observer": cfg.observer, "answers": len(answers)}


def _pool(cfg: DictConfig) -> tuple[Candidates, tuple[str, ...], tuple[str, ...], dict[str, str]]:
    """What can be asked about, in words, its images, and what to say for each message."""

    if cfg.transitions is None:
        domain = instantiate(cfg.domain)
        types = instantiate(cfg.users).types(domain, stream(cfg.seed, "users"))
        setting = Setting.build(domain, types)
        texts = tuple(domain.describe(transition) for transition in setting.reachable)
        said = {p.name: p.message for p in domain.parameters}
        return Candidates.of_setting(setting), texts, ("",) * len(texts), said
    own = read_transitions(cfg.transitions)
    names = list(cfg.messages or (own.hypotheses.messages if own.facts else ()))
    if not names:
        raise InputError("messages", cfg.messages, "names of what people can be told")
    features, feature_names = own.told_apart()
    pool = Candidates.of(features, feature_names, np.ones(len(own.texts)))
    return pool, own.texts, own.images, {name: name for name in names}


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
