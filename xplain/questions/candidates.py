"""What can be asked about, where nothing is known of what people might hold wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import transition_feature_names, transition_features
from xplain.domains.users.setting import Setting
from xplain.errors import InputError
from xplain.learning.data.dataset import Dataset, places
from xplain.learning.data.rollouts import expected_visits

LONGEST = 40
"""Steps of a trace that count."""
RARE = 1e-3
"""Visits a trace that every transition counts for at least."""


@dataclass(frozen=True)
class Candidates:
    """What can be asked about: T transitions, of which those that share their features are one, as
    no labeler tells them apart.

    Attributes:
        features: [U, F] all different.
        feature_names: F names.
        visits: [T] how often the robot makes each transition, in any unit.
        which: [T] the row of ``features`` of each transition.
    """

    features: NDArray[np.float64]
    feature_names: tuple[str, ...]
    visits: NDArray[np.float64]
    which: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        features: NDArray[np.float64],
        feature_names: tuple[str, ...],
        visits: NDArray[np.float64],
    ) -> Candidates:
        """From the features [T, F] of all transitions."""
        distinct, which = np.unique(features, axis=0, return_inverse=True)
        return cls(distinct, feature_names, visits, which.ravel())

    @classmethod
    def of_setting(cls, setting: Setting) -> Candidates:
        """All that the robot can do, in the order of ``setting.reachable``."""
        names = transition_feature_names(setting.domain)
        features = transition_features(setting.domain, setting.reachable)
        return cls.of(features, names, visits_of(setting))

    @property
    def weight(self) -> NDArray[np.float64]:
        """[U] visits of all transitions that share the features."""
        return np.bincount(self.which, self.visits, len(self.features)).astype(np.float64)

    def draw(self, chosen: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
        """A transition for each of the features ``chosen`` [Q], by how often the robot makes it."""
        drawn = []
        for u in chosen.tolist():
            alike = np.flatnonzero(self.which == u)
            share = self.visits[alike] / self.visits[alike].sum()
            drawn.append(int(rng.choice(alike, p=share)))
        return np.array(drawn, dtype=np.int64)

    def unanswered(self, messages: tuple[str, ...]) -> Dataset:
        """A dataset of these transitions without observers and labels."""
        none = np.zeros(0, dtype=np.int64)
        named = self.features, self.feature_names, messages, ()
        return Dataset(*named, none, none, none, none.astype(np.uint8))

    def answered(self, dataset: Dataset) -> Dataset:
        """The same labels, their transitions numbered as here.

        Raises:
            InputError: a label is of no transition of the pool.
        """
        found = places(dataset.features, self.features)
        if (found < 0).any():
            values = dataset.features[found.argmin()].tolist()
            wrong = dict(zip(dataset.feature_names, values, strict=True))
            raise InputError("data", wrong, "features of a transition that can be asked about")
        return replace(dataset, features=self.features, transition=found[dataset.transition])


def visits_of(setting: Setting) -> NDArray[np.float64]:
    """How often the robot makes each of ``setting.reachable`` on a trace, at least RARE times."""
    model, optimal = setting.models[0], setting.optimal[0]
    starts, reachable = setting.domain.starts, setting.reachable
    return RARE + expected_visits(model, optimal, starts, reachable, LONGEST)
