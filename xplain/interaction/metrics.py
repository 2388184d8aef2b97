"""From episodes to the figures that the paper reports, and further ones.

docs/method.md, section 7.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from xplain.interaction.episode import Episode
from xplain.interaction.statistics import (
    ANY,
    Estimate,
    Range,
    clustered_mean,
    clustered_ratio,
)

SURE = 0.9
"""A type counts as recognised once the belief in it exceeds this."""
RATIOS = (
    ("oracle_over_clairvoyant", "oracle", "clairvoyant"),
    ("cost_over_true_labels", "solver", "true_labels"),
)
"""Figures that compare what two of the records' solvers cost."""


SIGNED = ("regret",)
"""Measures that may be negative: the oracle's labelers err, and a lucky plan can beat it."""
SHARES = ("final_belief", "fit")


def possible(measure: str) -> Range:
    """The values that a measure of an episode can have. (Nothing costs less than the
    clairvoyant, but for what plans that discount and costs that do not may differ by.)"""
    if measure in SIGNED:
        return ANY
    return (0.0, 1.0) if measure in SHARES else (0.0, np.inf)


@dataclass(frozen=True)
class Record:
    """An episode, and whose it was.

    Attributes:
        solver: who explained: "solver", "oracle", "clairvoyant", or "true_labels", the solver where
            it knows the true types' labels.
        trace: index of the trace.
        user_type: index of the user's true type.
        right: [N] bool, which of the problem's types stand for the true one.
        episode: what happened.
    """

    solver: str
    trace: int
    user_type: int
    right: NDArray[np.bool_]
    episode: Episode

    @property
    def right_belief(self) -> NDArray[np.float64]:
        """[m + 1] belief in the true type, before the first step and after each."""
        belief: NDArray[np.float64] = self.episode.beliefs[:, self.right].sum(axis=1)
        return belief

    @property
    def steps_until_sure(self) -> int:
        """Steps until the belief in the true type exceeds SURE for the first time; m + 1 when
        it never does."""
        sure = np.flatnonzero(self.right_belief > SURE)
        return int(sure[0]) if len(sure) else len(self.episode.beliefs)


def summarise(records: list[Record]) -> dict[str, Estimate]:
    """The figures of the "solver" records: costs, both regrets, diagnostics.

    Regret is paired: each episode's cost less the oracle's (or the clairvoyant's) on the same
    trace and user. A regret is left out where its reference did not run.

    Two ratios of mean costs say what learned labels cost: ``oracle_over_clairvoyant`` where the
    type is known, ``cost_over_true_labels`` where it is not (below the line: the same solver with
    true types and labels). They are left out where a reference did not run, or costs nothing.
    """
    by_solver: dict[str, dict[tuple[int, int], Record]] = {}
    for record in records:
        by_solver.setdefault(record.solver, {})[record.trace, record.user_type] = record
    own = by_solver["solver"]
    traces = np.array([trace for trace, _ in own])
    episodes = [record.episode for record in own.values()]
    columns: dict[str, list[float]] = {
        "cost": [episode.cost for episode in episodes],
        "messages": [episode.n_messages for episode in episodes],
        "inexplicable_labels": [episode.n_inexplicable for episode in episodes],
        "decision_ms": [1e3 * float(episode.seconds.mean()) for episode in episodes],
    }
    if any(episode.n_again for episode in episodes):
        columns["messages_again"] = [episode.n_again for episode in episodes]
    if any(episode.n_questions for episode in episodes):
        columns["questions"] = [episode.n_questions for episode in episodes]
        columns["questions_cost"] = [episode.asking for episode in episodes]
    if any(episode.fit < 1 for episode in episodes):
        columns["fit"] = [episode.fit for episode in episodes]
    # Of labels from a file nobody knows which learned type stands for which true one.
    if any(record.right.any() for record in own.values()):
        columns["steps_until_sure"] = [record.steps_until_sure for record in own.values()]
        columns["final_belief"] = [float(record.right_belief[-1]) for record in own.values()]
    for reference, name in (("oracle", "regret"), ("clairvoyant", "regret_to_clairvoyant")):
        if reference in by_solver:
            other = [by_solver[reference][key].episode.cost for key in own]
            columns[f"{reference}_cost"] = other
            columns[name] = [c - o for c, o in zip(columns["cost"], other, strict=True)]
    found = {
        name: clustered_mean(column, traces, possible=possible(name))
        for name, column in columns.items()
    }
    for name, above, below in RATIOS:
        if above in by_solver and below in by_solver:
            dear, cheap = (
                [by_solver[who][key].episode.cost for key in own] for who in (above, below)
            )
            if sum(cheap) > 0:
                found[name] = clustered_ratio(dear, cheap, traces)
    return found


def by_step(records: list[Record]) -> dict[str, NDArray[np.float64]]:
    """Means at each step over the "solver" episodes that last so long: [steps + 1] or [steps].

    ``belief_in_true_type`` starts with the prior; ``messages_given`` and
    ``inexplicable_labels_shown`` are those of one step, as is ``questions_asked`` where any was.
    ``episodes`` counts those that have come through so many steps.
    """
    own = [record for record in records if record.solver == "solver"]
    series = {
        "belief_in_true_type": [record.right_belief for record in own],
        "messages_given": [
            np.array([int(mask).bit_count() for mask in record.episode.messages]) for record in own
        ],
        "inexplicable_labels_shown": [(record.episode.thoughts == 0).sum(axis=1) for record in own],
    }
    if any(record.episode.n_questions for record in own):
        series["questions_asked"] = [_asked(record.episode) for record in own]
    lengths = np.array([len(record.episode.messages) for record in own])
    steps = np.arange(lengths.max() + 1)
    return {
        **{name: _ragged_mean(rows) for name, rows in series.items()},
        "episodes": (lengths[:, None] >= steps).sum(axis=0).astype(float),
    }


def _asked(episode: Episode) -> NDArray[np.float64]:
    """[m] questions at each step."""
    counts = np.bincount(episode.questions[:, 0], minlength=len(episode.messages))
    return counts.astype(np.float64)


def _ragged_mean(rows: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    padded = np.array(list(zip_longest(*rows, fillvalue=np.nan)), np.float64)
    mean: NDArray[np.float64] = np.nanmean(padded, axis=1)
    return mean
