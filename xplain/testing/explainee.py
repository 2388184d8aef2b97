"""Tests of explainees (see :mod:`xplain.interaction.explainees`)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.label_table import LabelTable
from xplain.interaction.explainees import Reaction
from xplain.testing.suite import Conformance

STEPS, MESSAGES = 6, 3


class ExplaineeConformance(Conformance):
    """Tests whether an :class:`~xplain.interaction.explainees.Explainee` suits episodes: every
    solver must meet the same person."""

    def test_reacts_with_zeros_and_ones_to_all_that_is_shown(self, component: Any) -> None:
        """At every step there is one label and one answer for each shown transition."""
        for k, reaction in enumerate(_show_trace(component, 0, [1, 0, 6, 0, 0, 0])):
            for labels in reaction:
                assert labels.shape == (k + 1,), f"step {k}: {labels.shape}, not {k + 1} labels"
                assert np.isin(labels, (0, 1)).all(), f"labels {labels}: neither 0 nor 1"

    def test_the_same_person_reacts_alike(self, component: Any) -> None:
        """Two persons with the same seed and messages have the same labels and answers."""
        for seed in range(5):
            one, other = (_show_trace(component, seed, [2, 1, 0, 0, 4, 0]) for _ in range(2))
            np.testing.assert_equal(one, other, "what a person does depends on more than the seed")

    def test_the_labels_stay_as_they_were(self, component: Any) -> None:
        """The labels belong to the caller and must not change."""
        labels = _make_labels(0)
        before = labels.p.copy()
        component.meet(labels, np.arange(STEPS), 0).react(1, 1)
        assert np.array_equal(before, labels.p), "the labels were changed"


def _make_labels(seed: int) -> LabelTable:
    rng = np.random.default_rng(seed)
    return LabelTable.dense(rng.integers(0, 2, (1, STEPS, 1 << MESSAGES)))


def _show_trace(component: Any, seed: int, said: list[int]) -> list[Reaction]:
    person = component.meet(_make_labels(seed), np.arange(STEPS), seed)
    given: NDArray[np.int64] = np.bitwise_or.accumulate(np.array(said))
    reactions = []
    for k, new in enumerate(said):
        person.hear(new)
        reactions.append(person.react(int(given[k]), k + 1))
    return reactions
