"""``labeler=truth``: nothing is learned from labels, the true types' true labels are known."""

from __future__ import annotations

from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.learning.data.observers import Observed
from xplain.learning.known_types import KnownTypes, TraceTables, unless_too_large
from xplain.learning.labelers import LabelerTrainer


class TrueLabels(LabelerTrainer):
    """Stands where a labeler is chosen, and says that there is none.

    An experiment then plans with the labels of the users' own models, and with one type for each
    true type: what is left to find out is which of them is in front of the robot. A policy's cost
    above the clairvoyant's is what not knowing the type costs; a learned labeler's, above that,
    what its errors cost. True labels belong to the types of a setting, so no cluster of observers
    can have them, and the clusterer is not asked: the observers give the types' shares alone.

    Labels of a user who is one of the types are never impossible, so beliefs need no care, but
    sharpen to certainty: a type that an answer contradicts is ruled out for good.
    """

    def __init__(self) -> None:
        """There is nothing to choose."""
        super().__init__()

    def types_of(self, observed: Observed) -> KnownTypes:
        """The true types with their true labels. One labeler for everybody is the share of
        observers whose type would label so.

        Raises:
            InputError: nobody knows the observers' types, as of real people.
        """
        setting, truth = observed.setting, observed.truth
        if setting is None or truth is None:
            raise InputError("labeler", "truth", "needs simulated observers, whose type is known")
        shares = np.bincount(truth, minlength=len(setting.types)) / len(truth)

        def tables(_: NDArray[np.float64], transitions: NDArray[np.int64]) -> TraceTables:
            labels = setting.true_labels(transitions)
            return TraceTables(labels, unless_too_large(lambda: labels.mixed(shares)), labels)

        count = float(len(np.unique(setting.distinct)))
        return KnownTypes(
            names=tuple(user_type.name for user_type in setting.types),
            matched_true_type=setting.distinct,
            shares=shares,
            figures={"types_found": count, "true_types": count},
            curve=np.zeros(0),
            rule="truth",
            tables=tables,
            wrong=setting.wrong,
        )

    def fit(self, *_: Any, **__: Any) -> NoReturn:
        """Raises InputError: whoever fits labelers learns from data alone, without a setting."""
        raise InputError("labeler", "truth", "a labeler that learns; true labels are simulated")

    def fitted(self, *_: Any, **__: Any) -> NoReturn:
        """Raises InputError, as :meth:`fit` does."""
        self.fit()
