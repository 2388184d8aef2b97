"""The vector of an observer: the smallest message set that makes every transition explicable to
the observer's own labeler (docs/method.md, section 4; paper, "Learning the set of labeling
models").

Exact: fewest inexplicable transitions first (0 where possible), then fewest messages, then the
order of the messages (of {0, 5} and {1, 2} the first, for it has the first message).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.message_sets import bits_of, subsets
from xplain.learning.data.dataset import Dataset, inputs
from xplain.learning.labelers import LabelerTrainer, by_sets, looked_at


def minimal_message_sets(dataset: Dataset, trainer: LabelerTrainer, seed: int) -> NDArray[np.int64]:
    """The vector of each observer, as a message set: [O].

    Each observer's classifier is fitted to all of the observer's own labels; it is only asked
    about them, so nothing is held out. All are fitted with the same seed: observers who answered
    alike get the same vector. An observer without labels gets the empty set.

    Raises:
        TooLargeError: as :func:`minimal_message_set`.
    """
    x = inputs(dataset.features[dataset.transition], dataset.message_set, dataset.n_messages)
    found = np.zeros(len(dataset.observers), dtype=np.int64)
    order = np.argsort(dataset.observer, kind="stable")
    edges = np.searchsorted(dataset.observer[order], np.arange(len(found) + 1))
    for o in range(len(found)):
        own = order[edges[o] : edges[o + 1]]
        if len(own):
            classifier = trainer.fitted(x[own], dataset.label[own], seed)
            features = dataset.features[np.unique(dataset.transition[own])]
            found[o] = minimal_message_set(classifier, features, dataset.n_messages)
    return found


def minimal_message_set(classifier: Any, features: NDArray[np.float64], n_messages: int) -> int:
    """The smallest message set that makes every transition [T, F] explicable, as a bitmask.

    Args:
        classifier: fitted on :func:`xplain.learning.data.dataset.inputs`.
        features: of the distinct transitions.
        n_messages: n.

    Raises:
        TooLargeError: the classifier looks at too many messages.
    """
    messages = looked_at(classifier, features, n_messages)
    sets = subsets(messages)
    inexplicable = (by_sets(classifier.predict, features, sets, n_messages) == 0).sum(axis=0)
    # Of {0, 5} and {1, 2} the first: the first message weighs most.
    first = bits_of(np.arange(len(sets)), len(messages)) @ (1 << np.arange(len(messages)))[::-1]
    return int(sets[np.lexsort((-first, np.bitwise_count(sets), inexplicable))[0]])
