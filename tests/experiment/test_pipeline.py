"""Data, types, labelers and traces, with handmade components."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from sklearn.utils import check_random_state

from tests.domains.configs import domain_of
from xplain.domains.base import transition_feature_names
from xplain.domains.users.setting import Setting
from xplain.domains.users.types import Explicit
from xplain.errors import InputError, XplainError
from xplain.experiment.pipeline import Components, PreparedData, prepare
from xplain.explanation.label_table import LabelTable
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.observers import Observations
from xplain.learning.data.queries import Queries, Shared
from xplain.learning.labelers import LabelerTrainer
from xplain.learning.types import Clustering
from xplain.learning.user_types import Clusterer

TRUTH = np.array([2, 0, 0, 1, 2, 2, 1, 2])
"""True types of eight observers, not in the types' order; A and B behave alike."""
FOUND = np.array([0, 1, 1, 1, 1, 1, 1, 1])
"""The clusters. In the second one the most frequent behaviour is that of A and B, but the most
frequent *type* is C."""
ONES = np.array([1, 2, 3, 4, 5, 6, 7, 9])
"""How many of an observer's ten labels are 1."""
TYPES = Explicit({"A": ["fire"], "B": ["fire"], "C": ["puddle", "fence"]})


@dataclass(frozen=True)
class Rate:
    """A labeler that predicts the share of its labels 1."""

    wrong = None

    rate: float
    n_test: int = 1
    n_train: int = 1
    n_messages: int = 6

    @property
    def accuracy(self) -> float:
        return self.rate

    def table(self, features: np.ndarray, transitions: np.ndarray) -> LabelTable:
        return LabelTable.dense(np.full((1, len(features), 1 << self.n_messages), self.rate))

    def predict(self, features: np.ndarray, message_sets: np.ndarray) -> np.ndarray:
        return np.full(len(features), self.rate >= 0.5)


@dataclass(frozen=True)
class Rates(LabelerTrainer):
    """Fits :class:`Rate`, and records its seeds."""

    n_test: int = 1
    seeds: list[int] = field(default_factory=list)

    def fit(self, dataset: Dataset, seed: int, measured: bool = True) -> Rate:
        self.seeds.append(seed)
        # If a test requires it, the labelers of small clusters stay untested.
        untested = self.n_test == 0 and len(set(dataset.observer.tolist())) == 1
        return Rate(float(dataset.label.mean()), 0 if untested else 1)


@dataclass(frozen=True)
class Eight:
    """Eight observers with ten labels each."""

    known: bool = True

    def collect(self, setting: Setting, queries: Queries, seed: int):
        names = transition_feature_names(setting.domain)
        dataset = Dataset(
            features=np.zeros((1, len(names))),
            feature_names=names,
            messages=setting.message_names,
            observers=tuple(f"o{o}" for o in range(8)),
            observer=np.repeat(np.arange(8), 10),
            transition=np.zeros(80, dtype=np.int64),
            message_set=np.tile(np.arange(10), 8),
            label=np.concatenate([np.arange(10) < ones for ones in ONES]).astype(np.uint8),
        )
        return Observations(dataset, TRUTH if self.known else None, setting)


@dataclass(frozen=True)
class Given(Clusterer):
    """A clusterer with its answer, which records its seeds."""

    seeds: list[int] = field(default_factory=list)

    def cluster(self, observed, seed) -> Clustering:
        self.seeds.append(seed)
        return Clustering(FOUND, "given", "by hand", curve=np.array([7, 2, 0]))


def source(**changes) -> Components:
    parts = {
        "domain": domain_of("domain=rescue"),
        "users": TYPES,
        "observers": Eight(),
        "queries": Shared(),
        "labeler": Rates(),
        "traces": 4,
        "max_steps": 7,
        "seed": 3,
    }
    parts |= changes
    return Components(**({"clusterer": Given(labeler=parts["labeler"])} | parts))


@pytest.fixture(scope="module")
def prepared() -> PreparedData:
    return prepare(source())


def test_the_seed_of_a_run_is_that_of_its_types_and_one_other_that_of_all_labelers() -> None:
    """So that the same labels give the same labeler, found or true. scikit-learn takes each."""
    fitted = []
    for seed in (3, (1 << 32) - 1):
        finder = Given(labeler=Rates())
        prepare(source(clusterer=finder, labeler=finder.labeler, seed=seed, traces=1))
        assert finder.seeds == [seed]
        fitted += {*finder.labeler.seeds}
    assert fitted[0] != fitted[1]
    assert all(check_random_state(own).random_sample() < 1 for own in (seed, *fitted))
    assert len(fitted) == 2


def test_each_labeler_learns_from_the_observers_it_is_for(prepared):
    for case in prepared.cases:
        m = len(case.transitions)
        learned, perfect = case.learned.array(6), case.perfect.array(6)
        assert learned.shape == (2, m, 64)
        np.testing.assert_allclose(learned[0], 1 / 10)
        np.testing.assert_allclose(learned[1], (2 + 3 + 4 + 5 + 6 + 7 + 9) / 70)
        np.testing.assert_allclose(case.everyone.array(6)[0], (1 + 2 + 3 + 4 + 5 + 6 + 7 + 9) / 80)
        # Whoever came first among the observers, the table of a type is that type's; A and B
        # behave alike, so their observers are of one type.
        np.testing.assert_allclose(perfect[0], (2 + 3 + 4 + 7) / 40)
        np.testing.assert_allclose(perfect[1], (2 + 3 + 4 + 7) / 40)
        np.testing.assert_allclose(perfect[2], (1 + 5 + 6 + 9) / 40)


def test_a_learned_type_stands_for_the_behaviour_of_most_of_its_observers(prepared):
    assert prepared.distinct.tolist() == [0, 0, 1]
    assert prepared.matched_true_type.tolist() == [1, 0]
    assert prepared.type_shares.tolist() == [1 / 8, 7 / 8]


def test_figures_of_learning(prepared):
    # Pairs of observers: 28; together in both 6 + 3, by cluster 21, by behaviour 6 + 6.
    together, clusters, behaviours = 9, 21, 12
    expected = clusters * behaviours / 28
    figures = {
        "types_found": 2,
        "true_types": 2,
        "labeler_accuracy": (1 / 10 + 36 / 70) / 2,
        "everyone_accuracy": 37 / 80,
        "perfect_labeler_accuracy": (16 / 40 + 21 / 40) / 2,
        "adjusted_rand_index": (together - expected) / ((clusters + behaviours) / 2 - expected),
    }
    assert {name: prepared.learning[name] for name in figures} == pytest.approx(figures)
    assert (prepared.rule, prepared.curve.tolist()) == ("by hand", [7, 2, 0])


def test_no_oracle_where_a_type_has_no_observer():
    users = Explicit({"A": ["fire"], "B": ["fire"], "C": ["puddle", "fence"], "D": ["refuel"]})
    prepared = prepare(source(users=users, traces=1))
    assert prepared.cases[0].perfect is None
    assert prepared.matched_true_type.tolist() == [1, 0]


def test_nothing_is_known_of_true_types_where_observers_have_none():
    prepared = prepare(source(observers=Eight(known=False), traces=1))
    assert all(case.perfect is None for case in prepared.cases)
    assert prepared.matched_true_type.tolist() == [-1, -1]
    known = {"types_found", "labeler_accuracy", "fresh_accuracy", "everyone_accuracy"}
    assert prepared.learning.keys() == known


def test_traces_are_walks_of_the_robot_from_a_start_to_the_end_or_the_limit(prepared):
    domain = domain_of("domain=rescue")
    setting = Setting.build(domain, TYPES.types(domain, np.random.default_rng(0)))
    for case in prepared.cases:
        walk = case.transitions
        assert walk[0, 0] in domain.starts
        assert (walk[1:, 0] == walk[:-1, 2]).all()
        assert setting.models[0].optimal[walk[:, 0], walk[:, 1]].all()
        assert len(walk) <= 7
        assert len(walk) == 7 or setting.models[0].terminal[walk[-1, 2]]
        assert np.array_equal(case.labels.array(6), setting.label_table(walk))
        states = [*walk[:, 0], walk[-1, 2]]
        assert (case.positions, case.phrases) == (
            tuple(domain.position(int(state)) for state in states),
            tuple(domain.describe(step) for step in walk),
        )


def test_a_trace_depends_on_the_seed_and_its_index_alone(prepared):
    walks = [case.transitions.tolist() for case in prepared.cases]
    more = prepare(source(traces=5, observers=Eight(known=False)))
    assert [case.transitions.tolist() for case in more.cases[:4]] == walks
    assert any(walk != walks[0] for walk in walks)
    other = prepare(source(seed=4))
    assert [case.transitions.tolist() for case in other.cases] != walks


def test_a_labeler_that_could_not_be_tested_is_refused():
    # Checks the first cluster, which has one observer.
    with pytest.raises(XplainError, match="points"):
        prepare(source(labeler=Rates(n_test=0), traces=1))


@pytest.mark.parametrize(
    ("key", "value"), [("traces", 0), ("max_steps", 0), ("seed", -1), ("seed", 1 << 32)]
)
def test_numbers_of_the_source_are_checked(key, value):
    with pytest.raises(InputError, match=key):
        source(**{key: value})
