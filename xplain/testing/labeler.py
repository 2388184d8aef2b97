"""Tests of labelers (see :mod:`xplain.learning.labelers`)."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.learning.data.dataset import Dataset, query_index
from xplain.testing.data import rule_data
from xplain.testing.suite import Conformance


class LabelerConformance(Conformance):
    """Tests a trainer, ``fit(dataset, seed)``, and its labelers. Beliefs and planners need these
    properties.

    Attributes:
        learns: minimum accuracy on unseen points, after 300 labels that follow a simple rule.
    """

    learns = 0.8

    def test_learns_a_plain_rule(self, component: Any) -> None:
        """On unseen points, the share of right predictions is at least ``learns``."""
        labeler = component.fit(self._make_data(), self.seed)
        fresh = self._make_data(fresh=True)
        said = labeler.predict(fresh.features[fresh.transition], fresh.message_set)
        right = float((said == fresh.label).mean())
        assert right >= self.learns, f"{right:.0%} right, expected {self.learns:.0%}"

    def test_probabilities_are_never_certain(self, component: Any) -> None:
        """A labeler that is certain would make the belief ignore all later labels."""
        for probability in self._predict_twice(component):
            assert ((probability > 0) & (probability < 1)).all(), "P must be inside (0, 1)"

    def test_the_table_says_what_single_questions_say(self, component: Any) -> None:
        """``table`` [T, 2^n] gives the same numbers as ``probability``."""
        table, single = self._predict_twice(component)
        assert np.allclose(table, single, rtol=1e-12), "table and probability differ"

    def test_labels_follow_the_probabilities(self, component: Any) -> None:
        """P(label = 1) is at least ½ if and only if label 1 is predicted (for a confidence above
        ½)."""
        data = self._make_data()
        labeler = component.fit(data, self.seed)
        rows = data.features[data.transition]
        p, label = (ask(rows, data.message_set) for ask in (labeler.probability, labeler.predict))
        assert np.isin(label, (0, 1)).all(), "labels are 0 and 1"
        assert ((p >= 0.5) == (label == 1)).all(), "P(1) ≥ ½ where 0 is predicted, or the reverse"

    def test_the_same_seed_gives_the_same_labeler(self, component: Any) -> None:
        """Randomness comes from the seed alone."""
        one, other = self._predict_twice(component)[0], self._predict_twice(component)[0]
        assert np.array_equal(one, other), "two fits with one seed differ"

    def test_one_kind_of_label_is_learned_too(self, component: Any) -> None:
        """If all labels are 1, or all are 0, the labeler predicts this label everywhere."""
        data = self._make_data()
        for only in (0, 1):
            same = replace(data, label=np.full(len(data), only, dtype=np.uint8))
            labeler = component.fit(same, self.seed)
            p = labeler.probability(data.features[data.transition], data.message_set)
            assert ((p > 0.5) == bool(only)).all(), f"all labels were {only}"

    def test_figures_of_the_fit_are_told(self, component: Any) -> None:
        """The confidence is strictly between 0 and 1. Each distinct question is counted once:
        either it trains the labeler, or it is held out to measure the accuracy."""
        data = self._make_data()
        labeler = component.fit(data, self.seed)
        assert 0 < labeler.confidence < 1, labeler.confidence
        assert 0 <= labeler.accuracy <= 1, labeler.accuracy
        distinct = len(np.unique(query_index(data)))
        assert labeler.n_train + labeler.n_test == distinct, "some questions are lost or repeated"

    def test_the_order_of_the_labels_does_not_matter(self, component: Any) -> None:
        """The same data give the same labeler, in any order of the labels."""
        data = self._make_data()
        shuffled = data.take(np.random.default_rng(self.seed).permutation(len(data)))
        one, other = (
            component.fit(labels, self.seed).table(data.features).array(data.n_messages)[0]
            for labels in (data, shuffled)
        )
        assert np.array_equal(one, other), "labels in another order give another labeler"

    def _make_data(self, fresh: bool = False) -> Dataset:
        rng = np.random.default_rng([self.seed, fresh])
        return rule_data(rng, [[0, 2]], per_type=1, points=300)[0]

    def _predict_twice(self, component: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predicts labels in two ways: the table [T, 2^n], and the same numbers from single
        questions."""
        data = self._make_data()
        labeler = component.fit(data, self.seed)
        table = labeler.table(data.features).array(data.n_messages)[0]
        sets = np.tile(np.arange(table.shape[1]), len(table))
        rows = np.repeat(data.features, table.shape[1], axis=0)
        return table, labeler.probability(rows, sets).reshape(table.shape)
