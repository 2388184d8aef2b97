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
    shared: bool = False,
    noise: float = 0.0,
) -> tuple[Dataset, NDArray[np.int64]]:
    """Makes labels of ten transitions on a line; a type that needs message i mod n finds transition
    i inexplicable without this message.

    ``types`` lists the messages that each type needs. Every answer is a function of (transition,
    message set, type), flipped with probability ``noise``.
    """
    truth = np.repeat(np.arange(len(types)), per_type)
    cells = 10
    features = np.stack([np.arange(cells), np.arange(cells) % 2], axis=1).astype(float)
    lacks = np.zeros((len(types), n), dtype=bool)
    for t, needed in enumerate(types):
        lacks[t, needed] = True
    battery = rng.integers(cells, size=size), rng.integers(1 << n, size=size)
    parts = []
    for o, t in enumerate(truth):
        tau, given = (
            battery if shared else (rng.integers(cells, size=size), rng.integers(1 << n, size=size))
        )
        right = ~lacks[t, tau % n] | (given >> (tau % n) & 1).astype(bool)
        label = (right ^ (rng.random(size) < noise)).astype(np.uint8)
        parts.append((np.full(size, o), tau, given, label))
    observer, transition, message_set, label = (
        np.concatenate([part[i] for part in parts]) for i in range(4)
    )
    dataset = Dataset(
        features=features,
        feature_names=("place", "odd"),
        messages=tuple(f"m{j}" for j in range(n)),
        observers=tuple(f"o{o}" for o in range(len(truth))),
        observer=observer,
        transition=transition,
        message_set=message_set,
        label=label,
    )
    return dataset, truth
