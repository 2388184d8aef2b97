"""A sweep's results as one table of episodes, and what the reports say of it.

Nothing here depends on how long something took, on the order in which jobs ended, or on the
launcher: the same jobs give the same bytes.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from xplain.evaluation.metrics import possible
from xplain.evaluation.statistics import Estimate, clustered_mean
from xplain.experiment.results import RESULTS, Results, load_results

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

_SOURCE = (
    "domain",
    "users",
    "observers",
    "queries",
    "labeler",
    "clusterer",
    "points",
    "traces",
    "max_steps",
)
"""What tells settings apart; anything else that is swept tells methods apart."""

_WORDS = {"users.count": "{} types", "users.index": "completion {}"}
"""What people call settings."""


@dataclass(frozen=True)
class TableCell:
    """An estimate over the episodes of one domain, λ and measure."""

    domain: str
    setting: str
    trade_off: float
    measure: str
    estimate: Estimate
    episodes: int


class Summary:
    """What a sweep's finished jobs say.

    Args:
        folder: of the sweep.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.about: dict[str, Any] = json.loads((folder / "sweep.json").read_text("utf-8"))
        self.jobs: list[dict[str, Any]] = self.about["jobs"]
        self.results: list[tuple[dict[str, Any], Results]] = []
        for job in self.jobs:
            own = folder / "jobs" / job["name"]
            if (own / RESULTS).exists():
                self.results.append((job, load_results(own)))

    @property
    def failures(self) -> list[tuple[str, str]]:
        """(job, error) of the failed jobs."""
        found = []
        for job in self.jobs:
            folder = self.folder / "jobs" / job["name"]
            if (folder / "failure.json").exists() and not (folder / "results.json").exists():
                content = json.loads((folder / "failure.json").read_text("utf-8"))
                found.append((job["label"], content["error"]))
        return found

    @property
    def missing(self) -> int:
        """How many jobs have no results."""
        return len(self.jobs) - len(self.results)

    @cached_property
    def episodes(self) -> pd.DataFrame:
        """One row an episode of a job's own solver, the references' costs beside its own."""
        rows = []
        for job, results in self.results:
            costs = {(e.solver, e.trace, e.type): e.cost for e in results.episodes}
            for episode in results.episodes:
                if episode.solver != "solver":
                    continue
                key = (episode.trace, episode.type)
                rows.append(
                    {
                        "domain": results.domain,
                        "setting": setting_of(job["values"]),
                        "method": method_of(job["values"], results.solver),
                        "lambda": results.trade_off,
                        "seed": results.seed,
                        "trace": episode.trace,
                        "type": episode.type,
                        "cost": episode.cost,
                        "oracle": costs.get(("oracle", *key), np.nan),
                        "clairvoyant": costs.get(("clairvoyant", *key), np.nan),
                        "messages": episode.messages,
                        "inexplicable labels": episode.inexplicable_labels,
                        "steps until sure": episode.steps_until_sure,
                    }
                )
        frame = pd.DataFrame(rows)
        if len(frame):
            frame["regret"] = frame["cost"] - frame["oracle"]
            frame["regret to clairvoyant"] = frame["cost"] - frame["clairvoyant"]
        return frame

    @cached_property
    def methods(self) -> list[str]:
        """Names of the methods that were run, those of the paper's columns first."""
        names = set(self.episodes["method"]) if len(self.episodes) else set()
        return sorted(names, key=lambda name: (_rank(name), name))

    @cached_property
    def domains(self) -> list[str]:
        """Names of the domains, in the order of the sweep."""
        return list(dict.fromkeys(self.episodes["domain"])) if len(self.episodes) else []

    def settings(self, domain: str) -> list[str]:
        """Names of a domain's settings, in the order of the sweep."""
        frame = self.episodes
        return list(dict.fromkeys(frame.loc[frame["domain"] == domain, "setting"]))

    @cached_property
    def trade_offs(self) -> list[float]:
        """Every λ that was run, ascending."""
        return sorted(set(self.episodes["lambda"])) if len(self.episodes) else []

    @property
    def seeds(self) -> int:
        """Number of different seeds that were run."""
        return int(self.episodes["seed"].nunique()) if len(self.episodes) else 0

    def estimate(
        self, measure: str, domain: str, trade_off: float, method: str, setting: str | None = None
    ) -> TableCell | None:
        """Mean with interval of a column over a domain's settings (or one); None without data."""
        frame = self._cell(domain, trade_off, method, setting)
        frame = frame[np.isfinite(frame[measure])]
        if not len(frame):
            return None
        name = measure.replace(" ", "_")
        estimate = clustered_mean(frame[measure], self._clusters(frame), possible=possible(name))
        label = "all" if setting is None else setting
        return TableCell(domain, label, trade_off, method, estimate, len(frame))

    def reference(
        self, name: str, domain: str, trade_off: float, setting: str | None = None
    ) -> TableCell | None:
        """The cost of the oracle or the clairvoyant: it is the same in every job of a setting, so
        one method's will do."""
        for method in self.methods:
            cell = self.estimate(name, domain, trade_off, method, setting)
            if cell is not None:
                return replace(cell, measure=name)
        return None

    def oracle(self, domain: str, trade_off: float, setting: str | None = None) -> TableCell | None:
        """The oracle's cost."""
        return self.reference("oracle", domain, trade_off, setting)

    def differences(self) -> Iterator[tuple[str, float, str, str, Estimate]]:
        """(domain, λ, method, other, cost of the method less the other's on the same trace and
        user) for each pair of methods."""
        key = ["setting", "seed", "trace", "type"]
        for domain in self.domains:
            for trade_off in self.trade_offs:
                for other, method in combinations(self.methods, 2):
                    left = self._cell(domain, trade_off, method, None).set_index(key)
                    right = self._cell(domain, trade_off, other, None).set_index(key)
                    both = left.join(right["cost"], rsuffix="_other", how="inner").reset_index()
                    if len(both):
                        paired = both["cost"] - both["cost_other"]
                        estimate = clustered_mean(paired, self._clusters(both))
                        yield domain, trade_off, method, other, estimate

    def job(self, domain: str, trade_off: float, method: str) -> tuple[Path, Results] | None:
        """Folder and results of the first finished job of a cell."""
        for job, results in self.results:
            own = method_of(job["values"], results.solver)
            key = (results.domain, results.trade_off, own)
            if key == (domain, trade_off, method):
                return self.folder / "jobs" / job["name"], results
        return None

    def messages(self, domain: str) -> dict[str, str]:
        """``{message: its sentence}`` of a domain; empty where no job of it has finished."""
        for _, results in self.results:
            if results.domain == domain:
                return dict(results.messages)
        return {}

    def complete(self, domain: str, trade_off: float, method: str) -> bool:
        """Whether all jobs of a cell are there."""
        wanted = got = 0
        finished = {job["name"] for job, _ in self.results}
        for job in self.jobs:
            values = job["values"]
            if (
                values.get("domain", domain) == domain
                and float(values.get("lambda", trade_off)) == trade_off
                and method_of(values, values.get("solver", method)) == method
            ):
                wanted += 1
                got += job["name"] in finished
        return wanted == got

    def by_step(self, name: str, domain: str, trade_off: float, method: str) -> NDArray[np.float64]:
        """Mean at each step over all episodes that last so long."""
        total: NDArray[np.float64] = np.zeros(0)
        count: NDArray[np.float64] = np.zeros(0)
        for job, results in self.results:
            own = method_of(job["values"], results.solver)
            same_place = results.domain == domain and own == method
            if not same_place or results.trade_off != trade_off:
                continue
            series = np.array(results.steps[name])
            weight = np.array(results.steps["episodes"])[: len(series)]
            longest = max(len(total), len(series))
            total = np.pad(total, (0, longest - len(total)))
            count = np.pad(count, (0, longest - len(count)))
            total[: len(series)] += series * weight
            count[: len(series)] += weight
        mean: NDArray[np.float64] = total / count
        return mean

    def elbows(self, domain: str) -> dict[str, tuple[NDArray[np.float64], Counter[int]]]:
        """``{setting: (mean curve over seeds, how often each k was chosen)}``."""
        curves: dict[str, dict[int, NDArray[np.float64]]] = {}
        chosen: dict[str, dict[int, int]] = {}
        for job, results in self.results:
            curve = results.elbow.disagreements
            if results.domain == domain and curve:
                name, seed = setting_of(job["values"]), results.seed
                curves.setdefault(name, {})[seed] = np.array(curve, dtype=float)
                chosen.setdefault(name, {})[seed] = len(results.types.found)
        means = {}
        for name, by_seed in curves.items():
            shortest = min(map(len, by_seed.values()))
            mean = np.mean([curve[:shortest] for curve in by_seed.values()], axis=0)
            means[name] = (mean, Counter(chosen[name].values()))
        return means

    def learning(self) -> dict[tuple[str, str], dict[str, float]]:
        """``{(domain, setting): figure: mean over seeds}`` of the learning stage."""
        found: dict[tuple[str, str], dict[int, Mapping[str, float]]] = {}
        for job, results in self.results:
            key = (results.domain, setting_of(job["values"]))
            found.setdefault(key, {})[results.seed] = results.learning
        return {
            key: {
                name: float(np.mean([figures[name] for figures in by_seed.values()]))
                for name in next(iter(by_seed.values()))
                if all(name in figures for figures in by_seed.values())
            }
            for key, by_seed in found.items()
        }

    def types_found(self) -> dict[str, list[float]]:
        """By domain, the adjusted Rand index of each data set: one a setting and seed."""
        found: dict[tuple[str, str, int], float] = {}
        for job, results in self.results:
            if "adjusted_rand_index" in results.learning:
                key = (results.domain, setting_of(job["values"]), results.seed)
                found[key] = results.learning["adjusted_rand_index"]
        domains: dict[str, list[float]] = {}
        for (domain, *_), index in found.items():
            domains.setdefault(domain, []).append(index)
        return domains

    def curves(self) -> list[tuple[str, float, float]]:
        """(name, λ, mean) of complete cells, for charts."""
        points = []
        for domain in self.domains:
            for trade_off in self.trade_offs:
                for method in self.methods:
                    if not self.complete(domain, trade_off, method):
                        continue
                    for measure in ("regret", "messages", "inexplicable labels"):
                        cell = self.estimate(measure, domain, trade_off, method)
                        if cell is not None:
                            name = _metric(f"{measure}/{domain}/{method}")
                            points.append((name, trade_off, cell.estimate.mean))
                oracle = self.oracle(domain, trade_off)
                if oracle and self.complete(domain, trade_off, self.methods[0]):
                    points.append(
                        (_metric(f"oracle cost/{domain}"), trade_off, oracle.estimate.mean)
                    )
        return points

    def _cell(
        self, domain: str, trade_off: float, method: str, setting: str | None
    ) -> pd.DataFrame:
        frame = self.episodes
        chosen = (
            (frame["domain"] == domain)
            & (frame["lambda"] == trade_off)
            & (frame["method"] == method)
        )
        if setting is not None:
            chosen &= frame["setting"] == setting
        return frame[chosen]

    def _clusters(self, frame: pd.DataFrame) -> pd.Series[int]:
        """What was sampled: seeds, each with its own data and traces; with one seed, traces.
        Settings share seeds and traces, so they make no clusters of their own."""
        return frame["seed"] if self.seeds > 1 else frame["trace"]


def setting_of(values: dict[str, str]) -> str:
    """``3 types``, ``noise=0.1``; empty where settings are domains alone."""
    words = []
    for key, value in values.items():
        group, _, last = key.rpartition(".")
        if key.partition(".")[0] not in _SOURCE or key == "domain":
            continue
        words.append(_WORDS.get(key, f"{last}=" + "{}").format(value) if group else value)
    return " ".join(words)


def method_of(values: dict[str, str], solver: str) -> str:
    """``pomcp``, or ``pomcp simulations=500`` where that is swept as well."""
    own = [
        f"{key.rpartition('.')[2]}={value}"
        for key, value in values.items()
        if key.partition(".")[0] not in _SOURCE and key not in ("solver", "lambda", "seed")
    ]
    return " ".join([solver, *own])


def _metric(name: str) -> str:
    """The text without the characters that MLflow refuses in names."""
    return re.sub(r"[^\w./ -]", " ", name).replace(" ", "_")


def _rank(method: str) -> int:
    name = method.partition(" ")[0]
    return ORDER.index(name) if name in ORDER else len(ORDER)
