"""Merging of whole types at a chain's end."""

from __future__ import annotations

import numpy as np
import pytest

from tests.learning.fact_model.states import begun, counted
from xplain.learning.data.dataset import Dataset
from xplain.learning.mixture.sampler import Prior, SortedLabels, merge_types


@pytest.mark.parametrize(("many", "other"), [(2, 0), (2, 1), (1, 2)])
def test_who_says_nothing_of_a_type_joins_the_many(many: int, other: int) -> None:
    """Four hold the one fact of ``many`` wrong; whichever of the two types' numbers is larger."""
    rows = [(o, 0, h, int(h & many > 0)) for o in range(1, 5) for h in range(4) for _ in "12"]
    rows += [(0, 1, 3, 1)]  # of all messages told, who believes what incorrectly is not seen
    observer, transition, message_set, label = map(np.array, zip(*rows, strict=True))
    dataset = Dataset(
        features=np.arange(2.0)[:, None],
        feature_names=("place",),
        messages=("m0", "m1"),
        observers=tuple(f"o{o}" for o in range(5)),
        observer=observer,
        transition=transition,
        message_set=message_set,
        label=label.astype(np.uint8),
    )
    answers, prior = SortedLabels.of(dataset), Prior.of(2, 2)
    facts = np.array([other, *[many] * 4])
    state = begun(answers, prior, facts, np.random.default_rng(0))
    assert merge_types(answers, prior, state, np.log(0.7) - 2 * np.log(2)) > 0
    assert state.facts.tolist() == [many] * 5
    assert (state.counts == counted(answers, prior, state)).all()
