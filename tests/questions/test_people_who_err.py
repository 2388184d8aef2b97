"""Types and labelers learn what people who slip, guess and err think, not what they answer.
Hypotheses may be wrong: their predictions are compared with predictions of labels alone."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from tests.questions.tables import random_hypotheses
from xplain import Clustering, Dataset, Hypotheses, LabelTable
from xplain.learning.answers import RATES, WAYS
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
from xplain.learning.labelers import Labeler, LabelerTrainer
from xplain.learning.mixture.labeler import HypothesisTrainer
from xplain.learning.mixture.sampler import DirichletMixture
from xplain.learning.prediction import predict
from xplain.learning.user_types import Single, learn_types


def hypotheses(seed=1, facts=4, transitions=30):
    rows = np.arange(transitions, dtype=np.float64)[:, None]
    return random_hypotheses(*(seed, facts, transitions, 0), features=rows, feature_names=("row",))


def asked(known, facts, each, rng, thinks=None, told=True):
    """Simulates observers who believe ``facts`` incorrectly and answer ``each`` random questions as
    they think, by ``thinks(label, transition)`` or by the hypotheses."""
    n, count = known.n_messages, known.n_transitions
    observer = np.repeat(np.arange(len(facts)), each)
    transition = np.concatenate([rng.permutation(np.resize(np.arange(count), each)) for _ in facts])
    message_set = rng.integers(0, 1 << n, len(observer)) if told else np.zeros_like(observer)
    held = np.array(facts)[observer] & ~message_set
    label = known.labels[known.row(held), transition].astype(np.int64)
    if thinks is not None:
        label = thinks(label, transition)
    return Dataset(
        known.features, known.feature_names, known.messages,
        tuple(f"o{o}" for o in range(len(facts))), observer, transition, message_set,
        label.astype(np.uint8),
    )  # fmt: skip


def erring(data, rate, rng, slip=()):
    """Makes the answers of people with these error rates [O], who slip at the transitions ``slip``
    with probability 0.3."""
    slips = np.isin(data.transition, slip) & (rng.random(len(data)) < 0.3)
    wrong = rng.random(len(data)) < np.array(rate)[data.observer]
    return replace(data, label=np.where(slips, 0, data.label).astype(np.uint8) ^ wrong)


@pytest.mark.parametrize("seed", range(3))
def test_fact_sets_are_found_though_every_second_person_errs(seed):
    """Three answers in ten of six people are wrong: then two fact sets may look alike."""
    rng = np.random.default_rng(seed)
    known = hypotheses()
    facts = [3] * 4 + [12] * 4 + [5] * 4
    data = erring(asked(known, facts, 90, rng), np.resize([0, 0.3], 12), rng)
    types = DirichletMixture(labeler=HypothesisTrainer(hypotheses=known)).find(
        Observations(data), 0
    )
    right = types.clustering.needs[types.clustering.assignment] == known.essential[facts]
    assert right[::2].all()
    assert right[1::2].sum() >= 4
    rate = types.answers.person[:-1] @ RATES
    assert rate[::2].max() < 0.1
    assert rate[1::2].min() > 0.1


def explicable(labeler, known, facts, data):
    """Computes P(f = 1) of all questions that people of these facts were asked."""
    _, first = np.unique(
        np.stack([data.transition, facts & ~data.message_set]), axis=1, return_index=True
    )
    own = data.take(first)
    return own, labeler.probability(known.features[own.transition], own.message_set)


def test_what_all_of_a_type_think_otherwise_is_learned_as_theirs():
    """The hypotheses are opposite to the labels at a third of the transitions."""
    rng = np.random.default_rng(4)
    known = hypotheses(transitions=18)
    contrary = np.arange(6)
    data = asked(known, [3] * 6 + [12] * 6, 180, rng, lambda y, t: y ^ np.isin(t, contrary))
    answers = erring(data, [0.05] * 12, rng)
    trainer = HypothesisTrainer(hypotheses=known)
    truth = np.repeat([0, 1], 6)
    types = learn_types(answers, Clustering(truth, "true", ""), trainer, 0)
    for labeler, facts, members in zip(
        types.labelers, (3, 12), (range(6), range(6, 12)), strict=True
    ):
        own, one = explicable(labeler, known, facts, data.of(np.array(members)))
        assert ((one > 0.5) == own.label).mean() > 0.97
    assert types.answers.slip[:6].max() < 0.2


def test_what_is_slipped_about_is_still_thought():
    """Three in ten answer 0 about the same transitions, whatever they think. Two types are found,
    not a type of people who slipped, and the types' labels are as expected."""
    rng = np.random.default_rng(5)
    known = hypotheses(transitions=15)
    slippery = np.arange(4)
    data = asked(known, [3] * 15 + [12] * 15, 45, rng)
    answers = erring(data, [0.02] * 30, rng, slippery)
    types = DirichletMixture(labeler=HypothesisTrainer(hypotheses=known)).find(
        Observations(answers), 0
    )
    assert types.clustering.assignment.tolist() == [0] * 15 + [1] * 15
    assert types.answers.slip[slippery].mean() == pytest.approx(0.3, abs=0.1)
    assert types.answers.slip[4:-1].max() < types.answers.slip[slippery].min()
    for labeler, facts in zip(types.labelers, (3, 12), strict=True):
        own, one = explicable(labeler, known, facts, data.of(np.arange(15) + 15 * (facts == 12)))
        assert ((one > 0.5) == own.label).mean() > 0.97


class Constant(Labeler):
    """A labeler with the same probability for all questions."""

    n_messages = 2

    def __init__(self, one, means_truth):
        self.said, self.means_truth = one, means_truth

    def table(self, features, transitions=None):
        return LabelTable.dense(np.full((1, len(features), 4), self.said))


def test_a_prediction_is_a_mean_over_types_and_error_rates():
    rng = np.random.default_rng(6)
    known = hypotheses(facts=2, transitions=6)
    data = erring(asked(known, [1, 1, 2, 2], 12, rng), [0.0, 0.3] * 2, rng)
    types = Single(labeler=HypothesisTrainer(hypotheses=known)).find(Observations(data), 0)
    answers = types.answers
    sure, prior = (0.9, 0.2), np.array([0.6, 0.4])
    made = replace(
        types, labelers=tuple(Constant(p, True) for p in sure), names=("a", "b"), prior=prior
    )
    new = replace(data.take(np.arange(2)), observers=("new", "o1"), observer=np.array([1, 0]))
    found, plain = (predict(data, replace(made, answers=x), new) for x in (answers, None))
    for row, (own, t) in enumerate(
        zip((data.of(np.array([1])), data.take(np.zeros(0, int))), new.transition, strict=True)
    ):
        joint, one = np.zeros((2, 5)), np.zeros((2, 5))
        for k, e in np.ndindex(2, 5):
            given = answers.predict(own.transition)[:, :, e]
            y = (1 - sure[k]) * given[:, 0] + sure[k] * given[:, 1]
            joint[k, e] = prior[k] * answers.prior[e]
            joint[k, e] *= np.prod(np.where(own.label == 1, y, 1 - y))
            at = answers.predict(np.array([t]))[0, :, e]
            one[k, e] = (1 - sure[k]) * at[0] + sure[k] * at[1]
        assert found[row] == pytest.approx((joint * one).sum() / joint.sum())
        weight = prior * [np.prod(np.where(own.label == 1, p, 1 - p)) for p in sure]
        assert plain[row] == pytest.approx(weight @ sure / weight.sum())
    # A labeler measured on answers says what is answered, errors and all.
    measured = replace(made, labelers=(Constant(0.8, False),) * 2)
    assert predict(data, measured, new)[1] == pytest.approx(0.8)


def pupils(rng, people, items, skills):
    """Simulates people who lack skills that items need. Returns hypotheses, answers, held-out
    answers, and the probability of each answer if all but the skills is known."""
    needed = (rng.random((items, skills)) < 0.5).astype(int) @ (1 << np.arange(skills))
    needed[needed == 0] = 1
    lacked = np.arange(1 << skills)
    features = np.arange(items, dtype=float)[:, None]
    known = Hypotheses.of(
        (lacked[:, None] & needed) == 0, features=features, feature_names=("item",)
    )
    slip, guess = rng.uniform(0.02, 0.25, (2, items))
    one = np.where(known.labels == 1, 1 - slip, guess)  # [2^n, T]
    share = rng.dirichlet(np.ones(1 << skills))
    who = rng.choice(1 << skills, people, p=share)
    answers = rng.random((people, items)) < one[who]
    left = rng.random(answers.shape) < 0.2
    said = np.where(answers[:, None], np.log(one), np.log(1 - one))  # [O, 2^n, T]
    weight = share * np.exp((said * ~left[:, None]).sum(axis=2))
    return known, answers, left, weight @ one / weight.sum(axis=1, keepdims=True)


def table(known, answers, rows):
    observer, transition = np.nonzero(rows)
    names = tuple(f"p{o:03d}" for o in range(len(answers)))
    label = answers[observer, transition].astype(np.uint8)
    none = np.zeros_like(observer)
    about = known.features, known.feature_names, known.messages, names
    return Dataset(*about, observer, transition, none, label)


def test_answers_about_skills_are_predicted_nearly_as_by_the_truth():
    rng = np.random.default_rng(1)
    known, answers, left, best = pupils(rng, 300, 12, 3)
    data, asked_ = table(known, answers, ~left), table(known, answers, left)
    types = DirichletMixture(labeler=HypothesisTrainer(hypotheses=known)).find(
        Observations(data), 0
    )
    found = predict(data, types, asked_)
    assert nats(found, answers[left]) < nats(best[left], answers[left]) + 0.02


def nats(one, label):
    return float(-np.log(np.where(label, one, 1 - one)).mean())


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
    finder = DirichletMixture(labeler=HypothesisTrainer(hypotheses=known))
    assert finder.find(Observations(data), 0).answers.ways == pytest.approx(WAYS, abs=0.02)
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
    assert "(people of 1 of 1 types disagree with them)" in caplog.text


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
