"""Compares the likelihood of answers with wrong hypotheses with its definition; finds types by
it."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.questions.tables import random_hypotheses
from xplain.learning.data.dataset import Dataset
from xplain.learning.mixture.labeler import HypothesisLabeler, HypothesisTrainer
from xplain.learning.mixture.likelihood import (
    DEVIATION,
    DISPUTED,
    ERROR,
    MATTERS,
    UNWRITTEN,
    Answers,
    Cells,
    KnownTransitions,
    by_level,
)
from xplain.learning.mixture.partition import partition


def known_of(hypotheses_seed=0, facts=3, transitions=5, variants=1, unwritten=0):
    """Draws random labels. No candidate believes the facts of ``unwritten`` messages
    incorrectly."""
    rows = np.arange(transitions, dtype=np.float64)[:, None]
    made = random_hypotheses(
        *(hypotheses_seed, facts, transitions, variants),
        messages=tuple(f"fact_{j}" for j in range(facts + unwritten)),
        features=rows,
        feature_names=("row",),
    )
    return KnownTransitions.of(made)


def answers_of(rng, known, count):
    h = known.hypotheses
    return Answers(
        rng.integers(0, h.n_transitions, count),
        rng.integers(0, 1 << h.n_messages, count),
        rng.integers(0, 2, count),
    )


def plainly(known, answers, facts, variant, d, error):
    """Computes P(answers | R, variant, δ, ε), a sum over the true labels of every cell that was
    asked."""
    h = known.hypotheses
    cells = {}
    for t, told, label in zip(
        answers.transition.tolist(), answers.message_set.tolist(), answers.label.tolist(),
        strict=True,
    ):  # fmt: skip
        cells.setdefault((t, facts & ~told), []).append(label)
    total = 1.0
    for (t, held), labels in cells.items():
        said = [table[h.facts.tolist().index(held), t] for table in h.tables]
        delta = DEVIATION[d]
        if len({label for label, same in zip(said, h.sizes, strict=True) if same}) > 1:
            delta = min(DISPUTED * delta, DEVIATION[-1])
        one = said[variant] * (1 - MATTERS if held & known.unwritten else 1)
        one = one * (1 - delta) + (1 - one) * delta
        total *= sum(
            (one if f else 1 - one)
            * np.prod([1 - error if label == f else error for label in labels])
            for f in (0, 1)
        )
    return total


@given(st.integers(0, 10_000), st.integers(0, 1))
@settings(deadline=None, max_examples=20)
def test_the_likelihood_is_a_sum_over_true_labels(seed, unwritten):
    rng = np.random.default_rng(seed)
    known = known_of(seed, unwritten=unwritten)
    answers = answers_of(rng, known, 8)
    facts = np.array([0, 3, 5 + 8 * unwritten])
    given = by_level(answers.label)[:, :, [0, 3]]
    found = Cells.of(known, answers, facts).log_likelihood(given)
    for r, variant, d, e in product(range(3), range(2), range(len(DEVIATION)), range(2)):
        error = float(ERROR[[0, 3]][e])
        plain = plainly(known, answers, int(facts[r]), variant, d, error)
        assert found[r, variant, d, e] == pytest.approx(np.log(plain))


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=10)
def test_predictions_are_what_one_more_answer_would_be(seed):
    """P(f = 1) = Σ posterior · P(f = 1 | cell), from the likelihood with a cell known to be 1."""
    rng = np.random.default_rng(seed)
    known = known_of(seed, facts=2, transitions=3, variants=0)
    answers = answers_of(rng, known, 5)
    made = HypothesisLabeler.of(known, answers, None)
    h = known.hypotheses
    reps = np.unique(h.essential)
    chance = np.bincount(np.searchsorted(reps, h.essential), h.prior)
    worlds = [
        (facts, d, error, prior * np.exp(known.log_prior[0, d]))
        for facts, prior in zip(reps.tolist(), chance, strict=True)
        for d, error in product(range(len(DEVIATION)), ERROR.tolist())
    ]
    likely = [w * plainly(known, answers, facts, 0, d, error) for facts, d, error, w in worlds]
    for t, told in product(range(3), range(4)):
        over = np.zeros(2)
        for (facts, d, error, _), weight in zip(worlds, likely, strict=True):
            for label in (0, 1):  # an answer without error is the true label of its cell
                over[label] += weight * _with_truth(known, answers, facts, d, error, t, told, label)
        expected = np.clip(over[1] / over.sum(), 0.002, 0.998)
        found = made.predict_known(np.array([t]), np.array([told]))[0]
        assert found == pytest.approx(expected, abs=2e-3)  # unlikely fact sets are left out


def _with_truth(known, answers, facts, d, error, t, told, label):
    """Computes P(f = label in the cell | answers, …)."""
    h = known.hypotheses
    held = facts & ~told
    same = (answers.transition == t) & ((facts & ~answers.message_set) == held)
    prior = 1 - DEVIATION[d] if h.labels[h.facts.tolist().index(held), t] else DEVIATION[d]
    ones, zeros = answers.label[same].sum(), (1 - answers.label[same]).sum()
    one = prior * (1 - error) ** ones * error**zeros
    zero = (1 - prior) * error**ones * (1 - error) ** zeros
    return (one if label else zero) / (one + zero)


def people(known, facts, count, rng, error=0.0, contrary=()):
    """Simulates observers who believe ``facts`` incorrectly and answer ``count`` random questions;
    at transitions in ``contrary`` they give the opposite answer."""
    h = known.hypotheses
    said = []
    for held in facts:
        t = rng.integers(0, h.n_transitions, count)
        told = rng.integers(0, 1 << h.n_messages, count)
        label = h.labels[h.row(held & ~told), t].astype(np.int64)
        flip = (rng.random(count) < error) ^ np.isin(t, contrary)
        said.append(Answers(t, told, label ^ flip))
    return said


def test_types_are_found_with_some_wrong_answers():
    rng = np.random.default_rng(1)
    known = known_of(1, facts=4, transitions=30, variants=0)
    facts = [3, 3, 3, 12, 12, 12, 5, 5, 5]
    said = people(known, facts, 40, rng, 0.05)
    found, answers, _ = partition(known, said, 1.0)
    assert found.tolist() == known.hypotheses.essential[facts].tolist()
    asked = np.concatenate([one.transition for one in said])
    assert 0.01 <= answers.wrong(asked, np.repeat(np.arange(9), 40)) <= 0.1


def test_where_answers_contradict_the_hypotheses_the_answers_win():
    rng = np.random.default_rng(2)
    known = known_of(1, facts=3, transitions=20, variants=0)
    said = people(known, [5], 600, rng, 0.05, contrary=(0, 1))[0]
    made = HypothesisLabeler.of(known, said, None)
    every = np.arange(8)
    for t in range(20):
        p = made.predict_known(np.full(8, t), every)
        truth = known.hypotheses.labels[5 & ~every, t] ^ (t < 2)
        asked = np.isin(5 & ~every, 5 & ~said.message_set[said.transition == t])
        assert ((p > 0.5) == truth)[asked].all()


def dataset_of(known, said):
    h = known.hypotheses
    return Dataset(
        features=h.features,
        feature_names=h.feature_names,
        messages=h.messages,
        observers=tuple(f"o{o}" for o in range(len(said))),
        observer=np.repeat(np.arange(len(said)), [len(one.label) for one in said]),
        transition=np.concatenate([one.transition for one in said]),
        message_set=np.concatenate([one.message_set for one in said]),
        label=np.concatenate([one.label for one in said]).astype(np.uint8),
    )


def test_a_file_of_hypotheses_finds_types_and_labels(tmp_path):
    """A file of hypotheses gives right types, and right labels of new questions, from 25 labels of
    each person."""
    rng = np.random.default_rng(3)
    known = known_of(1, facts=4, transitions=30, variants=0)
    known.hypotheses.save(tmp_path / "h.npz")
    facts = [3, 3, 3, 12, 12, 12]
    data = dataset_of(known, people(known, facts, 25, rng, 0.02))
    trainer = HypothesisTrainer(path=str(tmp_path / "h.npz"))
    found = trainer.select_known_answers(data).cluster(data, 1.0)
    assert found.assignment.tolist() == [0, 0, 0, 1, 1, 1]
    assert found.needs.tolist() == known.hypotheses.essential[[3, 12]].tolist()
    for members, held in (([0, 1, 2], 3), ([3, 4, 5], 12)):
        labeler = trainer.fit(data.of(np.array(members)), 0)
        table = labeler.table(known.hypotheses.features).array(4)[0]
        untested = trainer.fit(data.of(np.array(members)), 0, measured=False)
        assert np.array_equal(untested.table(known.hypotheses.features).array(4)[0], table)
        assert (labeler.n_test > 0, untested.n_test) == (True, 0)
        truth = known.hypotheses.labels[held & ~np.arange(16)].T
        assert ((table > 0.5) == truth).mean() > 0.98


def test_labels_of_another_task_are_left_to_trees(tmp_path):
    known = known_of(1)
    known.hypotheses.save(tmp_path / "h.npz")
    trainer = HypothesisTrainer(path=str(tmp_path / "h.npz"))
    rng = np.random.default_rng(0)
    data = dataset_of(known, people(known, [3], 30, rng))
    other = Dataset(**{**data.__dict__, "feature_names": ("other",)})
    assert trainer.select_known_answers(other) is None
    assert hasattr(trainer.fit(other, 0).classifier, "tree_")


def test_somebody_may_hold_wrong_what_no_hypothesis_does():
    """There are two messages without a hypothesis: each candidate is extended by each of these."""
    known = known_of(3, facts=3, unwritten=2)
    h = known.hypotheses
    assert known.unwritten == 0b11000
    assert h.facts.tolist() == [*range(8), *range(8, 16), *range(16, 24)]
    assert h.prior.sum() == pytest.approx(1)
    assert h.prior[8:].sum() == pytest.approx(UNWRITTEN)
    assert np.array_equal(h.labels[8:16], h.labels[:8])
    assert (known.essential[8:16] == known.essential[:8] | 8).all()
    assert known_of(3, facts=3).unwritten == 0
    # No two of these transitions share their features.
    assert not known.ambiguous.any()


def odd_people(known, facts, count, rng, odd):
    """Simulates observers like :func:`people`; people who also believe fact 3 incorrectly find the
    transitions ``odd`` inexplicable until they get its message."""
    said = people(known, [held & 7 for held in facts], count, rng, 0.03)
    for held, one in zip(facts, said, strict=True):
        wonders = (held & ~one.message_set & 8 > 0) & np.isin(one.transition, odd)
        one.label[wonders] = 0
    return said


def test_what_nobody_wrote_down_is_learned_from_answers(caplog):
    rng = np.random.default_rng(5)
    known = known_of(1, facts=3, transitions=30, variants=0, unwritten=1)
    facts, odd = [1, 1, 1, 9, 9, 9], np.arange(8)
    said = odd_people(known, facts, 120, rng, odd)
    found = partition(known, said, 1.0).facts
    assert found.tolist() == [int(known.essential[f]) for f in facts]
    together = Answers.join(said[3:])
    made = HypothesisLabeler.of(known, together, None)
    h, before = known.hypotheses, np.flatnonzero(known.hypotheses.labels[1, odd])
    told_rest = np.full(len(before), 0b0110)
    assert (made.predict_known(odd[before], told_rest) < 0.5).all()
    assert (made.predict_known(odd[before], told_rest | 8) > 0.5).all()
    # Elsewhere nothing spoke against the hypotheses.
    other = np.flatnonzero(h.labels[1, 8:]) + 8
    assert (made.predict_known(other, np.full(len(other), 0b0110)) > 0.9).mean() > 0.9
