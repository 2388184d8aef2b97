from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.domains.users.corridor import Corridor
from xplain.domains.base import transition_feature_names, transition_features
from xplain.domains.users.setting import Setting, UserType
from xplain.errors import InputError
from xplain.learning.data.label_file import write_table
from xplain.learning.data.observers import FileObservers, SimulatedObservers
from xplain.learning.data.queries import Answer, Answered, Independent, Queries, Shared


@pytest.fixture(scope="module")
def setting() -> Setting:
    types = UserType("A", {"end": "left"}), UserType("B", {"end": "left", "toll": -5.0})
    return Setting.build(Corridor(), types)


DESIGNS = [pytest.param(Independent, id="independent"), pytest.param(Shared, id="shared")]


def labelled(setting: Setting, queries: Queries | None = None, **options: Any) -> Any:
    observers = SimulatedObservers(**{"points": 40, "per_type": 2, **options})
    observed = observers.collect(setting, queries or Shared(), 3)
    return observed.dataset, observed.truth


@pytest.mark.parametrize("design", DESIGNS)
def test_labels_are_those_of_the_true_types(setting: Setting, design: type[Queries]) -> None:
    dataset, truth = labelled(setting, design())
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


def test_observers_are_asked_one_screen_after_the_other(setting: Setting) -> None:
    """A design sees each answer before the next question, and an observer's errors do not depend on
    the number of questions on a screen, or on questions to others in between."""

    class OneByOne(Independent):
        def ask(self, setting: Setting, sizes: Any, answer: Answer, seed: int) -> list[Answered]:
            whole = super().ask(setting, sizes, lambda o, t, h: np.zeros(len(t), np.uint8), seed)
            labels: list[list[int]] = [[] for _ in sizes]
            for i in range(int(sizes.max())):
                for o, one in enumerate(whole):
                    screen = slice(i, i + 1)
                    labels[o] += answer(
                        o, one.transitions[screen], one.message_sets[screen]
                    ).tolist()
            told = [np.array(o, np.uint8) for o in labels]
            return [
                Answered(one.transitions, one.message_sets, own)
                for one, own in zip(whole, told, strict=True)
            ]

    at_once, _ = labelled(setting, Independent(), label_noise=0.2)
    in_turn, _ = labelled(setting, OneByOne(), label_noise=0.2)
    assert (at_once.label == in_turn.label).all()


@pytest.mark.parametrize("design", DESIGNS)
def test_observers_err_each_on_their_own(setting: Setting, design: type[Queries]) -> None:
    options = {"queries": design(), "points": 3000, "per_type": 3}
    clean, truth = labelled(setting, **options)
    noisy, _ = labelled(setting, label_noise=0.3, **options)
    flipped = (clean.label != noisy.label).reshape(len(truth), -1)
    both = np.cov(flipped)
    # Flips of 30 %: their variance is 0.21, and what two observers share is chance.
    assert np.diag(both) == pytest.approx(np.full(len(truth), 0.21), abs=0.02)
    apart = both[~np.eye(len(truth), dtype=bool)]
    assert abs(apart).max() < 5 * 0.21 / 3000**0.5


def test_counts_must_fit_the_types(setting: Setting) -> None:
    with pytest.raises(InputError, match="2 of them"):
        labelled(setting, per_type=[1, 2, 3])


def test_a_file_takes_their_place(setting: Setting, tmp_path: Path) -> None:
    dataset, _ = labelled(setting, Independent())
    write_table(dataset, tmp_path / "people.csv")
    observed = FileObservers(str(tmp_path / "people.csv")).collect(setting, Shared(), 0)
    again, truth = observed.dataset, observed.truth
    assert truth is None
    assert again.feature_names == dataset.feature_names
    assert again.messages == dataset.messages
    shown, expected = again.features[again.transition], dataset.features[dataset.transition]
    assert (shown == expected).all()
    assert (again.label == dataset.label).all()


def test_a_file_may_hold_more_than_the_domain_asks_for(
    setting: Setting, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    dataset, _ = labelled(setting, Independent())
    path = tmp_path / "people.csv"
    write_table(dataset, path)
    pd.read_csv(path).assign(age=30.0).to_csv(path, index=False)
    names = transition_feature_names(setting.domain)
    columns = list(dict.fromkeys(name.split("=")[0] for name in names))
    for options in ({"ignore": ("age",)}, {"features": columns}):
        again = FileObservers(str(path), **options).collect(setting, Shared(), 0).dataset  # type: ignore[arg-type]
        assert again.feature_names == names
        assert (again.label == dataset.label).all()
    # One age a person is no feature of a step, and left out with a line.
    again = FileObservers(str(path)).collect(setting, Shared(), 0).dataset
    assert again.feature_names == names
    assert "left out: age (the same in all rows of a person)" in caplog.text
    assert "to take all: 'observers.features=[" in caplog.text
    changing = pd.read_csv(path).assign(age=np.arange(len(dataset)) % 7)
    changing.to_csv(path, index=False)
    with pytest.raises(InputError, match="age") as caught:
        FileObservers(str(path)).collect(setting, Shared(), 0)
    assert caught.value.key == "observers.path"
