"""Hypotheses may be wrong: their predictions of answers are compared with predictions of labels
alone."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from tests.questions.test_people_who_err import asked, erring, hypotheses
from xplain.learning.data.observers import Observations
from xplain.learning.evidence import (
    BEATEN,
    BEFORE,
    COIN,
    LEAST,
    Evidence,
    number_parts,
    predict_in_order,
    stacking_weight,
)
from xplain.learning.labelers import LabelerTrainer
from xplain.learning.mixture.labeler import HypothesisTrainer
from xplain.learning.mixture.sampler import DirichletMixture
from xplain.learning.user_types import Single, learn_types


@pytest.mark.parametrize("seed", range(6))
def test_the_weight_of_hypotheses_makes_the_answers_likeliest(seed):
    rng = np.random.default_rng(seed)
    first, second = np.log(rng.uniform(0.02, 0.98, (2, 60))) - [[0.3 * seed], [0.4]]
    grid = np.linspace(LEAST, 1, 4001)
    mixed = grid[:, None] * np.exp(first) + (1 - grid[:, None]) * np.exp(second)
    value = np.log(mixed).sum(axis=1) + BEFORE * np.log(grid)
    assert stacking_weight(first, second) == pytest.approx(grid[value.argmax()], abs=5e-4)


def crowd(seed=0, each=24, thinks=None):
    """Simulates two kinds of people, three each, with one wrong answer in twenty."""
    rng, known = np.random.default_rng(seed), hypotheses()
    data = asked(known, [3] * 3 + [12] * 3, each, rng, thinks)
    return known, erring(data, [0.05] * 6, rng)


TYPES = np.repeat([0, 1], 3)


def evidence_of(known, data):
    return HypothesisTrainer(hypotheses=known).with_errors(data, TYPES)[2]


def test_no_answer_is_foretold_by_itself_or_a_later_one_or_by_other_types():
    """Answers of the last quarter, or of the other type, do not affect earlier predictions."""
    _, data = crowd()
    part, kind = number_parts(data.observer), TYPES[data.observer]

    def way(train, test):
        assert train.observer.max() <= (2 if test.observer[0] <= 2 else 5)
        return train.label.sum() + 0.001 * len(train) + np.zeros(len(test))

    rows, logs = predict_in_order(data, TYPES, (way,))
    assert sorted(rows.tolist()) == np.flatnonzero(part > 0).tolist()
    for row, said in zip(rows, logs, strict=True):
        before = (kind == kind[row]) & (part < part[row])
        assert said == pytest.approx(data.label[before].sum() + 0.001 * before.sum())


@pytest.mark.parametrize("seed", range(3))
def test_of_people_as_assumed_hypotheses_are_believed(seed, caplog):
    known, data = crowd(seed)
    evidence = evidence_of(known, data)
    assert not evidence.lost
    assert (evidence.trust == 1).all()
    assert evidence.nats[0] < min(evidence.nats[1], COIN)
    DirichletMixture(labeler=HypothesisTrainer(hypotheses=known)).find(Observations(data), 0)
    assert "do not fit" not in caplog.text
    assert "not what people think" not in caplog.text


@pytest.mark.parametrize("seed", range(3))
def test_of_people_who_answer_otherwise_than_they_think_a_line_says_so(seed, caplog):
    """Half of the answers 0 become 1, or two answers in five repeat the last answer."""
    known, data = crowd(seed, each=40)
    rng = np.random.default_rng(seed)
    polite, sticky = data.label | (rng.random(len(data)) < 0.5), data.label.copy()
    for i in np.flatnonzero(rng.random(len(data)) < 0.4)[1:]:
        sticky[i] = sticky[i - 1]
    for label in (polite, sticky):
        caplog.clear()
        told = Observations(replace(data, label=label.astype(np.uint8)))
        DirichletMixture(labeler=HypothesisTrainer(hypotheses=known)).find(told, 0)
        assert "of the answers are not what people think" in caplog.text


@pytest.mark.parametrize("seed", range(3))
def test_of_people_who_think_something_else_a_line_says_so(seed, caplog):
    """No fact set explains these labels, but people of a type share them."""
    other = np.random.default_rng(seed + 10).integers(0, 2, 30)
    known, data = crowd(seed, each=60, thinks=lambda label, transition: other[transition])
    evidence = evidence_of(known, data)
    assert evidence.lost
    assert (evidence.doubt > 0.5).all()
    with caplog.at_level(logging.WARNING):
        Single(labeler=HypothesisTrainer(hypotheses=known)).find(Observations(data), 0)
    own, others = learn_types(
        data, Single().cluster(Observations(data), 0), HypothesisTrainer(hypotheses=known), 0
    ).evidence.nats
    assert f"{own:.2f} nats by hypotheses, {others:.2f} by labels alone" in caplog.text


def test_where_labels_alone_foretell_better_their_labels_are_mixed_in():
    """A feature decides each label; the hypotheses contain nothing about it."""
    rng, known = np.random.default_rng(1), hypotheses(transitions=60)
    data = asked(known, [3] * 6, 50, rng, lambda label, t: known.features[t, 0] >= 30)
    trainer = HypothesisTrainer(hypotheses=known)
    weighed, _, evidence = trainer.with_errors(data, np.zeros(6, dtype=np.int64))
    assert evidence.lost
    assert evidence.trust[0] < 0.9
    told = np.zeros(60, dtype=np.int64)
    trust = evidence.trust[0]
    own = replace(weighed, evidence=None).fit(data, 0).probability(known.features, told)
    alone = LabelerTrainer(trainer.classifier, confidence="leaf").fit(data, 0)
    mixed = trust * own + (1 - trust) * alone.probability(known.features, told)
    both = weighed.fit(data, 0).probability(known.features, told)
    assert both == pytest.approx(mixed, abs=0.003)


def test_hypotheses_are_never_given_up_for_a_coin():
    """Three answers in ten are wrong. Hypotheses and labels alone are both overconfident, and
    labels alone would be the only alternative."""
    own, others = (np.full(300, -nats) for nats in (0.8, 0.9))
    evidence = Evidence(own, others, np.zeros(300, dtype=np.int64), np.zeros(1), np.zeros(1))
    assert evidence.against > BEATEN  # of a coin
    assert evidence.lost
    assert not evidence.beaten
