"""What labelers get right of questions that nobody asked yet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.domains.configs import domain_of
from tests.learning.conftest import made
from xplain.domains.users.setting import Setting
from xplain.domains.users.types import RandomCover
from xplain.learning.data.observers import SimulatedObservers
from xplain.learning.data.queries import Independent, Shared
from xplain.learning.labelers import LabelerTrainer, fresh_accuracy
from xplain.learning.prediction import log_likelihood, log_likelihoods
from xplain.learning.types import Clustering
from xplain.learning.user_types import learn_types


def test_siblings_under_one_message_set_do_not_help(rng: np.random.Generator) -> None:
    """Labels drawn by lot for each message set: whoever has seen others under the same set knows
    them all, and fresh questions are anybody's guess."""
    dataset, _ = made(rng, [[0]], per_type=1, size=6000, n=7)
    lot = rng.integers(2, size=1 << 7).astype(np.uint8)
    dataset = replace(dataset, label=lot[dataset.message_set])
    assert LabelerTrainer().fit(dataset, 0).accuracy > 0.75
    assert abs(fresh_accuracy(dataset, LabelerTrainer(), 0) - 0.5) < 4 * (0.25 / 128) ** 0.5


def test_each_question_counts_once(rng: np.random.Generator) -> None:
    dataset, _ = made(rng, [[0, 1]], noise=0.2, per_type=1)
    repeated = dataset.take(np.tile(np.arange(len(dataset)), 3))
    once, thrice = (fresh_accuracy(data, LabelerTrainer(), 4) for data in (dataset, repeated))
    assert once == thrice


def test_it_is_what_fresh_questions_show() -> None:
    """Sixty labels an observer, the same questions for all: within two standard errors this figure
    is right, and the one on held-out (transition, message set) too high."""
    domain = domain_of("domain=four_rooms")
    gaps = []
    for seed in range(8):
        types = RandomCover(3).types(domain, np.random.default_rng(seed))
        setting = Setting.build(domain, types)
        observed = SimulatedObservers(points=60).collect(setting, Shared(), seed)
        dataset, truth = observed.dataset, observed.truth
        people = SimulatedObservers(1, 1000)
        observed = people.collect(setting, Independent(), seed + 10**6)
        later, theirs = observed.dataset, observed.truth
        for user_type in range(len(types)):
            own = dataset.of(np.flatnonzero(truth == user_type))
            new = later.of(np.flatnonzero(theirs == user_type))
            labeler = LabelerTrainer().fit(own, seed)
            said = labeler.predict(new.features[new.transition], new.message_set)
            actual = (said == new.label).mean()
            fresh = fresh_accuracy(own, LabelerTrainer(), seed)
            gaps.append((labeler.accuracy - actual, fresh - actual))
    held_out, fresh_gap = np.mean(gaps, axis=0)
    error = np.std(gaps, axis=0, ddof=1) / len(gaps) ** 0.5
    assert held_out > 2 * error[0]
    assert abs(fresh_gap) < 2 * error[1]


def test_who_gave_no_label_before_is_predicted_by_everybodys(rng: np.random.Generator) -> None:
    """The second type's labels are all held out: nothing is known of it but what all say."""
    dataset, truth = made(rng, [[0], [1]], per_type=1, size=300)
    train, test = (dataset.of(np.array([o])) for o in range(2))
    given = Clustering(truth, "", "")
    found = log_likelihoods(train, test, learn_types(train, given, LabelerTrainer(), 3))
    everybody = LabelerTrainer().fit(train, 3)
    assert np.array_equal(found, log_likelihood(everybody, test))
    # Each label by the labeler of its own cluster, in the order of the labels.
    both = log_likelihoods(dataset, dataset, learn_types(dataset, given, LabelerTrainer(), 3))
    for o in range(2):
        own = dataset.of(np.array([o]))
        alone = log_likelihood(LabelerTrainer().fit(own, 3), own)
        assert np.array_equal(both[dataset.observer == o], alone)
