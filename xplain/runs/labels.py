"""Labels of people: questions to ask, labels of simulated observers, and the user types that are
found in labels. The commands ``questions``, ``observe`` and ``discover``, from their configurations
to their files; ``discover`` also from Python."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from yaml import YAMLError

from xplain.domains.users.hypotheses import Hypotheses
from xplain.errors import InputError, TooLargeError, first_line, one_of
from xplain.experiment.explanations import describe_costs, simulate_costs
from xplain.experiment.pipeline import observe
from xplain.explanation.message_sets import names_of
from xplain.interaction.explainer import Explainer
from xplain.interaction.statistics import Estimate
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.label_file import is_parquet, read_questions, read_table, write_table
from xplain.learning.data.observers import Observations
from xplain.learning.paper import smallest
from xplain.learning.prediction import HeldOut, predict, predict_held_out
from xplain.learning.saved import LearnedTypes
from xplain.learning.user_types import UserTypes
from xplain.questions.designs import Battery, battery
from xplain.questions.own_transitions import read_known_facts
from xplain.randomness import run_seed
from xplain.report.table import table_of
from xplain.storage import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row = dict[str, Any]
TRACES = 8
"""Maximum number of traces for which costs are estimated."""


@dataclass(frozen=True)
class Discovery:
    """The user types that were found in a table of labels.

    Attributes:
        dataset: the labels.
        types: the types.
        held_out: how well held-out labels are predicted; None if not measured.
        sentences: text of each message, if known.
        answers: the table of questions whose answers are predicted, with the column ``p``, the
            probability of the answer 1; None if there is no such table.
        seconds: duration.
        costs: expected costs of explanations for traces of the hypotheses
            (:func:`~xplain.experiment.explanations.simulate_costs`); None if the types are not
            doubtful.
    """

    dataset: Dataset
    types: UserTypes
    held_out: HeldOut | None
    sentences: dict[str, str]
    answers: pd.DataFrame | None
    seconds: float
    costs: dict[str, Estimate] | None = None

    @property
    def learned(self) -> LearnedTypes:
        """The types with their labelers, for :class:`xplain.Explainer`."""
        return LearnedTypes.of(self.types, self.dataset, self.sentences)

    @property
    def row(self) -> Row:
        """The JSON that the command prints."""
        clustering, names, unseen = self.types.clustering, self.types.names, self.held_out
        pairs = zip(self.dataset.observers, clustering.assignment, strict=True)
        measured = {} if unseen is None else asdict(unseen) | {"verdict": unseen.verdict}
        return {
            **({} if self.accept is None else {"accept": self.accept}),
            "n_types": clustering.n_types,
            "assignment": {observer: names[t] for observer, t in pairs},
            "method": clustering.method,
            "rule": clustering.rule,
            "held_out_log_likelihood": measured.get("types"),
            "held_out": {k: v for k, v in measured.items() if k != "calibration"} or None,
            "seconds": self.seconds,
        }

    @property
    def accept(self) -> dict[str, list[float]] | None:
        """The acceptance of each message, with its 95 % interval; None if it cannot be
        estimated."""
        landing = self.types.landing
        if landing is None or not len(landing.accept):
            return None
        return dict(zip(self.dataset.messages, landing.accept.round(3).tolist(), strict=True))

    @cached_property
    def rows(self) -> list[Row]:
        """For each type: its name, the numbers of its observers and labels, the share of labels 1,
        the confidence of its labeler, and the messages that its people need (None if unknown)."""
        return [self._describe(t) for t in range(self.types.clustering.n_types)]

    def _describe(self, t: int) -> Row:
        clustering, labeler = self.types.clustering, self.types.labelers[t]
        own = self.dataset.of(clustering.members(t))
        row: Row = {
            "name": self.types.names[t],
            "observers": len(clustering.members(t)),
            "labels": len(own),
            "explicable": float(own.label.mean()),
            "confidence": labeler.confidence,
        }
        try:
            if clustering.needs is not None:  # uses all observers' labels, not only this type's
                needed = int(clustering.needs[t])
            else:
                table = labeler.table(self.dataset.features[sorted({*own.transition.tolist()})])
                needed = smallest((table.p[:, :, 0] < 0.5).sum(axis=0), table.relevant[0])
        except TooLargeError:  # no tree, and too many messages to try all sets
            return row | {"needs": None}
        return row | {"needs": [*names_of(needed, self.dataset.messages)]}

    def frame(self) -> pd.DataFrame:
        """Makes a row for each type: the numbers of its observers and labels, and the messages that
        its people need."""
        return pd.DataFrame(self.rows)

    def plot(self) -> dict[str, Figure]:
        """Draws the available results: ``messages``, ``curve``, ``posterior`` and
        ``calibration``."""
        from xplain.report import plots

        clustering, count, figures = self.types.clustering, self.types.clustering.n_types, {}
        if self.dataset.messages:
            figures["messages"] = plots.effects(self.dataset, clustering, self.types.names)
        if clustering.curve is not None and len(clustering.curve) > 1:
            curve = clustering.curve[: max(4 * count, 20)].tolist()
            figures["curve"] = plots.disagreements(curve, count, clustering.rule)
        if clustering.posterior is not None:
            figures["posterior"] = plots.posterior(clustering.posterior, count)
        if self.held_out is not None:
            figures["calibration"] = plots.calibration(self.held_out.calibration)
        return figures

    def save(self, folder: Path) -> None:
        """Writes all files of the command into a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        self.learned.save(folder / "types.npz")
        row, evidence, unseen = self.row, self.types.evidence, self.held_out
        pairs = pd.DataFrame(row.pop("assignment").items(), columns=["observer", "type"])
        pairs.to_csv(folder / "assignment.csv", index=False)
        for name, figure in self.plot().items():
            figure.savefig(folder / f"{name}.png")
        more: Row = {"posterior": self.types.clustering.posterior}
        if evidence is not None:
            nats = dict(zip(("hypotheses", "labels_alone"), evidence.nats, strict=True))
            more["evidence"] = nats | {"verdict": str(evidence)}
        if unseen is not None:
            more["calibration"] = [one._asdict() for one in unseen.calibration]
        more = {key: value for key, value in more.items() if value is not None}
        summary = {**row, "labels": len(self.dataset), "types": self.rows, **more}
        write_text(folder / "summary.json", json.dumps(summary, indent=2) + "\n")
        if self.answers is not None:
            self.answers.to_csv(folder / "predictions.csv", index=False)

    def show(self, folder: Path) -> None:
        """Prints the types and the folder of their files on standard output."""
        console, row, messages = Console(), self.row, self.dataset.messages
        needs = [own["needs"] if messages else None for own in self.rows]
        shown = [
            {
                "type": own["name"],
                "needed messages": "?" if needed is None else ", ".join(needed) or "nothing",
                "observers": str(own["observers"]),
                "labels": str(own["labels"]),
                "explicable": f"{own['explicable']:.1%}",
                "confidence": f"{own['confidence']:.3f}",
            }
            for own, needed in zip(self.rows, needs, strict=True)
        ]
        found = f"{row['n_types']} user types ({row['method']}, {row['rule']})"
        console.print(f"{found}; files in {folder}")
        console.print(table_of(shown, 2).text())
        for message, (rate, low, high) in (self.accept or {}).items():
            console.print(f"acceptance of {message}: {rate:.2f} ({low:.2f} to {high:.2f})")
        if (unseen := self.held_out) is not None:
            figures = {"types": unseen.types, "one type": unseen.one_type}
            figures["question mean"] = unseen.question_mean
            said = ", ".join(f"{key} {-own:.3f}" for key, own in figures.items())
            console.print(f"nats per held-out label: {said}; {unseen.verdict}")
            off = max(abs(one.said - one.ones) for one in unseen.calibration)
            said = f"largest error in a tenth of the held-out labels {off:.3f} (calibration.png)"
            console.print(f"calibration: {said}")
        if self.costs is not None:
            console.print(describe_costs(self.costs))


def discovery(cfg: DictConfig, folder: Path | None) -> Discovery:
    """Finds the types with the configuration of conf/discover.yaml and its overrides.

    Args:
        cfg: the configuration.
        folder: receives all files of the command; None writes no files.

    Raises:
        XplainError: the table or a value cannot be used, or the folder cannot be written.
    """
    began = time.perf_counter()
    if folder is not None:  # refused before any work, and without creating it
        above = next(path for path in (folder.absolute() / "x").parents if path.exists())
        if not above.is_dir() or not os.access(above, os.W_OK):
            raise InputError("output", str(folder), "a folder that can be written")
    run_seed(cfg.seed)
    trainer = instantiate(cfg.labeler)
    finder = instantiate(cfg.clusterer, _partial_=True)(labeler=trainer)
    known = None if cfg.hypotheses is None else Hypotheses.load(cfg.hypotheses)
    messages, like = (cfg.messages, ()) if known is None else (known.messages, known.feature_names)
    dataset = read_table(cfg.data, messages, cfg.features, cfg.ignore, like=like)
    sentences = sentences_of(cfg.sentences, dataset.messages)
    asked = None if cfg.predict is None else read_questions(cfg.predict, dataset)
    types = finder.find(Observations(dataset), cfg.seed)
    unseen = predict_held_out(dataset, finder, trainer, cfg.seed) if cfg.held_out else None
    answers = asked and asked[0].assign(p=predict(dataset, types, asked[1]))
    seconds = time.perf_counter() - began
    found = Discovery(dataset, types, unseen, sentences, answers, seconds)
    if types.doubted is not None and known is not None and known.features is not None:
        begin, traces = Explainer(found.learned).session, [*known.traces()]
        rows = [known.features[own].tolist() for own in traces[:: len(traces) // TRACES + 1]]
        problems = [begin(own).explained.problem for own in rows]
        everything = [found.learned.everything(own) for own in rows]
        found = replace(found, costs=simulate_costs(problems, everything, types.doubted))
    if folder is not None:
        found.save(folder)
    return found


def sentences_of(path: str | None, messages: Sequence[str]) -> dict[str, str]:
    """Reads ``{message: text}`` from a YAML file; empty without a file.

    Raises:
        InputError: the file cannot be read, or contains anything except texts of these messages.
    """
    if path is None:
        return {}
    wanted = "a YAML file with lines 'message: text'"
    try:
        said = OmegaConf.to_container(OmegaConf.load(path))
    except (OSError, ValueError, YAMLError) as error:
        raise InputError("sentences", path, f"{wanted} ({first_line(error)})") from None
    if not isinstance(said, dict) or not all(isinstance(text, str) for text in said.values()):
        raise InputError("sentences", path, wanted)
    return {
        str(one_of("sentences", name, messages, "message")): text for name, text in said.items()
    }


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
    found = observe(domain, users, observers, queries, cfg.seed)
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


def write_questions(cfg: DictConfig) -> tuple[pd.DataFrame, Row]:
    """Writes the questions to ask. Returns their table, and a summary.

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
    said = [
        {name: sentences.get(name, name) for name in names_of(mask, known.messages)}
        for mask in told.tolist()
    ]
    asked = transitions.tolist()
    table = pd.DataFrame(
        {
            "question": range(1, len(asked) + 1),
            "transition": asked,
            "text": [known.phrases[t] if known.phrases else f"transition {t}" for t in asked],
            "image": [images[t] if images else "" for t in asked],
            "messages": [";".join(own) for own in said],
            "told": [" ".join(own.values()) for own in said],
        }
    )
    if known.features is not None:
        table[list(known.feature_names)] = known.features[asked]
    if cfg.save is not None:
        known.save(cfg.save)
    output = Path(cfg.output)
    output.parent.mkdir(parents=True, exist_ok=True)
    write_text(output, table.to_csv(index=False, lineterminator="\n"))
    return table, {
        "output": str(cfg.output),
        "questions": len(table),
        "transitions": known.n_transitions,
        "candidates": len(np.unique(known.classes)),
    }
