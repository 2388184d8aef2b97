from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.users.corridor import Corridor
from xplain.data.label_table import write_table
from xplain.data.observers import FileObservers, SimulatedObservers
from xplain.domains.base import transition_feature_names, transition_features
from xplain.errors import InputError
from xplain.users.setting import Setting, UserType


@pytest.fixture(scope="module")
def setting() -> Setting:
    types = UserType("A", {"end": "left"}), UserType("B", {"end": "left", "toll": -5.0})
    return Setting.build(Corridor(), types)


def labelled(setting: Setting, **options: Any) -> Any:
    return SimulatedObservers(**{"points": 40, "per_type": 2, **options}).collect(setting, 3)


@pytest.mark.parametrize("queries", ["shared", "independent"])
def test_labels_are_those_of_the_true_types(setting: Setting, queries: str) -> None:
    dataset, truth = labelled(setting, queries=queries)
    assert truth.tolist() == [0, 0, 1, 1]
    assert np.bincount(dataset.observer).tolist() == [40] * 4
    known = transition_features(setting.domain, setting.reachable)
    for o, t in enumerate(truth):
        own = dataset.of(np.array([o]))
        # Every transition shown is one that the robot makes, so its features are known.
        shown = dataset.features[own.transition]
        where = [np.flatnonzero((known == row).all(axis=1))[0] for row in shown]
        expected = setting.labels(int(t), setting.reachable[where], own.message_set)
        assert (own.label == expected).all()
    assert dataset.feature_names == transition_feature_names(setting.domain)
    assert len(np.unique(dataset.features, axis=0)) == len(dataset.features)


@pytest.mark.parametrize("length", [1, 2, 3])
@pytest.mark.parametrize("queries", ["shared", "independent"])
def test_traces_run_from_a_start_to_their_length_under_one_message_set(
    length: int, queries: str
) -> None:
    types = (UserType("A", {"end": "left"}),)
    setting = Setting.build(Corridor(starts=(1,)), types)
    dataset, _ = labelled(setting, points=600, per_type=1, trace_length=length, queries=queries)
    cell = dataset.features[dataset.transition][:, 0]
    assert cell.tolist() == [1 + i % length for i in range(600)]
    traces = dataset.message_set.reshape(-1, length)
    assert (traces == traces[:, :1]).all()


def test_messages_are_given_one_by_one(setting: Setting) -> None:
    dataset, _ = labelled(setting, points=4000, per_type=1, trace_length=1, message_probability=0.3)
    share = np.bincount(dataset.message_set[dataset.observer == 0], minlength=4) / 4000
    expected = np.array([0.49, 0.21, 0.21, 0.09])
    assert (abs(share - expected) < 4 * (expected * (1 - expected) / 4000) ** 0.5).all()


def test_shared_questions_are_shared_and_independent_ones_are_not(setting: Setting) -> None:
    def asked(queries: str) -> list[tuple[bytes, bytes]]:
        dataset, truth = labelled(setting, queries=queries)
        parts = [dataset.of(np.array([o])) for o in range(len(truth))]
        return [(part.transition.tobytes(), part.message_set.tobytes()) for part in parts]

    assert len(set(asked("shared"))) == 1
    assert len(set(asked("independent"))) == 4


def test_message_probability_at_its_limits(setting: Setting) -> None:
    assert not labelled(setting, message_probability=0.0)[0].message_set.any()
    everything, _ = labelled(setting, message_probability=1.0)
    assert (everything.message_set == 3).all()
    # Told everything, everybody agrees with the robot.
    assert everything.label.all()


def test_noise_flips_labels_and_nothing_else(setting: Setting) -> None:
    clean, _ = labelled(setting, points=2000)
    noisy, _ = labelled(setting, points=2000, label_noise=0.1)
    assert (clean.transition == noisy.transition).all()
    assert (clean.message_set == noisy.message_set).all()
    flipped = (clean.label != noisy.label).mean()
    assert flipped == pytest.approx(0.1, abs=4 * (0.1 * 0.9 / len(clean)) ** 0.5)


@pytest.mark.parametrize("queries", ["shared", "independent"])
def test_observers_err_each_on_their_own(setting: Setting, queries: str) -> None:
    options = {"queries": queries, "points": 3000, "per_type": 3}
    clean, truth = labelled(setting, **options)
    noisy, _ = labelled(setting, label_noise=0.3, **options)
    flipped = (clean.label != noisy.label).reshape(len(truth), -1)
    both = np.cov(flipped)
    # Flips of 30 %: their variance is 0.21, and what two observers share is chance.
    assert np.diag(both) == pytest.approx(np.full(len(truth), 0.21), abs=0.02)
    apart = both[~np.eye(len(truth), dtype=bool)]
    assert abs(apart).max() < 5 * 0.21 / 3000**0.5


def test_unequal_observers(setting: Setting) -> None:
    dataset, truth = labelled(setting, per_type=[3, 1], points=[5, 30])
    assert truth.tolist() == [0, 0, 0, 1]
    sizes = np.bincount(dataset.observer)
    assert sizes.min() >= 5
    assert sizes.max() <= 30
    assert len(set(sizes.tolist())) > 1


def test_seeds(setting: Setting) -> None:
    simulated = SimulatedObservers(points=30, queries="independent")
    first, again, other = (simulated.collect(setting, seed)[0] for seed in (1, 1, 2))
    assert (first.message_set == again.message_set).all()
    assert (first.label == again.label).all()
    assert not (first.message_set == other.message_set).all()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("per_type", 0),
        ("per_type", [2, 0]),
        ("per_type", "many"),
        ("points", 0),
        ("points", [9, 3]),
        ("points", "many"),
        ("trace_length", 0),
        ("queries", "none"),
        ("message_probability", 1.5),
        ("message_probability", float("nan")),
        ("label_noise", 0.6),
        ("label_noise", "much"),
    ],
)
def test_bad_values_are_named(field: str, value: object) -> None:
    with pytest.raises(InputError, match=f"observers.{field}"):
        SimulatedObservers(**{field: value})  # type: ignore[arg-type]


def test_counts_must_fit_the_types(setting: Setting) -> None:
    with pytest.raises(InputError, match="2 of them"):
        labelled(setting, per_type=[1, 2, 3])


def test_a_file_takes_their_place(setting: Setting, tmp_path: Path) -> None:
    dataset, _ = labelled(setting, queries="independent")
    write_table(dataset, tmp_path / "people.csv")
    again, truth = FileObservers(str(tmp_path / "people.csv")).collect(setting, 0)
    assert truth is None
    assert again.feature_names == dataset.feature_names
    assert again.messages == dataset.messages
    shown, expected = again.features[again.transition], dataset.features[dataset.transition]
    assert (shown == expected).all()
    assert (again.label == dataset.label).all()
