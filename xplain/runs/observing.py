"""The commands ``observe`` and ``questions``, from their configurations to their files."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from hydra.utils import instantiate
from omegaconf import DictConfig

from xplain.errors import InputError
from xplain.experiment import pipeline
from xplain.explanation.message_sets import names_of
from xplain.learning.data.label_file import is_parquet, write_table
from xplain.questions.designs import Battery, battery
from xplain.questions.own_transitions import read_known_facts
from xplain.randomness import run_seed
from xplain.storage import write_text

Row = dict[str, Any]


def write_labels(cfg: DictConfig) -> Row:
    """Writes labels of simulated observers, and their true types in a second file. Returns both
    paths, and the numbers of observers, labels and types.

    Args:
        cfg: conf/observe.yaml with its overrides, and the ``hydra`` node.

    Raises:
        XplainError: a value cannot be used, or the observers are not simulated.
    """
    run_seed(cfg.seed)
    output = Path(cfg.output)
    is_parquet(output, "output")
    named = output.name.removesuffix(".gz").removesuffix(".csv").removesuffix(".parquet")
    beside = output.with_name(f"{named}.types.csv") if cfg.truth is None else Path(cfg.truth)
    if output.resolve() == beside.resolve():
        raise InputError("truth", cfg.truth, "another file than the output")
    domain, users = instantiate(cfg.domain), instantiate(cfg.users)
    observers, queries = instantiate(cfg.observers), instantiate(cfg.queries)
    found = pipeline.observe(domain, users, observers, queries, cfg.seed)
    if found.truth is None or found.setting is None:
        raise InputError("observers", cfg.hydra.runtime.choices.observers, "simulated")
    for path in (output, beside):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_table(found.dataset, output)
    names, like = [one.name for one in found.setting.types], found.setting.distinct[found.truth]
    types = {"type": [names[t] for t in found.truth], "behaves_like": [names[t] for t in like]}
    pd.DataFrame({"observer": found.dataset.observers, **types}).to_csv(beside, index=False)
    return {
        "output": str(output),
        "truth": str(beside),
        "observers": len(found.dataset.observers),
        "labels": len(found.dataset),
        "types": len(set(like.tolist())),
    }


def write_questions(cfg: DictConfig) -> tuple[list[Row], Row]:
    """Writes the questions to ask. Returns a row for each question, and a summary.

    Args:
        cfg: conf/questions.yaml with its overrides, and the ``hydra`` node.

    Raises:
        XplainError: a value cannot be used, or the questions depend on answers.
    """
    run_seed(cfg.seed)
    design = instantiate(cfg.queries)
    if not isinstance(design, Battery):
        allowed = (
            "battery; other designs choose each question after the last answer (from xplain import "
            "Questionnaire)"
        )
        raise InputError("queries", cfg.hydra.runtime.choices.queries, allowed)
    path = cfg.hypotheses if cfg.hypotheses is not None else cfg.queries.hypotheses
    domain = instantiate(cfg.domain) if path is None and cfg.transitions is None else None
    known, images, sentences = read_known_facts(cfg.transitions, path, domain)
    assert known is not None, "a table, a file or a domain has the facts"
    transitions, told = battery(known, design.redundancy, cfg.seed)
    rows: list[Row] = []
    for number, (t, mask) in enumerate(zip(transitions.tolist(), told.tolist(), strict=True), 1):
        said = {name: sentences.get(name, name) for name in names_of(mask, known.messages)}
        row = {
            "question": number,
            "transition": t,
            "text": known.phrases[t] if known.phrases else f"transition {t}",
            "image": images[t] if images else "",
            "messages": ";".join(said),
            "told": " ".join(said.values()),
        }
        if known.features is not None:
            row |= zip(known.feature_names, known.features[t].tolist(), strict=True)
        rows.append(row)
    if cfg.save is not None:
        known.save(cfg.save)
    output = Path(cfg.output)
    output.parent.mkdir(parents=True, exist_ok=True)
    write_text(output, pd.DataFrame(rows).to_csv(index=False, lineterminator="\n"))
    about = {"output": str(cfg.output), "questions": len(rows)}
    candidates = len(np.unique(known.classes))
    return rows, about | {"transitions": known.n_transitions, "candidates": candidates}
