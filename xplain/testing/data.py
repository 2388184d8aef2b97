"""Small data sets whose labels follow a known rule."""

import numpy as np
from numpy.typing import NDArray

from xplain.learning.data.dataset import Dataset

MESSAGES = ("m0", "m1", "m2", "m3")


def rule_data(
    rng: np.random.Generator,
    needs: list[list[int]],
    per_type: int = 3,
    points: int = 120,
) -> tuple[Dataset, NDArray[np.int64]]:
    """Makes the labels of observers of several types. Returns the labels, and each observer's type.

    Transitions are numbered 0 … 9. A type that needs message i mod 4 finds transition i
    inexplicable until this message is given. All observers answer the same questions.

    Args:
        rng: draws the questions.
        needs: for each type, the messages that it needs.
        per_type: number of observers of each type.
        points: number of labels of each observer.
    """
    truth = np.repeat(np.arange(len(needs)), per_type)
    place, given = rng.integers(10, size=points), rng.integers(16, size=points)
    about = place % 4
    told = (given >> about & 1).astype(bool)
    labels = [np.isin(about, needs[t], invert=True) | told for t in truth]
    dataset = Dataset(
        features=np.stack([np.arange(10), np.arange(10) % 4], axis=1).astype(float),
        feature_names=("place", "kind"),
        messages=MESSAGES,
        observers=tuple(f"o{o}" for o in range(len(truth))),
        observer=np.repeat(np.arange(len(truth)), points),
        transition=np.tile(place, len(truth)),
        message_set=np.tile(given, len(truth)),
        label=np.concatenate(labels).astype(np.uint8),
    )
    return dataset, truth
