"""A sweep's results as one table of episodes, and the measure that compares its jobs.

Ways to solve the same problem are ordered by their costs on the same traces and users. A regret
gives the same order only if all jobs have the same oracle. Oracles differ if jobs learn labelers
from other labels or with other methods.

Nothing here depends on the duration of a job, on the order in which jobs ended, or on the launcher:
the same jobs give the same bytes.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from xplain.errors import one_of
from xplain.experiment.cache import SOURCE
from xplain.experiment.results import EpisodeFigures, Results, load_results
from xplain.report.folder import ListedJob, SweepFolder

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
"""Order of the solvers' columns: the paper's solvers come first. Other solvers follow by name."""

Value = float | str
"""Value of a swept key: a number if all its values are numbers; "" for a job that lacks the key."""

PROBLEM = (
    "domain",
    "users",
    "explainee",
    "lambda",
    "traces",
    "max_steps",
    "message_cost",
    "inexplicability_cost",
    "ask.cost",
)
"""Keys that define the traces, the users and the costs. Costs are never compared between different
values of these keys."""

CONDITIONS = (*PROBLEM, "observers", "queries", "points")
"""Keys that define the problem. All other keys choose the method, so one value can be better than
another."""

REFERENCES = {"regret": "oracle", "above_floor": "clairvoyant", "cost": None}
"""Measures by their names in keys, with the reference whose cost is subtracted."""

TITLES = {
    "regret": "regret",
    "above_floor": "cost above the clairvoyant's",
    "cost": "cost",
    "oracle": "oracle's cost",
    "clairvoyant": "clairvoyant's cost",
    "messages": "messages",
    "inexplicable_labels": "inexplicable labels",
    "questions": "questions",
}
"""Columns of the table of episodes, with their titles for people."""

NEGATIVE = (
    "A regret below 0 is no error. The oracle knows the type, but plans with learned labels. If "
    "learned labels are wrong, the oracle can cost more than a solver that does not know the type."
)

RIGHT = 0.98
"""Minimum share of new labels that labelers must predict correctly. Below this share the oracle's
cost is no reference, because the paper's oracle has right labels."""

NO_REFERENCE = "†"
"""Mark of an oracle's cost that is no reference, and of regrets to this oracle."""

_WHY = {
    "regret": "Regret is cost minus the oracle's cost on the same trace and user.",
    "above_floor": "The clairvoyant knows the true labels: nothing can cost less.",
    "cost": "",
}

_UNFAIR = {
    "regret": "Regrets are not compared, because jobs have different oracles: each job learns the "
    "labelers of its oracle.",
    "above_floor": "The clairvoyant's costs differ between jobs or are not known.",
}

_SOURCE = {*SOURCE, "points"} - {"seed"}
"""Keys that decide data, types and traces."""


def warning_about_oracle(learning: Mapping[str, float], regret: float | None) -> str:
    """Returns up to two warnings: the oracle's labelers are too often wrong for a comparison with
    the oracle, and the regret is below 0. "" if neither is true.

    Args:
        learning: figures of the learning stage; for several jobs, the smallest figures.
        regret: the mean regret; for several jobs, the smallest; None if unknown.
    """
    share = learning.get("fresh_accuracy", 1.0)
    no_reference = (
        f"{NO_REFERENCE} The oracle is no reference: its labelers are right on less than "
        f"{RIGHT:.0%} of fresh labels, on {share:.1%} at worst. Compare costs with the "
        "clairvoyant's instead."
    )
    said = {NEGATIVE: regret is not None and regret < 0, no_reference: share < RIGHT}
    return " ".join(text for text, is_true in said.items() if is_true)


@dataclass(frozen=True)
class Measure:
    """The figure that compares a sweep's jobs.

    Attributes:
        name: ``regret``, ``above_floor`` (cost minus the clairvoyant's cost) or ``cost``.
        fair: True if ordering the ways to solve a problem by this measure is the same as ordering
            them by cost.
        why: sentences that define the measure and, if it is not the regret, say why.
    """

    name: str
    fair: bool
    why: str

    @property
    def title(self) -> str:
        """Readable name with a capital letter."""
        return TITLES[self.name].capitalize()


def is_in(key: str, keys: Sequence[str]) -> bool:
    """True if ``keys`` contains this swept key, or its group (the part before the first dot)."""
    return key in keys or key.partition(".")[0] in keys


class Summary:
    """The finished jobs of a sweep.

    Args:
        folder: folder of the sweep.
        measure: the measure that compares the jobs; None chooses a measure that is fair to all.

    Raises:
        OSError, InputError: the folder has no sweep, or the measure is unknown.
    """

    def __init__(self, folder: Path, measure: str | None = None) -> None:
        self.folder = SweepFolder(folder)
        self.about, self.jobs = self.folder.about, self.folder.jobs
        self._asked = None if measure is None else one_of("measure", measure, REFERENCES)
        self.results: list[tuple[ListedJob, Results]] = [
            (job, load_results(self.folder.address(job)))
            for job in self.jobs
            if self.folder.state(job) == "finished"
        ]
        self.is_table1 = self.about.get("report") == "table1"
        keys = dict.fromkeys(key for job in self.jobs for key in job.values)
        self.keys = [key for key in keys if key != "seed"]  # seeds are replicates
        self.pool = tuple(key for key in self.about.get("pool") or () if key in self.keys)

    @property
    def missing(self) -> int:
        """Number of jobs without results."""
        return len(self.jobs) - len(self.results)

    @property
    def failures(self) -> list[tuple[str, str]]:
        """(job, error) of the failed jobs."""
        return [
            (job.label, self.folder.error(job))
            for job in self.jobs
            if self.folder.state(job) == "failed"
        ]

    @cached_property
    def swept(self) -> pd.DataFrame:
        """A row for each finished job: the values of the swept keys ("" for a job that lacks the
        key); ``domain``, ``solver``, ``lambda`` and ``seed`` even if these are not swept; and
        ``fresh_accuracy``, the share of new labels that the job's labelers predict correctly."""
        swept: dict[Any, Any] = {
            key: _read_values([job.values.get(key) for job, _ in self.results]) for key in self.keys
        }
        own = [
            {
                "domain": results.domain,
                "solver": results.solver,
                "lambda": results.trade_off,
                "seed": results.seed,
                "fresh_accuracy": results.learning.get("fresh_accuracy", math.nan),
            }
            for _, results in self.results
        ]
        return pd.DataFrame(swept | dict(pd.DataFrame(own)))

    @cached_property
    def episodes(self) -> pd.DataFrame:
        """A row for each episode of the solver that a job evaluates.

        Columns: the columns of ``swept``; the fields of
        :class:`xplain.experiment.results.EpisodeFigures`, such as ``cost``; ``oracle``,
        ``clairvoyant`` and ``true_labels``, the costs of these references on the same trace and
        user; ``regret``, the cost minus the oracle's; ``above_floor``, the cost minus the
        clairvoyant's.
        """
        rows = [
            {"job": i} | vars(e) for i, (_, own) in enumerate(self.results) for e in own.episodes
        ]
        every = pd.DataFrame(rows, columns=["job", *EpisodeFigures.__dataclass_fields__])
        costs = every.pivot(index=["job", "trace", "type"], columns="solver", values="cost")
        costs = costs.reindex(columns=["oracle", "clairvoyant", "true_labels"])
        frame = every[every["solver"] == "solver"].drop(columns="solver")
        frame = frame.join(costs, on=["job", "trace", "type"]).join(self.swept, on="job")
        more = {"regret": frame["cost"] - frame["oracle"]}
        more["above_floor"] = frame["cost"] - frame["clairvoyant"]
        return frame.assign(**more).drop(columns="job")

    @cached_property
    def data_sets(self) -> pd.DataFrame:
        """A row for each data set from which types are learned.

        Columns: the swept keys that decide the data set; seed; and the figures of the learning
        stage, by name.
        """
        keys, learning = [*self.settings, "seed"], [own.learning for _, own in self.results]
        return self.swept[keys].join(pd.DataFrame(learning)).drop_duplicates(keys, keep="last")

    @cached_property
    def steps(self) -> pd.DataFrame:
        """A row for each job and each step of its episodes: the values of the swept keys, the
        mean belief in the true type after the step, and the number of episodes that have the
        step."""
        names = {"belief": "belief_in_true_type", "episodes": "episodes"}
        frames = {
            job: pd.DataFrame({name: own.steps[key] for name, key in names.items()})
            for job, (_, own) in enumerate(self.results)
        }
        return pd.concat(frames, names=["job", "step"]).reset_index().join(self.swept, on="job")

    @cached_property
    def settings(self) -> list[str]:
        """The domain, and the swept keys that decide data, types and traces."""
        keys = [k for k in (*self.pool, *self.shown) if is_in(k, [*_SOURCE]) and k != "domain"]
        return ["domain", *keys]

    def values(self, key: str) -> list[Value]:
        """Lists the values of a swept key, ``solver`` or ``lambda`` in the finished jobs: numbers
        ascending, solvers in the paper's order, other texts in the sweep's order."""
        found: list[Any] = self.swept[key].unique().tolist()
        if key == "solver":
            return sorted(found, key=lambda name: (rank(name), name))
        if all(isinstance(value, float) or value == "" for value in found):
            return sorted(found, key=lambda value: (value != "", value))
        return found

    @cached_property
    def shown(self) -> list[str]:
        """The swept keys that tables and plots show: all that have several values and are not
        averaged over (``pool``). A key is also left out if the value of an earlier key decides
        its value."""
        keys = [k for k in self.keys if len(self.values(k)) > 1 and k not in self.pool]
        return [
            key
            for i, key in enumerate(keys)
            if not any(self.swept.groupby(k)[key].nunique().max() == 1 for k in keys[:i])
        ]

    @property
    def problem(self) -> list[str]:
        """The columns that identify an episode among those of one way to solve a problem."""
        return [*self.pool, "seed", "trace", "type"]

    def competes(self, key: str) -> bool:
        """True if tables rank the values of this swept key. Solvers are ranked, but not values
        of λ, which define different problems. In Table 1 only solvers are ranked."""
        return key == "solver" if self.is_table1 else not is_in(key, CONDITIONS)

    @property
    def posed(self) -> list[str]:
        """The shown swept keys that define the problem, such as the domain or λ."""
        return [key for key in self.shown if not self.competes(key)]

    @property
    def ways(self) -> list[str]:
        """The shown swept keys that choose a way to solve the problem, such as the solver."""
        return [key for key in self.shown if self.competes(key)]

    @cached_property
    def measure(self) -> Measure:
        """The measure that compares the jobs. It is the paper's regret if all compared jobs have
        the same oracle. If only their clairvoyants are the same, it is the cost above the
        clairvoyant's cost. If the clairvoyants differ too, for example because jobs discount
        differently, it is the cost itself. A measure that the user chose is used in any case."""
        same = self.keys if self.is_table1 else [k for k in self.keys if is_in(k, PROBLEM)]
        shared = [*(key for key in same if key != "solver"), "seed", "trace", "type"]
        fair = {
            n: column is None or self._is_shared(shared, column) for n, column in REFERENCES.items()
        }
        name = self._asked or next(name for name in REFERENCES if fair[name])
        earlier = list(REFERENCES)[: list(REFERENCES).index(name)]
        why = [_WHY[name], *(_UNFAIR[own] for own in earlier if not fair[own])]
        if not fair[name]:
            why.append("Not a fair comparison: the reference differs between the compared jobs.")
        return Measure(name, fair[name], " ".join(filter(None, why)))

    def _is_shared(self, by: list[str], column: str) -> bool:
        """True if the cost of a reference (the oracle or the clairvoyant) is known in all jobs, and
        is the same in all jobs of a problem.

        Args:
            by: columns that identify a problem, with its seed, trace and user.
            column: column of the reference's cost.
        """
        costs = self.episodes.groupby(by)[column]
        is_equal = (costs.max() - costs.min()).max() <= 1e-9
        return bool(is_equal and self.episodes[column].notna().all())

    @property
    def seeds(self) -> int:
        """Number of distinct seeds."""
        return int(self.swept["seed"].nunique())

    @property
    def replicate(self) -> str:
        """The unit over which intervals are computed: "seed" if there are several seeds, each
        with its own data and traces; otherwise "trace". Different settings use the same seeds
        and traces, so settings are no replicates."""
        return "seed" if self.seeds > 1 else "trace"


def _read_values(texts: Sequence[str | None]) -> list[Value]:
    """Converts the texts of a key's values to numbers, if all are numbers; None becomes ""."""
    try:
        return ["" if text is None else float(text) for text in texts]
    except ValueError:
        return [text or "" for text in texts]


def rank(solver: str) -> int:
    """Returns the position of a solver's column: the paper's solvers first, then the others."""
    return ORDER.index(solver) if solver in ORDER else len(ORDER)


def is_unreliable(frame: pd.DataFrame) -> bool:
    """True if the oracle of these episodes cannot serve as a reference: the mean share of new
    labels that its labelers predict correctly is below RIGHT."""
    return bool(frame["fresh_accuracy"].fillna(1.0).mean() < RIGHT)
