"""Small data sets with a known rule behind the labels."""

import numpy as np
from numpy.typing import NDArray

from xplain.learning.data.dataset import Dataset


def made(
    rng: np.random.Generator,
    types: list[list[int]],
    per_type: int = 3,
    size: int = 120,
    n: int = 4,
    noise: float = 0.0,
) -> tuple[Dataset, NDArray[np.int64]]:
    """Makes labels of ten transitions on a line; a type that needs message i mod n finds transition
    i inexplicable without this message.

    ``types`` lists the messages that each type needs. Every answer is a function of (transition,
    message set, type), flipped with probability ``noise``.
    """
    truth = np.repeat(np.arange(len(types)), per_type)
    observer = np.repeat(np.arange(len(truth)), size)
    tau, given = rng.integers(10, size=len(observer)), rng.integers(1 << n, size=len(observer))
    needs = np.array([sum(1 << j for j in needed) for needed in types])[truth[observer]]
    right = (needs & ~given) >> (tau % n) & 1 == 0
    dataset = Dataset(
        features=np.stack([np.arange(10), np.arange(10) % 2], axis=1).astype(float),
        feature_names=("place", "odd"),
        messages=tuple(f"m{j}" for j in range(n)),
        observers=tuple(f"o{o}" for o in range(len(truth))),
        observer=observer,
        transition=tau,
        message_set=given,
        label=(right ^ (rng.random(len(observer)) < noise)).astype(np.uint8),
    )
    return dataset, truth
