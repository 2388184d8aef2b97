"""Compares the likelihood of answers with wrong hypotheses with its definition; finds types by it.
Growing lists of candidates agree with the list of all sets."""

from functools import cache
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import gammaln

from tests.domains.example import warehouse
from tests.questions.tables import random_hypotheses
from xplain import Dataset, Setting, UserType
from xplain.domains.base import transition_features
from xplain.domains.users.hypotheses import Hypotheses, hypotheses_of
from xplain.learning.data.observers import Observations, SimulatedObservers
from xplain.learning.data.queries import Independent
from xplain.learning.mixture.labeler import MOST, HypothesisLabeler, HypothesisTrainer
from xplain.learning.mixture.likelihood import (
    DEVIATION,
    DISPUTED,
    ERROR,
    LIKELY,
    MATTERS,
    UNWRITTEN,
    Cells,
    KnownTransitions,
    by_level,
    grow,
    posterior_by,
)
from xplain.learning.mixture.partition import partition
from xplain.learning.mixture.sampler import DirichletMixture
from xplain.questions.designs import Adaptive


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


def dataset_of(known, observer, transition, message_set, label):
    h = known.hypotheses
    return Dataset(
        features=h.features,
        feature_names=h.feature_names,
        messages=h.messages,
        observers=tuple(f"o{o}" for o in range(observer.max() + 1)),
        observer=observer,
        transition=transition,
        message_set=message_set,
        label=label.astype(np.uint8),
    )


def answers_of(rng, known, count):
    h = known.hypotheses
    return dataset_of(
        known,
        np.zeros(count, np.int64),
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
    about = answers.transition, answers.message_set
    found = Cells.of(known, *about, facts).log_likelihood(given)
    for r, variant, d, e in product(range(3), range(2), range(len(DEVIATION)), range(2)):
        error = float(ERROR[[0, 3]][e])
        plain = plainly(known, answers, int(facts[r]), variant, d, error)
        assert found[r, variant, d, e] == pytest.approx(np.log(plain))


@given(st.integers(0, 10_000), st.integers(0, 1))
@settings(deadline=None, max_examples=10)
def test_predictions_are_what_one_more_answer_would_be(seed, unwritten):
    """P(f = 1) = Σ posterior · P(f = 1 | cell), from the likelihood with a cell known to be 1."""
    rng = np.random.default_rng(seed)
    known = known_of(seed, facts=2, transitions=3, variants=0, unwritten=unwritten)
    answers = answers_of(rng, known, 5)
    made = HypothesisLabeler.of(known, answers, None)
    h = known.hypotheses
    reps = np.unique(known.essential)
    chance = np.bincount(np.searchsorted(reps, known.essential), h.prior)
    worlds = [
        (facts, d, error, prior * np.exp(known.log_prior[0, d]))
        for facts, prior in zip(reps.tolist(), chance, strict=True)
        for d, error in product(range(len(DEVIATION)), ERROR.tolist())
    ]
    likely = [w * plainly(known, answers, facts, 0, d, error) for facts, d, error, w in worlds]
    for t, told in product(range(3), range(1 << h.n_messages)):
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
    said = h.labels[h.facts.tolist().index(held), t] * (1 - MATTERS * (held & known.unwritten > 0))
    prior = said * (1 - DEVIATION[d]) + (1 - said) * DEVIATION[d]
    ones, zeros = answers.label[same].sum(), (1 - answers.label[same]).sum()
    one = prior * (1 - error) ** ones * error**zeros
    zero = (1 - prior) * error**ones * (1 - error) ** zeros
    return (one if label else zero) / (one + zero)


def people(known, facts, count, rng, error=0.0):
    """Simulates observers who believe ``facts`` incorrectly and answer ``count`` random questions.
    If a fact without a hypothesis is among them, eight transitions are inexplicable until its
    message."""
    h = known.hypotheses
    said = []
    for o, held in enumerate(facts):
        t = rng.integers(0, h.n_transitions, count)
        told = rng.integers(0, 1 << h.n_messages, count)
        label = h.labels[h.row(held & ~told), t].astype(np.int64)
        label[(held & ~told & known.unwritten > 0) & (t < 8)] = 0
        said.append((np.full(count, o), t, told, label ^ (rng.random(count) < error)))
    return dataset_of(known, *map(np.concatenate, zip(*said, strict=True)))


@pytest.mark.parametrize(
    ("facts", "count", "unwritten"),
    [([3, 3, 3, 12, 12, 12, 5, 5, 5], 40, 0), ([1, 1, 1, 9, 9, 9], 120, 1)],
)
def test_types_are_found_with_some_wrong_answers(facts, count, unwritten):
    """Also of people who believe incorrectly what no hypothesis contains."""
    rng = np.random.default_rng(1)
    known = known_of(1, facts=4 - unwritten, transitions=30, variants=0, unwritten=unwritten)
    said = people(known, facts, count, rng, 0.05)
    found, answers, _ = partition(known, said, 1.0)
    assert found.tolist() == known.essential[facts].tolist()
    assert 0.01 <= answers.wrong(said.transition, said.observer) <= 0.1


@pytest.mark.parametrize("seed", range(6))
def test_no_merge_and_no_other_fact_set_makes_the_types_likelier(seed):
    """The answers of a type have the likelihood that is compared with its definition above."""
    rng, known = np.random.default_rng(seed), known_of(seed, facts=2, transitions=4, variants=0)
    said = people(known, [1, 1, 2, 2, 3, 0], 8, rng, 0.1)
    found, model, _ = partition(known, said, 0.5)
    given, every = model.log_given(said)[:, :, None], {*known.essential.tolist()}

    def value(members, facts):
        rows, own = np.isin(said.observer, members), np.array([facts])
        cells = Cells.of(known, said.transition[rows], said.message_set[rows], own)
        likely = cells.log_likelihood(given[rows])[0, :, :, 0] + known.log_prior
        new = np.log(0.5 * known.prior_of(own)[0]) + gammaln(len(members))
        return np.logaddexp.reduce(likely.ravel()) + new

    types = {facts: np.flatnonzero(found == facts).tolist() for facts in {*found.tolist()}}
    for one, other in product(types, types):  # one type, or two as one
        now = sum(value(types[facts], facts) for facts in {one, other})
        members = sorted({*types[one], *types[other]})
        others = every - types.keys() | {one, other}
        assert max(value(members, facts) for facts in others) <= now + 1e-6


def test_a_file_of_hypotheses_finds_types_and_labels(tmp_path):
    """A file of hypotheses gives right types, and right labels of new questions, from 25 labels of
    each person."""
    rng = np.random.default_rng(3)
    known = known_of(1, facts=4, transitions=30, variants=0)
    known.hypotheses.save(tmp_path / "h.npz")
    facts = [3, 3, 3, 12, 12, 12]
    data = people(known, facts, 25, rng, 0.02)
    trainer = HypothesisTrainer(path=str(tmp_path / "h.npz"))
    found = trainer.select_known_answers(data).cluster(data, 1.0)
    assert found.assignment.tolist() == [0, 0, 0, 1, 1, 1]
    assert found.needs.tolist() == known.hypotheses.essential[[3, 12]].tolist()
    for members, held in (([0, 1, 2], 3), ([3, 4, 5], 12)):
        labeler = trainer.fit(data.of(np.array(members)), 0)
        table = labeler.table(known.hypotheses.features).array(4)[0]
        truth = known.hypotheses.labels[held & ~np.arange(16)].T
        assert ((table > 0.5) == truth).mean() > 0.98


def test_transitions_with_equal_features_are_told_apart_by_their_states():
    """The first needs fact 0, and most answers are about it; the second needs nothing. Of a state
    that nobody knows the features count."""
    rng, sets, rows = np.random.default_rng(0), np.arange(4), np.array([[0.0], [0.0], [1.0]])
    labels = np.stack([sets & 1 == 0, sets >= 0, sets & 2 == 0], axis=1)
    states = np.array([[0, 1], [1, 2], [2, 3]])
    about = {"features": rows, "feature_names": ("x",), "states": states, "messages": "ab"}
    trainer = HypothesisTrainer(hypotheses=Hypotheses.of(labels, **about))
    t, told = rng.choice(3, 90, p=[0.6, 0.1, 0.3]), rng.integers(0, 4, 90)
    data = dataset_of(trainer.known, 0 * t, t, told, labels[~told & 3, t])
    steps = np.array([[0, 7, 1], [1, 7, 2], [2, 7, 3], [1, 7, 1]])
    for labeler in (trainer.fit(data, 0), trainer.everything()):
        table = labeler.table(rows[[0, 1, 2, 0]], steps).array(2)[0]
        assert (table[:3] > 0.5).tolist() == labels[~sets & 3].T.tolist()
        alike = labeler.table(rows).array(2)[0]
        assert table[3].tolist() == alike[0].tolist() == alike[1].tolist()
    few = Hypotheses.of(labels[:3], sets[:3], **about)
    assert HypothesisTrainer(hypotheses=few).everything() is None


def test_labels_of_another_task_are_left_to_trees(tmp_path):
    known = known_of(1)
    known.hypotheses.save(tmp_path / "h.npz")
    trainer = HypothesisTrainer(path=str(tmp_path / "h.npz"))
    rng = np.random.default_rng(0)
    data = people(known, [3], 30, rng)
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


FACTS = 6


@cache
def every_set() -> Hypotheses:
    return Hypotheses.of_domain(warehouse(FACTS))


@cache
def few_sets(most: int) -> Hypotheses:
    return Hypotheses.of_domain(warehouse(FACTS), most=most)


@given(st.integers(0, 10_000), st.integers(1, 2))
@settings(deadline=None, max_examples=12)
def test_the_posterior_is_that_over_all_sets_within_the_list(seed, most):
    """The posterior agrees within the list, and the list has the neighbours of every likely set."""
    rng = np.random.default_rng(seed)
    every = every_set()
    person = int(rng.integers(0, 1 << FACTS))
    transitions = rng.integers(0, every.n_transitions, 60)
    told = rng.integers(0, 1 << FACTS, 60)
    labels = every.labels[person & ~told, transitions].astype(np.int64)
    answers = transitions, told, labels
    found = grow(few_sets(most), lambda known: posterior_by(known, *answers))
    own = posterior_by(found, *answers)
    whole = few_sets(most).with_sets(np.arange(1 << FACTS))
    dense = posterior_by(whole, *answers)[found.facts]
    assert own == pytest.approx(dense / dense.sum(), abs=1e-9)
    for likely in found.facts[own >= LIKELY].tolist():
        assert np.isin(likely | 1 << np.arange(FACTS), found.facts).all()


def test_types_of_more_facts_than_the_list_begins_with_are_found(monkeypatch):
    """There are types of up to five of thirteen facts, and the list begins with up to two."""
    monkeypatch.setattr("xplain.domains.users.hypotheses.MAX_MODELS", 1200)
    domain, masks = warehouse(13), [0b100001, 0b1010010001010, 0b100001100100]
    types = tuple(
        UserType(
            f"T{mask}",
            {p.name: p.inaccurate for j, p in enumerate(domain.parameters) if mask >> j & 1},
        )
        for mask in masks
    )
    setting = Setting.build(domain, types)
    begun = hypotheses_of(setting.domain, None)
    assert not begun.complete
    assert max(int(held).bit_count() for held in begun.facts) == 2
    crowd = SimulatedObservers(per_type=1, points=24)
    observed = crowd.collect(setting, Adaptive(), 0)
    data, truth = observed.dataset, observed.truth
    trainer = HypothesisTrainer().adapt_to(observed)
    found = DirichletMixture(labeler=trainer).cluster(Observations(data), 0)
    assert found.assignment.tolist() == truth.tolist()
    features = transition_features(setting.domain, setting.reachable)
    for t, mask in enumerate(masks):
        labeler = trainer.fit(data.of(found.members(t)), 0)
        found_table = labeler.table(features)
        (relevant,), table = found_table.rows, found_table.p[:, :, 0]
        assert len(relevant) <= MOST
        silent = setting.labels(t, setting.reachable, np.zeros(len(features), dtype=np.int64))
        assert ((table[:, 0] > 0.5) == silent).mean() > 0.97
        assert (table[:, -1] > 0.5).all()  # told all that it looks at, everything is explicable
        shown = sum(1 << int(j) for j in relevant)
        assert (setting.labels(t, setting.reachable, np.full(len(features), shown)) == 1).all()
        assert shown & mask


def test_the_table_over_what_matters_is_the_whole_table(monkeypatch):
    domain = warehouse(FACTS)
    wrong = {p.name: p.inaccurate for p in domain.parameters[::2]}
    setting = Setting.build(domain, (UserType("A", wrong),))
    observed = SimulatedObservers(1, 40).collect(setting, Independent(), 0)
    labeler = HypothesisTrainer().adapt_to(observed).fit(observed.dataset.of(np.array([0])), 0)
    transitions = setting.reachable[::3]
    asked = [(transition_features(setting.domain, transitions), x) for x in (None, transitions)]
    whole = [labeler.table(*one) for one in asked]
    for module in ("xplain.learning.labelers", "xplain.learning.mixture.labeler"):
        monkeypatch.setattr(f"{module}.DENSE", 0)
    for one, table in zip(asked, whole, strict=True):
        assert table.rows == [list(range(6))] * table.n_types
        assert labeler.table(*one).array(6) == pytest.approx(table.array(6), abs=1e-9)
