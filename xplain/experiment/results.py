"""The files of a run. MLflow and reports are made from them.

A run's folder contains ``results.json`` (:class:`Results`: figures, configuration, code version),
``episodes.jsonl`` (one line for each episode, step by step), ``config.yaml`` (resolved) and
pictures.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xplain.domains.base import Scene
from xplain.experiment.pipeline import Case, PreparedData
from xplain.explanation.asking import Question, make_question
from xplain.explanation.message_sets import names_of
from xplain.interaction.episode import Episode
from xplain.interaction.metrics import Record, by_step, summarise
from xplain.storage import decode, encode, write_text

RESULTS = "results.json"
EPISODES = "episodes.jsonl"
SCHEMA = 1
"""Version of ``results.json``; files of another version are not read."""


@dataclass(frozen=True)
class Figure:
    """A mean over episodes.

    Attributes:
        mean: the mean.
        low, high: ends of its 95 % interval; None if there is no interval.
    """

    mean: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class ElbowFigures:
    """The choice of the number of types.

    Attributes:
        rule: the rule that chose it.
        disagreements: disagreements with k = 1 … K types.
    """

    rule: str
    disagreements: tuple[float, ...]


@dataclass(frozen=True)
class TypeNames:
    """The user types of a run.

    Attributes:
        true: M names of the true types.
        found: N names of the learned types.
        behave_alike: M numbers, one for each true type; types with the same number behave alike.
        matched_true_type: N numbers, one for each learned type: the number in ``behave_alike`` that
            most observers of the learned type have; −1 if unknown.
    """

    true: tuple[str, ...]
    found: tuple[str, ...]
    behave_alike: tuple[int, ...]
    matched_true_type: tuple[int, ...]


@dataclass(frozen=True)
class EpisodeFigures:
    """The figures of one episode; no cost is discounted.

    Attributes:
        solver: name of the solver in the records.
        trace: index of the trace.
        type: name of the user's true type.
        cost: λ · communication + inexplicability + questions_cost.
        communication: sum of the costs C_e of all messages given, without λ.
        inexplicability: cost of all labels 0 that the user thinks.
        messages: number of messages given, including repeated ones.
        inexplicable_labels: number of labels 0 that the user thinks, over all steps.
        steps_until_sure: number of steps until the belief in the user's true type first exceeds
            SURE (:mod:`xplain.interaction.metrics`); m + 1 on a trace of m transitions if it never
            does.
        questions: number of questions asked.
        questions_cost: cost of these questions, κ for each.
        fit: P(the user has a found type and the assumed habits) at the end.
    """

    solver: str
    trace: int
    type: str
    cost: float
    communication: float
    inexplicability: float
    messages: int
    inexplicable_labels: int
    steps_until_sure: int
    questions: int = 0
    questions_cost: float = 0.0
    fit: float = 1.0


@dataclass(frozen=True)
class Provenance:
    """The origin of a run's numbers.

    Attributes:
        name: readable name.
        fingerprint: digest of everything that the numbers depend on; the run's folder below
            ``outputs/results`` has this name.
        xplain, code: version of the package, and digest of its sources.
        git: the commit, and whether the checkout has uncommitted changes; empty without a checkout.
        worker: host and process id of the process that computed the run.
        started: seconds since 1970.
        seconds: duration of each stage, by name.
        choices: the components by group.
        config: the resolved configuration.
    """

    name: str
    fingerprint: str
    xplain: str
    code: str
    git: Mapping[str, str]
    worker: str
    started: float
    seconds: Mapping[str, float]
    choices: Mapping[str, str]
    config: Mapping[str, Any]


@dataclass(frozen=True)
class Results(Provenance):
    """The content of ``results.json``.

    Attributes:
        metrics: figures of the chosen solver, by name
            (:func:`xplain.interaction.metrics.summarise`).
        bounds: certified figures of the explanation problems, by name.
        certificates: ``not asked for``, ``made`` or ``failed``.
        learning: figures of the learning stage, by name.
        elbow: the choice of the number of types.
        messages: sentences by name.
        scene: the map, if there is one.
        types: true and learned types.
        steps: means by step (:func:`xplain.interaction.metrics.by_step`).
        episodes: episodes of the solver and of its references.
        schema: version of the file.
    """

    metrics: Mapping[str, Figure]
    bounds: Mapping[str, float]
    certificates: str
    learning: Mapping[str, float]
    elbow: ElbowFigures
    messages: Mapping[str, str]
    scene: Scene | None
    types: TypeNames
    steps: Mapping[str, tuple[float, ...]]
    episodes: tuple[EpisodeFigures, ...]
    schema: int = SCHEMA

    @property
    def domain(self) -> str:
        """Name of the domain (:func:`domain_name`)."""
        return domain_name(self.choices, self.config)

    @property
    def solver(self) -> str:
        """Name of the chosen file in conf/solver/."""
        return self.choices["solver"]

    @property
    def trade_off(self) -> float:
        """λ, the cost of a message in units of an inexplicable label."""
        return float(self.config["lambda"])

    @property
    def seed(self) -> int:
        """Seed of every random stream."""
        return int(self.config["seed"])

    @property
    def regret(self) -> float | None:
        """Mean regret to the oracle; None without an oracle."""
        return self.metrics["regret"].mean if "regret" in self.metrics else None


def domain_name(choices: Mapping[str, str], config: Mapping[str, Any]) -> str:
    """Returns the domain's name in the configuration (``domain.name``), or otherwise the name of
    the chosen file in conf/domain/."""
    return str(config.get("domain", {}).get("name") or choices["domain"])


def results_of(prepared: PreparedData, records: list[Record], provenance: Provenance) -> Results:
    """Makes the results of a run, without certificates.

    Args:
        prepared, records: from the run.
        provenance: origin of the run.
    """
    return Results(
        **vars(provenance),
        metrics={  # JSON has no infinite numbers and no NaN
            name: Figure(own.mean, *(x if math.isfinite(x) else None for x in (own.low, own.high)))
            for name, own in summarise(records).items()
        },
        bounds={},
        certificates="not asked for",
        learning={k: v for k, v in prepared.learning.items() if math.isfinite(v)},
        elbow=ElbowFigures(prepared.rule, tuple(prepared.curve.tolist())),
        messages=dict(zip(prepared.messages, prepared.sentences, strict=True)),
        scene=prepared.scene,
        types=TypeNames(
            true=prepared.types,
            found=prepared.learned_types,
            behave_alike=tuple(prepared.distinct.tolist()),
            matched_true_type=tuple(prepared.matched_true_type.tolist()),
        ),
        steps={name: tuple(values.tolist()) for name, values in by_step(records).items()},
        episodes=tuple(
            EpisodeFigures(
                solver=record.solver,
                trace=record.trace,
                type=prepared.types[record.user_type],
                cost=record.episode.cost,
                communication=record.episode.communication,
                inexplicability=record.episode.inexplicability,
                messages=record.episode.n_messages,
                inexplicable_labels=record.episode.n_inexplicable,
                steps_until_sure=record.steps_until_sure,
                questions=record.episode.n_questions,
                questions_cost=record.episode.asking,
                fit=record.episode.fit,
            )
            for record in records
        ),
    )


def episode_lines(prepared: PreparedData, records: list[Record]) -> str:
    """Makes the content of ``episodes.jsonl``: questions, messages, answers and beliefs at each
    step."""
    lines = []
    for record in records:
        episode, case = record.episode, prepared.cases[record.trace]
        beliefs, labels = episode.beliefs.round(12).tolist(), episode.labels.tolist()
        steps = [
            {
                **_list_questions(episode, case, k),
                "messages": names_of(given, prepared.messages),
                "labels": labels[k][: k + 1],
                "belief": beliefs[k + 1],
            }
            for k, given in enumerate(episode.messages.tolist())
        ]
        line = {
            "solver": record.solver,
            "trace": record.trace,
            "type": prepared.types[record.user_type],
            "cost": episode.cost,
            "transitions": list(case.phrases),
            "positions": [list(cell) for cell in case.positions],
            **({"changes": case.changes} if case.changes else {}),
            "prior": episode.beliefs[0].tolist(),
            "steps": steps,
        }
        lines.append(json.dumps(line))
    return "\n".join(lines) + "\n"


def _list_questions(episode: Episode, case: Case, step: int) -> dict[str, Any]:
    """Lists the ``questions`` before a step's messages; nothing if no questions are possible."""
    if case.questions is None:
        return {}
    own = episode.questions[episode.questions[:, 0] == step, 1:].tolist()
    texts, right = case.questions.texts, case.questions.right.tolist()
    return {
        "questions": [
            encode_question(make_question(q, texts[q], right[q]), answer) for q, answer in own
        ]
    }


def encode_question(question: Question, answer: int) -> dict[str, Any]:
    """Converts an answered question to plain JSON."""
    reply = next(words for words, value in question.replies if value == answer)
    return {"text": question.text, "about": question.about, "answer": answer, "reply": reply}


def save_results(folder: Path, results: Results) -> None:
    """Writes ``results.json``, the last of all files of a run: its presence means that the run is
    complete."""
    # On one line, because Python writes indented JSON slowly.
    write_text(folder / RESULTS, json.dumps(encode(results), allow_nan=False) + "\n")


def load_results(folder: Path) -> Results:
    """Reads ``results.json``.

    Raises:
        OSError, ValueError: the file is missing, or has another version.
    """
    content = json.loads((folder / RESULTS).read_text(encoding="utf-8"))
    try:
        if content["schema"] != SCHEMA:
            raise ValueError(f"{folder / RESULTS} has schema {content['schema']}, not {SCHEMA}")
        results: Results = decode(Results, content)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{folder / RESULTS} contains no results ({error!r})") from error
    return results


def find_finished(address: Path) -> Results | None:
    """Reads the results in a folder that has a fingerprint as its name. Returns None if the results
    are incomplete, have another fingerprint, or lack certificates because these failed."""
    try:
        results = load_results(address)
    except (OSError, ValueError):
        return None
    whole = results.fingerprint == address.name and results.certificates != "failed"
    return results if whole else None
