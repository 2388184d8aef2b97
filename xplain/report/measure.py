"""By what the jobs of a sweep are compared, so that the comparison is fair.

Ways to solve the same problem are ordered by their costs on the same traces and users. A regret
orders them alike only where the oracle that it is taken to is the same for all of them: its
labelers learn from the labels and in the way that each job has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from xplain.errors import InputError
from xplain.experiment.cache import SOURCE

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
"""Keys that say what is explained to whom, and what that costs. Across them no cost is compared."""

CONDITIONS = (*PROBLEM, "observers", "queries", "points")
"""Keys that pose a problem. All others choose how it is solved, and so can be better or worse."""

REFERENCES = {"regret": "oracle", "above_floor": "clairvoyant", "cost": None}
"""Measures by what they are called in keys, with whose cost is subtracted."""

TITLES = {
    "regret": "regret",
    "above_floor": "cost above the clairvoyant's",
    "cost": "cost",
    "oracle": "oracle's cost",
    "clairvoyant": "clairvoyant's cost",
    "messages": "messages",
    "inexplicable labels": "inexplicable labels",
    "questions": "questions",
}
"""Columns of the table of episodes for people."""

NEGATIVE = (
    "A regret below 0 is no error: the oracle knows the type but plans with learned labels, which "
    "err, and can cost more than a plan without it."
)

RIGHT = 0.98
"""The paper's oracle has right labels. Where labelers are right on a smaller share of fresh labels,
the oracle's cost is no reference."""

NO_REFERENCE = "†"
"""Mark of an oracle's cost that is no reference, and of regrets to it."""

_WHAT = {
    "regret": "Regret is cost minus the oracle's on the same trace and user.",
    "above_floor": "The clairvoyant knows the true labels: nothing can cost less.",
    "cost": "",
}


_SOURCE = {*SOURCE, "points"} - {"seed"}
"""What decides data, types and traces."""

_WORDS = {"users.count": "{} types", "users.index": "completion {}"}
"""What people call settings."""


def warning_about_oracle(learning: Mapping[str, float]) -> str:
    """A sentence where the oracle's labelers err too often; "" where they do not.

    Args:
        learning: figures of the learning stage, of one run.
    """
    share = learning.get("fresh_accuracy", 1.0)
    if share >= RIGHT:
        return ""
    return (
        f"{NO_REFERENCE} The oracle is no reference: the labelers are right on {share:.1%} of "
        f"fresh labels, less than {RIGHT:.0%}. Compare costs with the clairvoyant's instead."
    )


@dataclass(frozen=True)
class Measure:
    """What a sweep's jobs are compared by.

    Attributes:
        name: ``regret``, ``above_floor`` (cost less the clairvoyant's) or ``cost``.
        fair: whether it orders ways to solve a problem as their costs do.
        why: what it is, and why not the regret, in sentences.
    """

    name: str
    fair: bool
    why: str

    @property
    def reference(self) -> str | None:
        """Column of the costs that are subtracted; None where none are, or they differ between
        what is compared."""
        return REFERENCES[self.name] if self.fair else None

    @property
    def title(self) -> str:
        """For people."""
        return TITLES[self.name]


def is_problem(key: str) -> bool:
    """Whether a swept key's values pose different problems, across which no cost is compared."""
    return key in PROBLEM or key.partition(".")[0] in PROBLEM


def is_choice(key: str) -> bool:
    """Whether the values of a key compete: with a solver one may do better, with a λ one may
    not."""
    return key not in CONDITIONS and key.partition(".")[0] not in CONDITIONS


def is_setting(key: str) -> bool:
    """Whether the values of a swept key tell settings of one domain apart."""
    return key != "domain" and key.partition(".")[0] in _SOURCE


def setting_of(values: dict[str, str]) -> str:
    """``3 types``, ``noise=0.1``; empty where settings are domains alone."""
    words = []
    for key, value in values.items():
        if is_setting(key):
            group, _, last = key.rpartition(".")
            words.append(_WORDS.get(key, f"{last}=" + "{}").format(value) if group else value)
    return " ".join(words)


def measure_of(episodes: pd.DataFrame, keys: Sequence[str], asked: str | None = None) -> Measure:
    """The paper's regret where the oracle is the same in all that is compared, else the cost above
    the clairvoyant's, else (where plans discount differently, so do the clairvoyant's) the cost.

    Args:
        episodes: a row an episode, with the swept keys, seed, trace, type and REFERENCES.
        keys: that were swept.
        asked: a measure to use in any case.

    Raises:
        InputError: no measure is called so.
    """
    if asked is not None and asked not in REFERENCES:
        raise InputError("measure", asked, f"one of {', '.join(REFERENCES)}")
    shared = [*(key for key in keys if is_problem(key)), "seed", "trace", "type"]
    fair = {
        name: column is None or _is_shared(episodes, shared, column)
        for name, column in REFERENCES.items()
    }
    name = asked or next(name for name in REFERENCES if fair[name])
    why = [_WHAT[name]]
    if fair[name] and not fair["regret"]:
        apart = [key for key in keys if not is_problem(key)]
        others = {key: [*shared, *(other for other in apart if other != key)] for key in apart}
        deciding = [key for key in apart if not _is_shared(episodes, others[key], "oracle")]
        if episodes["oracle"].isna().any():
            why.append("Not every job has an oracle, so regrets are not compared.")
        else:
            why.append(
                "Regrets are not compared: the oracle's labelers learn as the job's own do, so "
                f"its cost changes with {' and '.join(deciding)}."
            )
    elif not fair[name]:
        who = REFERENCES[name]
        why.append(f"Not a fair comparison: the {who}'s cost differs between what is compared.")
    return Measure(name, fair[name], " ".join(filter(None, why)))


def _is_shared(episodes: pd.DataFrame, by: Sequence[str], column: str) -> bool:
    """Whether a reference is known everywhere, with one cost for each problem."""
    if episodes[column].isna().any():
        return False
    costs = episodes.groupby(list(by))[column]
    return bool((costs.max() - costs.min()).max() <= 1e-9)
