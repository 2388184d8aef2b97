"""Tests of type finders and of partitions (see :mod:`xplain.learning.user_types`)."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.learning.data.dataset import Dataset
from xplain.learning.data.observers import Observations
from xplain.learning.types import Clustering, by_first_appearance
from xplain.learning.user_types import UserTypes
from xplain.testing.data import rule_data
from xplain.testing.suite import Conformance


class TypeFinderConformance(Conformance):
    """Tests a type finder, ``find(observed, seed)``. Its
    :class:`~xplain.learning.user_types.UserTypes` must be complete enough for explanations and
    scores.

    Attributes:
        finds_types: True if the finder must distinguish types with different answers to the same
            questions.
        needs_truth: True if the finder reads the true types (perfect clustering).
    """

    finds_types = True
    needs_truth = False

    def test_every_observer_gets_a_type(self, component: Any) -> None:
        """Types are numbered from 0 in the order of the observers."""
        data, truth = self._make_data()
        found = self._find_types(component, data, truth).clustering.assignment
        assert found.shape == (len(data.observers),), "not one type for each observer"
        assert np.array_equal(found, by_first_appearance(found)), "not numbered by appearance"

    def test_says_how_it_chose(self, component: Any) -> None:
        """The report needs a method, a rule, and a curve if there is one."""
        data, truth = self._make_data()
        clustering = self._find_types(component, data, truth).clustering
        assert isinstance(clustering, Clustering)
        assert clustering.method.strip(), "the method has no name"
        assert clustering.rule.strip(), "the rule for the number of types has no name"

    def test_the_same_seed_gives_the_same_types(self, component: Any) -> None:
        """Randomness comes from the seed alone."""
        data, truth = self._make_data()
        once, again = (
            self._find_types(component, data, truth).clustering.assignment for _ in range(2)
        )
        assert np.array_equal(once, again), "two clusterings with one seed differ"

    def test_does_not_look_at_the_truth(self, component: Any) -> None:
        """The true types of simulated observers are only for scores."""
        if self.needs_truth:
            return
        data, truth = self._make_data()
        blind = component.find(Observations(data), self.seed).clustering.assignment
        seen = component.find(Observations(data, truth), self.seed).clustering.assignment
        assert np.array_equal(blind, seen), "the clustering depends on the truth"

    def test_finds_plain_types(self, component: Any) -> None:
        """The finder separates three types that need different messages. Each type has three
        observers, and all observers answer the same questions."""
        if not self.finds_types:
            return
        data, truth = self._make_data()
        found = self._find_types(component, data, truth).clustering.assignment
        assert np.array_equal(found, truth), f"found {found.tolist()}, true {truth.tolist()}"

    def test_observers_may_come_in_any_order(self, component: Any) -> None:
        """The first observer has type 0, whatever the numbers of the true types."""
        data, truth = self._make_data()
        last_type_first = np.roll(np.arange(len(truth)), 1)
        shuffled, true = _reorder_observers(data, last_type_first), truth[last_type_first]
        found = self._find_types(component, shuffled, true).clustering.assignment
        assert found[0] == 0, f"the first observer's type is called {found[0]}"
        if self.finds_types:
            expected = by_first_appearance(true)
            assert np.array_equal(found, expected), f"{found.tolist()}, not {expected.tolist()}"

    def test_observers_who_answer_alike_are_of_one_type(self, component: Any) -> None:
        """Three observers with the same answers to the same questions have one type."""
        data, truth = self._make_data(types=1)
        found = self._find_types(component, data, truth).clustering.assignment
        assert (found == 0).all(), f"{found.tolist()}"

    def test_a_single_observer_is_a_type(self, component: Any) -> None:
        """A data set with one observer gives one type, and no error."""
        data, truth = self._make_data(types=1, per_type=1)
        assert self._find_types(component, data, truth).clustering.assignment.tolist() == [0]

    def test_each_type_has_a_name_a_share_and_labels(self, component: Any) -> None:
        """A labeler gives P(label = 1), strictly between 0 and 1, for any transitions and
        messages."""
        data, truth = self._make_data()
        types = self._find_types(component, data, truth)
        number = len(types.labelers)
        assert len(set(types.names)) == number >= types.clustering.n_types, types.names
        assert types.prior.shape == (number,), "one prior a type"
        assert np.isclose(types.prior.sum(), 1), "the prior does not sum to 1"
        for labeler in types.labelers:
            table = labeler.table(data.features).array(data.n_messages)
            assert table.shape == (1, len(data.features), 1 << data.n_messages), table.shape
            assert ((table > 0) & (table < 1)).all(), "P must be inside (0, 1)"
            one = labeler.probability(data.features[data.transition], data.message_set)
            assert np.allclose(one, table[0, data.transition, data.message_set])

    def _find_types(self, component: Any, data: Dataset, truth: NDArray[np.int64]) -> UserTypes:
        found: UserTypes = component.find(
            Observations(data, truth if self.needs_truth else None), self.seed
        )
        return found

    def _make_data(self, types: int = 3, per_type: int = 3) -> tuple[Dataset, NDArray[np.int64]]:
        """Makes labels of types that need one message each."""
        return rule_data(np.random.default_rng(self.seed), [[t] for t in range(types)], per_type)


def _reorder_observers(data: Dataset, order: NDArray[np.int64]) -> Dataset:
    """Returns the same labels, with the observers [O] in another order."""
    place = np.argsort(order)[data.observer]
    rows = np.argsort(place, kind="stable")
    names = tuple(data.observers[o] for o in order)
    return replace(data.take(rows), observers=names, observer=place[rows])


class PartitionConformance(Conformance):
    """Tests a component ``partition`` of :class:`~xplain.learning.paper.Elbow`, with the method
    ``partition(vectors, k, seed)``. The curve of disagreements needs these properties."""

    def test_makes_at_most_k_groups(self, component: Any) -> None:
        """There is one group for k = 1, and a group for each distinct vector if k is large
        enough."""
        vectors = self._make_vectors()
        distinct = len(np.unique(vectors, axis=0))
        for k in range(1, len(vectors)):
            groups = len(np.unique(component.partition(vectors, k, self.seed)))
            assert 1 <= groups <= k, f"{groups} groups for k = {k}"
            if k >= distinct:
                assert groups == distinct, f"{distinct} distinct vectors made {groups} groups"

    def test_equal_vectors_stay_together(self, component: Any) -> None:
        """Observers with equal vectors are indistinguishable, so no k may separate them."""
        vectors = self._make_vectors()
        for k in range(1, len(vectors)):
            groups = component.partition(vectors, k, self.seed)
            assert groups.shape == (len(vectors),), "not one group for each vector"
            for row in np.unique(vectors, axis=0):
                same = groups[(vectors == row).all(axis=1)]
                assert (same == same[0]).all(), f"equal vectors are in different groups for k = {k}"

    def test_the_same_seed_gives_the_same_groups(self, component: Any) -> None:
        """Randomness comes from the seed alone."""
        vectors = self._make_vectors()
        once, again = (component.partition(vectors, 3, self.seed) for _ in range(2))
        assert np.array_equal(once, again), "two partitions with one seed differ"

    def test_leaves_the_vectors_as_they_were(self, component: Any) -> None:
        """The array belongs to the caller and must not change."""
        vectors = self._make_vectors()
        component.partition(vectors, 3, self.seed)
        assert np.array_equal(vectors, self._make_vectors()), "the vectors were changed"

    def _make_vectors(self) -> NDArray[np.uint8]:
        """Makes four equal vectors of each of four kinds, in random order."""
        vectors = np.repeat(np.tri(4, 6, dtype=np.uint8), 4, axis=0)
        return np.random.default_rng(self.seed).permutation(vectors)
