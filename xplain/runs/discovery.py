"""Finds the user types in people's labels, for the command ``discover`` and for Python."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table
from yaml import YAMLError

from xplain.domains.users.hypotheses import Hypotheses
from xplain.errors import InputError, TooLargeError, one_of
from xplain.explanation.message_sets import names_of
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.label_file import read_questions, read_table
from xplain.learning.data.observers import Observations
from xplain.learning.paper import smallest
from xplain.learning.prediction import HeldOut, predict, predict_held_out
from xplain.learning.saved import LearnedTypes
from xplain.learning.user_types import UserTypes
from xplain.randomness import run_seed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row = dict[str, Any]


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
    """

    dataset: Dataset
    types: UserTypes
    held_out: HeldOut | None
    sentences: dict[str, str]
    answers: pd.DataFrame | None
    seconds: float

    @property
    def learned(self) -> LearnedTypes:
        """The types with their labelers, for :class:`xplain.Explainer`."""
        return LearnedTypes.of(self.types, self.dataset, self.sentences)

    @property
    def row(self) -> Row:
        """The JSON that the command prints."""
        clustering, names = self.types.clustering, self.types.names
        pairs = zip(self.dataset.observers, clustering.assignment, strict=True)
        unseen = self.held_out
        told = None if unseen is None else asdict(unseen) | {"verdict": unseen.verdict}
        if told is not None:
            del told["calibration"]
        about = {} if self.accept is None else {"accept": self.accept}
        return about | {
            "n_types": clustering.n_types,
            "assignment": {observer: names[t] for observer, t in pairs},
            "method": clustering.method,
            "rule": clustering.rule,
            "held_out_log_likelihood": None if unseen is None else unseen.types,
            "held_out": told,
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

    def frame(self) -> pd.DataFrame:
        """Makes a row for each type: the numbers of its observers and labels, and the messages that
        its people need."""
        return pd.DataFrame(_summarise(self.dataset, self.types))

    def plot(self) -> dict[str, Figure]:
        """Draws the available results: ``messages``, ``curve``, ``posterior`` and
        ``calibration``."""
        from xplain.report import plots

        clustering, figures = self.types.clustering, {}
        if self.dataset.messages:
            names = self.types.names
            figures["messages"] = plots.effects(self.dataset, clustering, names)
        if clustering.curve is not None and len(clustering.curve) > 1:
            curve = clustering.curve[: max(4 * clustering.n_types, 20)].tolist()
            figures["curve"] = plots.disagreements(curve, clustering.n_types, clustering.rule)
        if clustering.posterior is not None:
            drawn = plots.posterior(clustering.posterior, clustering.n_types)
            figures["posterior"] = drawn
        if self.held_out is not None:
            figures["calibration"] = plots.calibration(self.held_out.calibration)
        return figures

    def save(self, folder: Path) -> None:
        """Writes all files of the command into a folder."""
        row, clustering = self.row, self.types.clustering
        folder.mkdir(parents=True, exist_ok=True)
        self.learned.save(folder / "types.npz")
        pairs = pd.DataFrame(row["assignment"].items(), columns=["observer", "type"])
        pairs.to_csv(folder / "assignment.csv", index=False)
        for name, figure in self.plot().items():
            figure.savefig(folder / f"{name}.png")
        summary = {key: value for key, value in row.items() if key != "assignment"}
        known = _summarise(self.dataset, self.types)
        summary |= {"labels": len(self.dataset), "types": known}
        if clustering.posterior is not None:
            summary["posterior"] = clustering.posterior
        if self.types.evidence is not None:
            hypotheses, labels = self.types.evidence.nats
            summary["evidence"] = {"hypotheses": hypotheses, "labels_alone": labels}
            summary["evidence"] |= {"verdict": str(self.types.evidence)}
        if self.held_out is not None:
            summary["calibration"] = [one._asdict() for one in self.held_out.calibration]
        text = json.dumps(summary, indent=2)
        (folder / "summary.json").write_text(text + "\n", encoding="utf-8")
        if self.answers is not None:
            self.answers.to_csv(folder / "predictions.csv", index=False)

    def _repr_html_(self) -> str:
        clustering = self.types.clustering
        said = f"{clustering.n_types} user types ({clustering.method}, {clustering.rule})"
        return f"<p>{said}</p>{self.frame().round(3).to_html(index=False, border=0)}"

    def show(self, folder: Path) -> None:
        """Prints the types and the folder of their files on standard output."""
        table = Table("type", "observers", "labels", "explicable", "confidence", "needed messages")
        for one in _summarise(self.dataset, self.types):
            needs = one["needs"] if self.dataset.messages else None
            table.add_row(
                one["name"],
                str(one["observers"]),
                str(one["labels"]),
                f"{one['explicable']:.1%}",
                f"{one['confidence']:.3f}",
                "?" if needs is None else ", ".join(needs) or "nothing",
            )
        console, row = Console(), self.row
        found = f"{row['n_types']} user types ({row['method']}, {row['rule']})"
        console.print(f"{found}; files in {folder}")
        console.print(table)
        for message, (rate, low, high) in (self.accept or {}).items():
            console.print(f"acceptance of {message}: {rate:.2f} ({low:.2f} to {high:.2f})")
        if self.held_out is not None:
            figures = {key: row["held_out"][key] for key in ("types", "one_type", "question_mean")}
            said = ", ".join(f"{key.replace('_', ' ')} {-own:.3f}" for key, own in figures.items())
            console.print(f"nats per held-out label: {said}; {row['held_out']['verdict']}")
            off = max(abs(one.said - one.ones) for one in self.held_out.calibration)
            said = f"largest error in a tenth of the held-out labels {off:.3f} (calibration.png)"
            console.print(f"calibration: {said}")


def discovery(cfg: DictConfig) -> Discovery:
    """Finds the types with the configuration of conf/discover.yaml and its overrides.

    Raises:
        XplainError: the table or a value cannot be used.
    """
    began = time.perf_counter()
    run_seed(cfg.seed)
    trainer = instantiate(cfg.labeler)
    finder = instantiate(cfg.clusterer, _partial_=True)(labeler=trainer)
    if cfg.hypotheses is None:
        dataset = read_table(cfg.data, cfg.messages, cfg.features, cfg.ignore)
    else:
        known = Hypotheses.load(cfg.hypotheses)
        like = known.feature_names
        dataset = read_table(cfg.data, known.messages, cfg.features, cfg.ignore, like=like)
    sentences = sentences_of(cfg.sentences, dataset.messages)
    asked = None if cfg.predict is None else read_questions(cfg.predict, dataset)
    types = finder.find(Observations(dataset), cfg.seed)
    unseen = predict_held_out(dataset, finder, trainer, cfg.seed) if cfg.held_out else None
    answers = None
    if asked is not None:
        table, questions = asked
        answers = table.assign(p=predict(dataset, types, questions))
    return Discovery(dataset, types, unseen, sentences, answers, time.perf_counter() - began)


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
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError("sentences", path, f"{wanted} ({reason})") from None
    if not isinstance(said, dict) or not all(isinstance(text, str) for text in said.values()):
        raise InputError("sentences", path, wanted)
    return {
        str(one_of("sentences", name, messages, "message")): text for name, text in said.items()
    }


def require_writable(folder: Path) -> None:
    """Refuses a folder that cannot be written, before any work is done and without creating it.

    Raises:
        InputError: the folder cannot be written.
    """
    above = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise InputError("output", str(folder), "a folder that can be written")


def _summarise(dataset: Dataset, types: UserTypes) -> list[Row]:
    """Makes a row for each type: its observers, its labels and its needed messages."""

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
            if known is not None:  # uses all observers' labels, not only this type's
                needed = int(known[t])
            else:
                table = labeler.table(labelled)
                needed = smallest((table.p[:, :, 0] < 0.5).sum(axis=0), table.relevant[0])
            row["needs"] = list(names_of(needed, dataset.messages))
        except TooLargeError:  # no tree, and too many messages to try all sets
            row["needs"] = None
        rows.append(row)
    return rows
