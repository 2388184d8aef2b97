"""A sweep's results as one table of episodes, and what the reports say of it.

Nothing here depends on how long something took, on the order in which jobs ended, or on the
launcher: the same jobs give the same bytes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from xplain.errors import InputError
from xplain.experiment.results import RESULTS, Results, load_results
from xplain.interaction.metrics import possible
from xplain.interaction.statistics import Estimate, clustered_mean
from xplain.report.measure import (
    NO_REFERENCE,
    TITLES,
    Measure,
    is_setting,
    measure_of,
    setting_of,
    warning_about_oracle,
)

ORDER = (
    "qmdp",
    "pomcp_paper",
    "pomcp",
    "certified",
    "qhr",
    "baseline",
    "conformant",
    "silent",
    "say_all",
)
"""The paper's columns come first, others after them by name."""

Value = float | str
"""Of a swept key: a number where all its values are; "" where a setting lacks the key."""

_OWN = {"lambda": "trade_off", "solver": "solver", "domain": "domain"}
"""Keys whose values a job's results say."""

SWEEP = "sweep.json"


def load_sweep(folder: Path) -> dict[str, Any]:
    """What a sweep is: its command, its ``jobs``, how it is shown.

    Raises:
        OSError: there is no such file.
        InputError: it is damaged.
    """
    path = folder / SWEEP
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if {"command", "jobs", "results"} <= content.keys() and isinstance(content["jobs"], list):
            return content
    except (ValueError, AttributeError):
        pass
    raise InputError("sweep", str(path), "is damaged; the sweep's own command writes it anew")


class Summary:
    """What a sweep's finished jobs say.

    Args:
        folder: of the sweep.
        measure: what its jobs are compared by; None takes what is fair
            (:func:`xplain.report.measure.measure_of`).
    """

    def __init__(self, folder: Path, measure: str | None = None) -> None:
        self.folder, self._asked = folder, measure
        self.about = load_sweep(folder)
        self.jobs: list[dict[str, Any]] = self.about["jobs"]
        self.results: list[tuple[dict[str, Any], Results]] = [
            (job, load_results(self.address(job)))
            for job in self.jobs
            if (self.address(job) / RESULTS).exists()
        ]

    def address(self, job: Mapping[str, Any]) -> Path:
        """Folder of a job's result."""
        return self.folder / str(self.about["results"]) / str(job["fingerprint"])

    @property
    def failures(self) -> list[tuple[str, str]]:
        """(job, error) of the failed jobs."""
        left = [job for job in self.jobs if job["fingerprint"] not in self._finished]
        own = self.folder / "jobs"
        paths = [(job["label"], own / job["fingerprint"] / "failure.json") for job in left]
        return [
            (label, json.loads(path.read_text("utf-8"))["error"])
            for label, path in paths
            if path.exists()
        ]

    @cached_property
    def _finished(self) -> set[str]:
        return {job["fingerprint"] for job, _ in self.results}

    @property
    def missing(self) -> int:
        """How many jobs have no results."""
        return len(self.jobs) - len(self.results)

    @cached_property
    def report(self) -> str | None:
        """``table1`` where the sweep's file asks for it, and nothing was swept beside what that
        table has rows and columns for."""
        settings = filter(is_setting, self.pool)
        others = set(self.keys) - {"domain", "solver", "lambda", *settings}
        return None if others else self.about.get("report")

    @property
    def pool(self) -> tuple[str, ...]:
        """Swept keys that the sweep's file asks to average over."""
        return tuple(key for key in self.about.get("pool", ()) if key in self.keys)

    @cached_property
    def keys(self) -> list[str]:
        """The swept keys, in the order of the jobs' names. Seeds are replicates, not among them."""
        return [
            key
            for key in dict.fromkeys(k for job in self.jobs for k in job["values"])
            if key != "seed"
        ]

    def values(self, key: str) -> list[Value]:
        """Values of a swept key, ``solver`` or ``lambda`` among the finished jobs: numbers
        ascending, solvers in the paper's order, other text as it was swept."""
        found: list[Value] = list(dict.fromkeys(self._value(key, *one) for one in self.results))
        if key == "solver":
            return sorted(found, key=lambda name: (rank(str(name)), name))
        if all(isinstance(value, float) or value == "" for value in found):
            return sorted(found, key=lambda value: (value != "", value))
        return found

    def is_number(self, key: str) -> bool:
        """Whether a key's values are numbers, more than one."""
        return sum(isinstance(value, float) for value in self.values(key)) > 1

    def values_of(self, job: dict[str, Any], results: Results) -> dict[str, Value]:
        """The swept values of a job; those of ``solver`` and ``lambda`` always."""
        keys = dict.fromkeys((*self.keys, "solver", "lambda"))
        return {key: self._value(key, job, results) for key in keys}

    def _value(self, key: str, job: dict[str, Any], results: Results) -> Value:
        if key in _OWN:
            return getattr(results, _OWN[key])
        text = job["values"].get(key, "")
        return float(text) if text and key in self._numbers else text

    @cached_property
    def _numbers(self) -> set[str]:
        """Swept keys all of whose values are numbers."""
        return {
            key
            for key in self.keys
            if all(is_number(job["values"].get(key, "0")) for job in self.jobs)
        }

    @cached_property
    def episodes(self) -> pd.DataFrame:
        """One row an episode of a job's own solver, the references' costs beside its own, and the
        swept keys by their full names."""
        rows = []
        for job, results in self.results:
            swept = self.values_of(job, results)
            costs = {(e.solver, e.trace, e.type): e.cost for e in results.episodes}
            for episode in results.episodes:
                if episode.solver != "solver":
                    continue
                key = (episode.trace, episode.type)
                rows.append(
                    {
                        **swept,
                        "domain": results.domain,
                        "setting": setting_of(job["values"]),
                        "lambda": results.trade_off,
                        "seed": results.seed,
                        "trace": episode.trace,
                        "type": episode.type,
                        "cost": episode.cost,
                        "oracle": costs.get(("oracle", *key), np.nan),
                        "clairvoyant": costs.get(("clairvoyant", *key), np.nan),
                        "true labels": costs.get(("true_labels", *key), np.nan),
                        "messages": episode.messages,
                        "inexplicable labels": episode.inexplicable_labels,
                        "questions": episode.questions,
                    }
                )
        frame = pd.DataFrame(rows)
        if len(frame):
            frame["regret"] = frame["cost"] - frame["oracle"]
            frame["above_floor"] = frame["cost"] - frame["clairvoyant"]
        return frame

    @cached_property
    def counted(self) -> tuple[str, ...]:
        """What costs are made of, as columns of the episodes."""
        asks = len(self.episodes) and self.episodes["questions"].any()
        return ("messages", "inexplicable labels", *(("questions",) if asks else ()))

    @cached_property
    def measure(self) -> Measure:
        """What its jobs are compared by."""
        return measure_of(self.episodes, self.keys, self._asked)

    @cached_property
    def warning(self) -> str:
        """What is to be known of the oracle whose labelers err most."""
        every = [results.learning for _, results in self.results]
        return warning_about_oracle(min(every, key=lambda own: own.get("fresh_accuracy", 1.0)))

    def title(self, measure: str) -> str:
        """A measure for people, marked where it is taken to an oracle that is no reference."""
        marked = measure in ("regret", "oracle") and self.warning
        return TITLES[measure] + (f" {NO_REFERENCE}" if marked else "")

    @cached_property
    def domains(self) -> list[str]:
        """Names of the domains, in the order of the sweep."""
        return list(dict.fromkeys(self.episodes["domain"])) if len(self.episodes) else []

    @cached_property
    def settings(self) -> dict[str, list[str]]:
        """Names of each domain's settings, in the order of the sweep."""
        by_domain: Any = self.episodes.groupby("domain", sort=False)["setting"]
        return {domain: list(dict.fromkeys(names)) for domain, names in by_domain}

    @cached_property
    def seeds(self) -> int:
        """Number of different seeds that were run."""
        return int(self.episodes["seed"].nunique()) if len(self.episodes) else 0

    @property
    def unit(self) -> str:
        """What intervals are over."""
        return "seeds" if self.seeds > 1 else "traces"

    @property
    def told_missing(self) -> str:
        """A sentence, with a blank before it, where jobs are missing."""
        return f" {self.missing} of {len(self.jobs)} jobs are missing." if self.missing else ""

    def reference(self, frame: pd.DataFrame, name: str) -> pd.DataFrame:
        """The episodes of a frame by which to know what the oracle or the clairvoyant costs: it is
        the same in every job of a setting, so those of one solver will do."""
        known = frame.dropna(subset=[name])
        solvers = self.values("solver")
        first = min(set(known["solver"]), key=solvers.index, default="")
        return known[known["solver"] == first]

    def complete(self, values: Mapping[str, Value]) -> bool:
        """Whether all jobs of these values (of the finished ones, and as planned) are there."""
        return all(
            job["fingerprint"] in self._finished
            for job in self.jobs
            if all(self._planned(key, job) in (None, value) for key, value in values.items())
        )

    def _planned(self, key: str, job: dict[str, Any]) -> Value | None:
        """A job's value of a key; None where the sweep does not say."""
        text = job["values"].get(key)
        if text is None:
            return "" if key in self.keys else None
        if key == "domain":
            return str(job["values"].get("domain.name") or self._named.get(text, text))
        return float(text) if key in self._numbers else str(text)

    @cached_property
    def _named(self) -> dict[str, str]:
        """What the domains of the finished jobs are called, by what was chosen."""
        return {results.choices["domain"]: results.domain for _, results in self.results}

    def estimate(self, frame: pd.DataFrame, measure: str) -> Estimate | None:
        """:meth:`mean` over the episodes that have the measure; None where none has."""
        known = frame.dropna(subset=[measure])
        return self.mean(known, measure) if len(known) else None

    def mean(self, frame: pd.DataFrame, measure: str) -> Estimate:
        """Mean of a column of episodes, with its interval, cut where the mean cannot be."""
        values = possible(measure.replace(" ", "_"))
        return clustered_mean(frame[measure], self.clusters(frame), possible=values)

    def clusters(self, frame: pd.DataFrame) -> pd.Series[int]:
        """What was sampled: seeds, each with its own data and traces; with one seed, traces.
        Settings share seeds and traces, so they make no clusters of their own."""
        return frame["seed"] if self.seeds > 1 else frame["trace"]


def is_number(text: str) -> bool:
    """Whether the text of a swept value is a finite number."""
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def rank(solver: str) -> int:
    """Place of a solver's column: the paper's first, others after them."""
    return ORDER.index(solver) if solver in ORDER else len(ORDER)
