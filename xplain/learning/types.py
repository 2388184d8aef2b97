"""User types as the explanation problem wants them: one labeler a cluster, and a prior."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.learning.clustering import Clustering
from xplain.learning.dataset import Dataset
from xplain.learning.labelers import Labeler, LabelerTrainer
from xplain.randomness import derived_seed


@dataclass(frozen=True)
class UserTypes:
    """N learned user types.

    Attributes:
        labelers: N of them.
        clustering: the observers' types they were learned from.
        names: N, for people.
        prior: [N] P(type) of the next user.
    """

    labelers: tuple[Labeler, ...]
    clustering: Clustering
    names: tuple[str, ...]
    prior: NDArray[np.float64]

    def p_explicable(self, features: NDArray[np.float64], n_messages: int) -> NDArray[np.float64]:
        """P(label of transition [m, F] is 1 | type, message set): [N, m, 2^n]."""
        return np.stack([labeler.table(features, n_messages) for labeler in self.labelers])


def learn_types(
    dataset: Dataset,
    clustering: Clustering,
    trainer: LabelerTrainer,
    seed: int,
    prior: Literal["share", "uniform"] = "share",
) -> UserTypes:
    """One labeler from the pooled labels of each cluster (paper, section 4.1).

    Args:
        dataset: the labels.
        clustering: of its observers.
        trainer: fits the labelers.
        seed: of the run.
        prior: ``share`` of the observers, or ``uniform``.

    Raises:
        InputError: another prior.
    """
    n = clustering.n_types
    if prior not in ("share", "uniform"):
        raise InputError("prior", prior, "share or uniform")
    share = np.bincount(clustering.assignment, minlength=n) / len(clustering.assignment)
    return UserTypes(
        labelers=tuple(
            trainer.fit(dataset.of(clustering.members(t)), derived_seed(seed, "type", t))
            for t in range(n)
        ),
        clustering=clustering,
        names=tuple(f"type_{t}" for t in range(n)),
        prior=share if prior == "share" else np.full(n, 1 / n),
    )
