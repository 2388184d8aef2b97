"""Tests of explainees (see :mod:`xplain.interaction.explainees`)."""

from typing import Any

import numpy as np

from xplain.explanation.label_table import LabelTable
from xplain.interaction.explainees import Reaction
from xplain.testing.suite import Conformance

MESSAGES = 3
STEPS = 1 + MESSAGES


class ExplaineeConformance(Conformance):
    """Tests whether an :class:`~xplain.interaction.explainees.Explainee` suits episodes: every
    solver must meet the same person."""

    def test_reacts_with_zeros_and_ones_to_all_that_is_shown(self, component: Any) -> None:
        """At every step there is one label and one answer for each shown transition."""
        for k, reaction in enumerate(_show_trace(component, self.seed)):
            for labels in reaction:
                assert labels.shape == (k + 1,), f"step {k}: {labels.shape}, not {k + 1} labels"
                assert np.isin(labels, (0, 1)).all(), f"labels {labels}: neither 0 nor 1"

    def test_the_same_person_reacts_alike(self, component: Any) -> None:
        """Two persons with the same seed and messages have the same labels and answers."""
        for seed in range(self.seed, self.seed + 5):
            one, other = (_show_trace(component, seed) for _ in range(2))
            np.testing.assert_equal(one, other, "what a person does depends on more than the seed")

    def test_the_labels_stay_as_they_were(self, component: Any) -> None:
        """The labels belong to the caller and must not change."""
        labels = _make_labels(self.seed)
        before = labels.p.copy()
        component.meet(labels, np.arange(STEPS), self.seed).react(0, STEPS)
        assert np.array_equal(before, labels.p), "the labels were changed"


def _make_labels(seed: int) -> LabelTable:
    rng = np.random.default_rng(seed)
    return LabelTable.dense(np.round(rng.random((1, STEPS, 1 << MESSAGES))))


def _show_trace(component: Any, seed: int) -> list[Reaction]:
    """Shows a trace to a person, who hears a message before each step but the first."""
    person = component.meet(_make_labels(seed), np.arange(STEPS), seed)
    reactions = []
    for k in range(STEPS):
        person.hear(1 << k >> 1)
        reactions.append(person.react((1 << k) - 1, k + 1))
    return reactions
