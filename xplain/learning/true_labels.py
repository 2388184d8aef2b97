"""``labeler=true``: nothing is learned from labels, the true types' true labels are known."""

from __future__ import annotations

from typing import Any, NoReturn

from xplain.errors import InputError
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

    def fit(self, *_: Any, **__: Any) -> NoReturn:
        """Raises InputError: whoever fits labelers learns from data alone, without a setting."""
        raise InputError("labeler", "true", "a labeler that learns; true labels are simulated")

    def fitted(self, *_: Any, **__: Any) -> NoReturn:
        """Raises InputError, as :meth:`fit` does."""
        self.fit()
