"""Missed messages of simulated people, whose α, slips and guesses are known."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from xplain.learning.data.dataset import Dataset
from xplain.learning.landing import AcceptanceModel, learn_landing

ITEMS, PEOPLE, EVERY = 15, 200, 7
SLIP, GUESS = 0.05, 0.1
FACTS = np.arange(8)
NEEDS = FACTS[1:][np.arange(ITEMS) % 7]
TABLE = (FACTS[:, None] & NEEDS == 0).astype(float)
WRONG = np.array([(w, k) for w in FACTS for k in FACTS if not k & ~w])


def taught(rng: np.random.Generator, accept: NDArray[np.float64]) -> Dataset:
    """Makes answers of people to all items, before and after three messages."""
    wrong = rng.integers(0, 8, PEOPLE)
    landed = (rng.random((PEOPLE, 3)) < accept) @ (1 << np.arange(3))
    one = np.concatenate([TABLE[wrong], TABLE[wrong & ~landed]], axis=1)
    label = rng.random(one.shape) < np.where(one == 1, 1 - SLIP, GUESS)
    person, item = np.indices(one.shape).reshape(2, -1)
    return Dataset(
        features=np.arange(ITEMS, dtype=float)[:, None],
        feature_names=("item",),
        messages=("a", "b", "c"),
        observers=tuple(map(str, range(PEOPLE))),
        observer=person,
        transition=item % ITEMS,
        message_set=np.where(item < ITEMS, 0, EVERY),
        label=label.ravel().astype(np.uint8),
    )


def learned(dataset: Dataset, table: NDArray[np.float64] | None = TABLE) -> AcceptanceModel:
    found = learn_landing(dataset, table)
    assert found is not None
    return found


@pytest.mark.parametrize("accept", [(0.2, 0.5, 0.8), (0.4, 0.4, 1.0), (1.0, 1.0, 1.0)])
def test_alpha_is_learned_by_message(accept: tuple[float, ...]) -> None:
    true, inside = np.array(accept), []
    for seed in range(3):
        found = learned(taught(np.random.default_rng(seed), true))
        rate, low, high = found.accept.T
        assert np.abs(rate - true).max() < 0.2
        assert found.missed == (min(accept) < 1)
        inside += [*((low <= true.clip(0, 0.99)) & (true.clip(0, 0.99) <= high))]
    assert np.mean(inside) >= 0.8


def test_answers_after_messages_are_predicted_nearly_as_by_who_knows_all_rates() -> None:
    """Predicts answers after messages that were not observed, and compares with Bayes' rule, which
    knows all rates and enumerates all (W, missed messages)."""
    accept = np.array([0.2, 0.5, 0.8])
    dataset = taught(np.random.default_rng(5), accept)
    test = (dataset.observer % 3 == 0) & (dataset.message_set > 0)
    found = learned(dataset.take(np.flatnonzero(~test)))
    asked = dataset.take(np.flatnonzero(test))
    own = found.predict(asked.observer, asked.transition, asked.message_set)
    one = np.where(TABLE == 1, 1 - SLIP, GUESS)
    stays = (WRONG[:, 1:] >> np.arange(3) & 1) == 1
    lands = (WRONG[:, :1] & ~WRONG[:, 1:]) >> np.arange(3) & 1
    prior = np.where(stays, 1 - accept, 1).prod(axis=1) * (accept**lands).prod(axis=1) / 8
    best = np.empty(len(asked))
    for o in np.unique(asked.observer):
        before = dataset.take(np.flatnonzero((dataset.observer == o) & (dataset.message_set == 0)))
        p = one[WRONG[:, 0]][:, before.transition]
        weight = prior * np.where(before.label == 1, p, 1 - p).prod(axis=1)
        rows = np.flatnonzero(asked.observer == o)
        best[rows] = weight @ one[WRONG[:, 1]][:, asked.transition[rows]] / weight.sum()
    mean = dataset.label[(dataset.message_set > 0) & ~np.isin(dataset.observer, asked.observer)]
    nats = [-np.log(np.where(asked.label == 1, p, 1 - p)).mean() for p in (own, best, mean.mean())]
    assert nats[1] < nats[0] < nats[1] + 0.1 * (nats[2] - nats[1])


def test_nothing_is_learned_where_nobody_was_told_for_good() -> None:
    """Nothing is learned if message sets differ from question to question, or with too few people,
    or without messages."""
    rng = np.random.default_rng(0)
    dataset = taught(rng, np.full(3, 0.5))
    drawn = replace(dataset, message_set=rng.integers(0, 8, len(dataset)))
    assert learn_landing(drawn, TABLE) is None
    assert learn_landing(dataset.of(np.arange(15)), TABLE) is None
    assert learn_landing(replace(dataset, message_set=0 * dataset.message_set), TABLE) is None


def test_without_hypotheses_people_differ_in_ability() -> None:
    """Somebody who answered 1 more often before does so after; α is unknown."""
    dataset = taught(np.random.default_rng(1), np.full(3, 0.2))
    found = learned(dataset, None)
    assert not len(found.accept)
    assert not found.missed
    before = np.bincount(dataset.observer, dataset.label * (dataset.message_set == 0))
    who = np.array([before.argmin(), before.argmax()])
    low, high = found.predict(who, np.zeros(2, np.int64), np.full(2, EVERY))
    assert low < high
