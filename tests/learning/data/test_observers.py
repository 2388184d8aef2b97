"""Traces of the robot, the questions that observers are asked, and their labels."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from tests.domains.users.corridor import Corridor
from tests.refusals import refused
from xplain import MDP, Setting, UserType
from xplain.domains.base import transition_feature_names, transition_features
from xplain.learning.data.label_file import write_table
from xplain.learning.data.observers import FileObservers, Observations, SimulatedObservers
from xplain.learning.data.queries import (
    Answer,
    Independent,
    Queries,
    QueryAnswers,
    RandomTraces,
    Shared,
    count_expected_visits,
    sample_trace,
)

DESIGNS = [pytest.param(Independent, id="independent"), pytest.param(Shared, id="shared")]


def corridor(starts: Sequence[int] = range(1, 5)) -> Setting:
    return Setting.build(Corridor(starts), (UserType("A", {"end": "left"}),))


def asked(queries: Queries, sizes: list[int], setting: Setting | None = None) -> list[QueryAnswers]:
    """Asks observers who all answer 1."""

    def answer(
        observer: int, transitions: NDArray[np.int64], message_sets: NDArray[np.int64]
    ) -> NDArray[np.uint8]:
        return np.ones(len(transitions), dtype=np.uint8)

    return queries.ask(setting or corridor(), np.array(sizes), answer, 3)


@pytest.mark.parametrize("length", [1, 2, 3])
@pytest.mark.parametrize("design", DESIGNS)
def test_traces_run_from_a_start_to_their_length_under_one_message_set(
    length: int, design: type[RandomTraces]
) -> None:
    (one,) = asked(design(length), [600], corridor(starts=(1,)))
    cell = one.transitions[:, 0]
    assert cell.tolist() == [1 + i % length for i in range(600)]
    traces = one.message_sets.reshape(-1, length)
    assert (traces == traces[:, :1]).all()


@pytest.mark.parametrize("design", DESIGNS)
def test_messages_are_given_one_by_one(design: type[RandomTraces]) -> None:
    (one,) = asked(design(1, 0.3), [4000])
    share = np.bincount(one.message_sets, minlength=4) / 4000
    expected = np.array([0.49, 0.21, 0.21, 0.09])
    assert (abs(share - expected) < 4 * (expected * (1 - expected) / 4000) ** 0.5).all()


def test_shared_questions_are_shared_and_independent_ones_are_not() -> None:
    def batteries(queries: Queries) -> set[tuple[bytes, bytes]]:
        return {
            (one.transitions[:30].tobytes(), one.message_sets[:30].tobytes())
            for one in asked(queries, [30, 70, 40, 30])
        }

    assert len(batteries(Shared())) == 1
    assert len(batteries(Independent())) == 4


COUNT = 4000


def share(values: list[int], value: int) -> float:
    return values.count(value) / len(values)


def near(expected: float) -> object:
    return pytest.approx(expected, abs=4 * (expected * (1 - expected) / COUNT) ** 0.5)


def small() -> MDP:
    """States 0 and 1, which may take actions 0 and 2, lead to state 2 or, one time in five, back to
    state 0; no outcome leads to state 3. State 2 ends a trace."""
    successor = np.tile([2, 0, 3], (4, 3, 1))
    probability = np.tile([0.8, 0.2, 0.0], (4, 3, 1))
    terminal = np.array([False, False, True, False])
    optimal = np.tile([True, False, True], (4, 1))
    return MDP(successor, probability, np.zeros((4, 3, 3)), 0.9, terminal, optimal)


@pytest.fixture(scope="module")
def traces() -> list[list[tuple[int, int, int]]]:
    """Draws traces from states 0 and 1."""
    rng = np.random.default_rng(5)
    found = [sample_trace(small(), np.array([0, 1]), rng, 3) for _ in range(COUNT)]
    return [[tuple(step) for step in trace.tolist()] for trace in found]


def test_starts_optimal_actions_and_outcomes_come_as_often_as_they_should(
    traces: list[list[tuple[int, int, int]]],
) -> None:
    starts, actions, after = (list(column) for column in zip(*(t[0] for t in traces), strict=True))
    assert share(starts, 0) == near(0.5)
    assert share(actions, 0) == near(0.5)
    assert share(actions, 1) == 0
    assert share(after, 0) == near(0.2)
    assert share(after, 3) == 0


def test_a_trace_hangs_together_and_ends_at_the_end_or_where_it_is_cut(
    traces: list[list[tuple[int, int, int]]],
) -> None:
    for trace in traces:
        assert all(one[2] == two[0] for one, two in pairwise(trace))
        assert trace[-1][2] == 2 or len(trace) == 3
        assert all(step[2] != 2 for step in trace[:-1])
    # Two unlikely outcomes in a row: one trace in 25 is as long as may be.
    assert share([len(trace) for trace in traces], 3) == near(0.04)


def test_expected_visits_are_the_mean_of_many_traces(
    traces: list[list[tuple[int, int, int]]],
) -> None:
    every = [(s, a, to) for s in (0, 1) for a in (0, 2) for to in (0, 2)]
    found = count_expected_visits(small(), np.array([0, 1]), np.array(every), 3)
    # From 0 and 1 as often; two actions; on to 0 one time in five, at most twice more.
    of_zero = 0.5 + 0.2 + 0.04
    by_hand = {0: of_zero / 2, 1: 0.25}
    for (s, _, to), visits in zip(every, found, strict=True):
        assert visits == pytest.approx(by_hand[s] * (0.8 if to == 2 else 0.2))
    steps = [step for trace in traces for step in trace]
    assert len(steps) / COUNT == pytest.approx(found.sum(), abs=0.05)


@pytest.fixture(scope="module")
def setting() -> Setting:
    types = UserType("A", {"end": "left"}), UserType("B", {"end": "left", "toll": -5.0})
    return Setting.build(Corridor(), types)


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
        def ask(
            self, setting: Setting, sizes: Any, answer: Answer, seed: int
        ) -> list[QueryAnswers]:
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
                QueryAnswers(one.transitions, one.message_sets, own)
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


@pytest.mark.parametrize(
    ("per_type", "said"),
    [([1, 2, 3], "2 of them"), *((x, "a number ≥ 1") for x in (0, [1, 0], 1.5, [[1, 2]], "2"))],
)
def test_counts_must_fit_the_types(setting: Setting, per_type: Any, said: str) -> None:
    with refused(said, "observers.per_type"):
        labelled(setting, per_type=per_type)


@pytest.mark.parametrize(
    ("key", "changes"),
    [("path", {"feature_names": ("x", "y")}), ("messages", {"messages": ("toll", "end")})],
)
def test_labels_of_another_task_are_refused(
    setting: Setting, key: str, changes: dict[str, Any]
) -> None:
    with refused(rf"^observers\.{key}="):
        Observations(replace(labelled(setting)[0], **changes), setting=setting)


def test_a_file_takes_their_place_and_may_hold_more_than_the_domain_asks_for(
    setting: Setting, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """One age a person is no feature of a step, and left out with a line; an age that changes is
    asked about."""
    dataset, _ = labelled(setting, Independent())
    path, names = tmp_path / "people.csv", transition_feature_names(setting.domain)
    write_table(dataset, path)
    pd.read_csv(path).assign(age=30.0).to_csv(path, index=False)
    columns = list(dict.fromkeys(name.split("=")[0] for name in names))
    options: dict[str, Any]
    for options in ({"ignore": ("age",)}, {"features": columns}, {}):
        observed = FileObservers(str(path), **options).collect(setting, Shared(), 0)
        again = observed.dataset
        assert observed.truth is None
        assert (again.messages, again.feature_names) == (dataset.messages, names)
        shown, expected = again.features[again.transition], dataset.features[dataset.transition]
        assert (shown == expected).all()
        assert (again.label == dataset.label).all()
    assert "to take all: 'observers.features=[" in caplog.text
    pd.read_csv(path).assign(age=np.arange(len(dataset)) % 7).to_csv(path, index=False)
    with refused("age", "observers.path"):
        FileObservers(str(path)).collect(setting, Shared(), 0)
