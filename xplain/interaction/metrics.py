"""Computes the paper's figures, and further ones, from episodes (docs/method.md, section 7)."""

from dataclasses import dataclass
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from xplain.interaction.episode import Episode
from xplain.interaction.statistics import ANY, Estimate, Range, clustered_mean

SURE = 0.9
"""A type counts as recognised if the belief in it exceeds this value."""

RANGES: dict[str, Range] = {
    "regret": ANY,
    "difference": ANY,
    "final_belief": (0.0, 1.0),
    "fit": (0.0, 1.0),
}
"""Ranges of measures that are no costs. A regret may be negative: the oracle's labelers err, so
another plan can have a lower cost by chance."""


def possible(measure: str) -> Range:
    """Returns the possible range of the mean of a measure, for
    :func:`~xplain.interaction.statistics.clustered_mean`. The range is [0, ∞) for a cost, and for
    its difference from the clairvoyant's cost. An observed difference below 0 extends the range
    there: plans minimize discounted costs, but the measure is not discounted."""
    return RANGES.get(measure, (0.0, np.inf))


@dataclass(frozen=True)
class Record:
    """An episode with its origin.

    Attributes:
        solver: "solver", "oracle", "clairvoyant", or "true_labels" (the solver with the true types'
            labels).
        trace: index of the trace.
        user_type: index of the user's true type.
        right: [N] True for the problem's types that represent the user's true type.
        episode: the episode.
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
        """Steps until the belief in the true type first exceeds SURE; m + 1 if it never does."""
        sure = np.flatnonzero(self.right_belief > SURE)
        return int(sure[0]) if len(sure) else len(self.episode.beliefs)


def summarise(records: list[Record]) -> dict[str, Estimate]:
    """Computes the figures of the "solver" records: costs, both regrets, diagnostics.

    Regret is paired: each episode's cost minus the oracle's (or the clairvoyant's) on the same
    trace and user. A regret is left out if the oracle (or the clairvoyant) did not run.
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
    # For labels from a file the true types of the learned types are unknown.
    if any(record.right.any() for record in own.values()):
        columns["steps_until_sure"] = [record.steps_until_sure for record in own.values()]
        columns["final_belief"] = [float(record.right_belief[-1]) for record in own.values()]
    for reference, name in (("oracle", "regret"), ("clairvoyant", "regret_to_clairvoyant")):
        if reference in by_solver:
            other = [by_solver[reference][key].episode.cost for key in own]
            columns[f"{reference}_cost"] = other
            columns[name] = [c - o for c, o in zip(columns["cost"], other, strict=True)]
    return {
        name: clustered_mean(column, traces, possible=possible(name))
        for name, column in columns.items()
    }


def by_step(records: list[Record]) -> dict[str, NDArray[np.float64]]:
    """Computes means over the "solver" episodes at each step. An episode counts at a step only if
    it has this step.

    Returns:
        ``belief_in_true_type``: [steps + 1] belief before the first step and after each step.
        ``episodes``: [steps + 1] number of episodes with at least 0, 1, … steps.
    """
    own = [record.right_belief for record in records if record.solver == "solver"]
    beliefs = np.array([*zip_longest(*own, fillvalue=np.nan)], np.float64)
    counts = np.isfinite(beliefs).sum(axis=1).astype(float)
    return {"belief_in_true_type": np.nanmean(beliefs, axis=1), "episodes": counts}
