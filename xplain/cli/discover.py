"""Finds the user types in people's labels: ``xplain discover data=FILE``.

The file is read as :mod:`xplain.learning.data.label_file` says. Into the folder ``output`` go

- ``types.npz``: the types and their labelers, as :class:`xplain.learning.saved.LearnedTypes`
  loads them (for ``xplain.Explainer``);
- ``assignment.csv``: the type of each observer;
- ``predictions.csv``, with ``predict=FILE``: the rows of FILE, and ``p``, the probability of the
  answer 1 of that observer;
- ``summary.json``: what is known of each type, and how it was found;
- ``curve.png`` (disagreements by number of types) or ``posterior.png`` (probability of each number
  of types), as the method has them, ``messages.png``: what each message does for each type, and
  ``calibration.png``: how likely held-out labels were said to be 1, against how many are.

The last line on standard output is one JSON object: ``n_types``, ``assignment`` {observer: type},
``method``, ``rule``, ``held_out`` (how well held-out labels are predicted, in nats a label, with
and without types; null where ``held_out=false``), ``held_out_log_likelihood`` (that with types),
``seconds``.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
from hydra.utils import instantiate
from omegaconf import OmegaConf
from rich.console import Console
from rich.table import Table
from yaml import YAMLError

from xplain.domains.users.hypotheses import Hypotheses
from xplain.errors import InputError, TooLargeError, one_of
from xplain.experiment.config import composed
from xplain.explanation.message_sets import names_of
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.label_file import read_questions, read_table
from xplain.learning.data.observers import Observed
from xplain.learning.known_types import learn
from xplain.learning.paper import minimal_message_set
from xplain.learning.prediction import Tenth, held_out, predicted
from xplain.learning.saved import LearnedTypes
from xplain.learning.user_types import UserTypes, with_none_of_these
from xplain.randomness import run_seed

Row = dict[str, Any]


def main(arguments: list[str]) -> Row:
    """Finds the types and writes the files; returns what the command prints. ``arguments``
    override conf/discover.yaml."""

    began = time.perf_counter()
    cfg = composed("discover", arguments)
    run_seed(cfg.seed)
    folder = Path(cfg.output)
    require_writable(folder)
    trainer, clusterer = instantiate(cfg.labeler), instantiate(cfg.clusterer)
    if cfg.hypotheses is None:
        dataset = read_table(cfg.data, cfg.messages, cfg.features, cfg.ignore)
    else:
        known = Hypotheses.load(cfg.hypotheses)
        like = known.feature_names
        dataset = read_table(cfg.data, known.messages, cfg.features, cfg.ignore, like=like)
    said = sentences_of(cfg.sentences, dataset.messages)
    asked = None
    if cfg.predict is not None:
        asked = read_questions(cfg.predict, dataset)
    types = learn(Observed(dataset), trainer, clusterer, cfg.seed)
    types = with_none_of_these(types, dataset, cfg.none_of_these)
    clustering = types.clustering
    unseen = held_out(dataset, clusterer, trainer, cfg.seed) if cfg.held_out else None
    told = None if unseen is None else asdict(unseen) | {"verdict": unseen.verdict}
    tenths = () if told is None else told.pop("calibration")
    row: Row = {
        "n_types": clustering.n_types,
        "assignment": {
            name: types.names[t]
            for name, t in zip(dataset.observers, clustering.assignment, strict=True)
        },
        "method": clustering.method,
        "rule": clustering.rule,
        "held_out_log_likelihood": None if unseen is None else unseen.types,
        "held_out": told,
        "seconds": time.perf_counter() - began,
    }
    _write(folder, dataset, types, row, said, tenths)
    if asked is not None:
        table, questions = asked
        table["p"] = predicted(dataset, types, questions)
        table.to_csv(folder / "predictions.csv", index=False)
    return row


def sentences_of(path: str | None, messages: Sequence[str]) -> dict[str, str]:
    """``{message: what to say}`` of a YAML file; empty where there is none.

    Raises:
        InputError: the file cannot be read, or holds anything else than texts of these messages.
    """
    if path is None:
        return {}
    wanted = "a YAML file, a line a message: what to say"
    try:
        said = OmegaConf.to_container(OmegaConf.load(path))
    except (OSError, ValueError, YAMLError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError("sentences", path, f"{wanted} ({reason})") from None
    if not isinstance(said, dict) or not all(isinstance(text, str) for text in said.values()):
        raise InputError("sentences", path, wanted)
    return {
        str(one_of("sentences", name, messages, "message")): text for name, text in said.items()
    }


def require_writable(folder: Path) -> None:
    """Refuses a folder that cannot be written, before any work is done and without making it.

    Raises:
        InputError: see above.
    """
    above = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise InputError("output", str(folder), "a folder that can be written")


def _write(
    folder: Path,
    dataset: Dataset,
    types: UserTypes,
    row: Row,
    sentences: dict[str, str],
    tenths: Sequence[Tenth],
) -> None:

    from xplain.cli import discovery_plots
    from xplain.report import plots

    clustering = types.clustering
    figures = {}
    if dataset.messages:
        figures["messages"] = discovery_plots.effects(dataset, clustering, types.names)
    if clustering.curve is not None and len(clustering.curve) > 1:
        curve = clustering.curve[: max(4 * clustering.n_types, 20)].tolist()
        figures["curve"] = plots.disagreements(curve, clustering.n_types, clustering.rule)
    if clustering.posterior is not None:
        figures["posterior"] = discovery_plots.posterior(clustering.posterior, clustering.n_types)
    if tenths:
        figures["calibration"] = discovery_plots.calibration(tenths)
    folder.mkdir(parents=True, exist_ok=True)
    LearnedTypes.of(types, dataset, sentences).save(folder / "types.npz")
    pd.DataFrame(row["assignment"].items(), columns=["observer", "type"]).to_csv(
        folder / "assignment.csv", index=False
    )
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png")
    known = summarised(dataset, types)
    summary = {key: value for key, value in row.items() if key != "assignment"}
    summary |= {"labels": len(dataset), "types": known}
    if clustering.posterior is not None:
        summary["posterior"] = clustering.posterior
    if types.evidence is not None:
        hypotheses, labels = types.evidence.nats
        summary["evidence"] = {"hypotheses": hypotheses, "labels_alone": labels}
        summary["evidence"] |= {"verdict": str(types.evidence)}
    if tenths:
        summary["calibration"] = [one._asdict() for one in tenths]
    text = json.dumps(summary, indent=2)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")
    _show(row, known, folder, tenths)


def summarised(dataset: Dataset, types: UserTypes) -> list[Row]:
    """What is known of each type."""

    rows: list[Row] = []
    known = types.clustering.needs
    for t in range(types.clustering.n_types):
        own = dataset.of(types.clustering.members(t))
        labeler = types.labelers[t]
        row: Row = {
            "name": types.names[t],
            "observers": len(types.clustering.members(t)),
            "labels": len(own),
            "explicable": float(own.label.mean()),
            "confidence": labeler.confidence,
        }
        labelled = dataset.features[sorted(set(own.transition.tolist()))]
        try:
            if known is not None:  # by all observers' labels, not by this type's alone
                needed = int(known[t])
            else:
                needed = minimal_message_set(labeler.classifier, labelled, dataset.n_messages)
            row["needs"] = list(names_of(needed, dataset.messages))
        except TooLargeError:  # no tree, and too many messages to try them all
            row["needs"] = None
        rows.append(row)
    return rows


def _show(row: Row, known: list[Row], folder: Path, tenths: Sequence[Tenth]) -> None:

    table = Table("type", "observers", "labels", "explicable", "confidence", "needs to be told")
    for one in known:
        table.add_row(
            one["name"],
            str(one["observers"]),
            str(one["labels"]),
            f"{one['explicable']:.1%}",
            f"{one['confidence']:.3f}",
            "?" if one["needs"] is None else ", ".join(one["needs"]) or "nothing",
        )
    console = Console()
    console.print(
        f"{row['n_types']} user types ({row['method']}, {row['rule']}); files in {folder}"
    )
    console.print(table)
    if row["held_out"] is not None:
        figures = {key: row["held_out"][key] for key in ("types", "one_type", "question_mean")}
        said = ", ".join(f"{key.replace('_', ' ')} {-own:.3f}" for key, own in figures.items())
        console.print(f"nats a held-out label: {said}; {row['held_out']['verdict']}")
        off = max(abs(one.said - one.ones) for one in tenths)
        console.print(f"calibration: off by {off:.3f} at most in a tenth of them (calibration.png)")
