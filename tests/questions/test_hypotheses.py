"""Hypotheses: candidates that behave alike, predicted answers, and files."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hydra.utils import instantiate
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.domains.configs import domain_of
from tests.domains.users.corridor import Corridor
from tests.handmade import a_file
from tests.questions.tables import random_hypotheses
from tests.refusals import refused
from xplain import Hypotheses, Setting, UserType
from xplain.domains.users import hypotheses as hypotheses_module
from xplain.domains.users.inaccurate_values import (
    AS_ASSUMED,
    NUDGES,
    OPPOSITE,
    FactLabels,
)
from xplain.errors import DomainError, XplainError
from xplain.experiment.config import compose_config

seeds = st.integers(0, 10_000)


def every_label(hypotheses, row):
    """Computes the labels of a candidate for all questions, by the definition."""
    facts = hypotheses.facts.tolist()
    sets = range(1 << hypotheses.n_messages)
    return [hypotheses.labels[facts.index(facts[row] & ~told)].tolist() for told in sets]


def few_facts(seed):
    """Draws labels that depend on some facts only, and candidates of at most two facts."""
    rng = np.random.default_rng(seed)
    facts = np.array([f for f in range(16) if f.bit_count() <= 2])
    labels = np.ones((len(facts), 4), dtype=np.uint8)
    for t in range(4):
        masks = rng.integers(1, 16, 2)
        labels[:, t] = 1 - ((facts & masks[0]) > 0) * ((facts & masks[1]) > 0)
    return labels, facts


@given(seeds)
@settings(deadline=None)
def test_classes_are_the_candidates_that_no_question_tells_apart(seed):
    """The essential facts of a class are its smallest candidate."""
    labels, facts = few_facts(seed)
    hypotheses = Hypotheses.of(labels, facts) if labels.min() == 0 else random_hypotheses(seed)
    said = [every_label(hypotheses, row) for row in range(len(hypotheses.facts))]
    for i, one in enumerate(said):
        for j, other in enumerate(said):
            assert (one == other) == (hypotheses.classes[i] == hypotheses.classes[j])
    for essential, own in zip(hypotheses.essential, hypotheses.classes, strict=True):
        members = hypotheses.facts[hypotheses.classes == own]
        assert essential == np.bitwise_and.reduce(members)
        assert essential in members


def test_of_a_domain_they_are_the_labels_of_its_inaccurate_values():
    corridor = Corridor()
    hypotheses = Hypotheses.of_domain(corridor)
    for facts, labels in zip(hypotheses.facts.tolist(), hypotheses.labels, strict=True):
        held = {p.name: p.inaccurate for j, p in enumerate(corridor.parameters) if facts >> j & 1}
        assert np.array_equal(labels_at(corridor, held), labels)


@pytest.mark.parametrize("limit", [12, 59, 60, 63, 64])
def test_as_many_facts_are_wrong_together_as_models_may_be_solved(limit, monkeypatch):
    """Sets of k facts span 2^k models each, and all sets together 2^n."""
    monkeypatch.setattr(hypotheses_module, "MAX_MODELS", limit)
    domain = domain_of("domain=rescue")
    n = len(domain.parameters)
    spanned = {k: sum(2**k for _ in combinations(range(n), k)) for k in range(n + 1)}
    spanned[n] = 2**n
    most = max(k for k in spanned if spanned[k] <= limit)
    found = Hypotheses.of_domain(domain, scales=())
    assert max(facts.bit_count() for facts in found.facts.tolist()) == most


def test_a_file_holds_all_of_them(tmp_path):
    made = Hypotheses.of_domain(Corridor())
    made.save(tmp_path / "h.npz")
    read = Hypotheses.load(tmp_path / "h.npz")
    for name in ("labels", "facts", "prior", "features", "states", "variants"):
        assert np.array_equal(getattr(made, name), getattr(read, name))
    for name in ("messages", "feature_names", "phrases"):
        assert getattr(made, name) == getattr(read, name)


def test_rows_may_come_in_any_order_with_all_that_is_of_them(tmp_path):
    """The labels, the prior, and the labels of each variant."""
    rng = np.random.default_rng(2)
    facts = np.array([0, 1, 2, 4, 5])
    labels, variants = rng.integers(0, 2, (5, 6)), rng.integers(0, 2, (2, 5, 6))
    prior = rng.dirichlet(np.ones(5))
    plain = Hypotheses.of(labels, facts, prior=prior, variants=variants)
    for order in (rng.permutation(5), np.arange(5)[::-1]):
        turned = Hypotheses.of(
            labels[order], facts[order], prior=prior[order], variants=variants[:, order]
        )
        np.savez(
            tmp_path / "h.npz",
            labels=labels[order],
            facts=facts[order],
            prior=prior[order],
            variants=variants[:, order],
        )
        for again in (turned, Hypotheses.load(tmp_path / "h.npz")):
            assert again.facts.tolist() == facts.tolist()
            assert np.array_equal(again.tables, plain.tables)
            assert again.prior == pytest.approx(plain.prior)
    assert np.array_equal(plain.tables[0], labels)
    assert np.array_equal(plain.tables[1:], variants)


def test_transitions_that_features_cannot_tell_apart_are_left_out_with_all_that_is_of_them():
    """Transitions 0 and 2 have equal features and different labels; 1 and 3 have equal features and
    equal labels."""
    about = {
        "features": np.array([[0.0], [1.0], [0.0], [1.0], [2.0]]),
        "feature_names": ("x",),
        "phrases": tuple("abcde"),
        "states": np.arange(10).reshape(5, 2),
    }
    labels = [[1, 1, 1, 1, 1], [0, 0, 1, 0, 1], [1, 1, 0, 1, 0], [0, 0, 0, 0, 0]]
    variants = 1 - np.array([labels])
    apart = Hypotheses.of(labels, variants=variants, **about).drop_indistinguishable()
    kept = [1, 3, 4]
    assert apart.phrases == ("b", "d", "e")
    assert apart.labels.tolist() == np.array(labels)[:, kept].tolist()
    assert apart.variants.tolist() == variants[:, :, kept].tolist()
    assert apart.features.tolist() == about["features"][kept].tolist()
    assert apart.states.tolist() == about["states"][kept].tolist()
    # Without transition 4 nothing else would tell the second fact: all stay.
    few = {key: value[:4] for key, value in about.items() if key != "feature_names"}
    whole = Hypotheses.of(np.array(labels)[:, :4], **few)
    assert whole.drop_indistinguishable() is whole


@pytest.mark.parametrize(
    ("labels", "about", "said"),
    [
        ([[1, 2], [0, 1]], {}, "labels 0 and 1"),
        ([1, 0], {}, "a table"),
        ([["1"], ["0"]], {}, "a table"),
        (np.zeros((0, 1)), {}, "a table"),
        ([[1], [0], [1]], {}, "2\\^n rows"),
        ([[1], [0]], {"prior": [0.5, 0.6]}, "sum to 1"),
        ([[1], [0]], {"prior": [1.5, -0.5]}, "sum to 1"),
        ([[1], [0]], {"prior": [1.0]}, "one a candidate"),
        ([[1], [0]], {"messages": ["a", "a"]}, "all different"),
        ([[1], [0]], {"facts": [1, 2]}, "one of them empty"),
        ([[1], [0], [1]], {"facts": [0, 1, 6]}, "all subsets of each set"),
        ([[1], [0]], {"phrases": ("a", "b")}, "1 texts"),
        ([[1], [0]], {"prior": [np.nan, 1.0]}, "sum to 1"),
        ([[1], [0]], {"prior": ["much", "little"]}, "2 probabilities"),
        ([[1], [0]], {"facts": [0, -1]}, "one bitmask a row"),
        ([[1], [0]], {"facts": [0, 1, 2]}, "one bitmask a row"),
        ([[1], [0]], {"facts": [0.0, 1.0]}, "one bitmask a row"),
        ([[1], [0]], {"facts": [0, 0]}, "different sets"),
        ([[1], [0]], {"variants": [[[1, 1], [0, 0]]]}, "tables like labels"),
        ([[1], [0]], {"features": np.zeros((2, 1))}, "1 rows"),
        ([[1], [0]], {"features": np.array([[np.inf]])}, "finite numbers"),
        ([[1], [0]], {"states": np.zeros((3, 2))}, "1 rows"),
        ([[1, 0], [1, 0]], {"messages": ["rubble"]}, "rubble.*no question can separate"),
    ],
)
def test_bad_tables_are_one_line(labels, about, said):
    with refused(said):
        Hypotheses.of(labels, **about)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        (
            "more",
            {"labels": [[1], [0]], "why": np.eye(2)},
            "hypotheses='why': arrays labels, facts",
        ),
        ("other.npz", {"table": np.eye(2)}, "npz"),
        ("one.npy", np.eye(2), "npz"),
        ("text.npz", b"no arrays", "npz"),
        ("none.npz", None, "npz"),
        ("", None, "npz"),
    ],
)
def test_bad_files_are_one_line(tmp_path, name, content, said):
    with refused(said):
        Hypotheses.load(a_file(tmp_path / name, content))


class Toll(Corridor):
    """The corridor with this incorrect value of the toll. If both facts are believed incorrectly,
    models with a toll in ``refused`` (low, high) are ambiguous."""

    def __init__(self, inaccurate, refused=(0.0, 0.0)):
        super().__init__()
        end, toll = Corridor.parameters
        self.parameters = (end, replace(toll, inaccurate=inaccurate))
        self.refused = refused

    def model(self, values):
        if values["end"] == "left" and self.refused[0] < values["toll"] < self.refused[1]:
            raise DomainError("ambiguous")
        return super().model(values)


def labels_at(domain, values):
    """Returns the labels of a person who believes both facts incorrectly, at these values."""
    setting = Setting.build(domain, (UserType("one", values),))
    return setting.label_table(setting.reachable)[0, :, 0]


def test_a_variant_that_ties_is_nudged():
    """From cell 2 the way to the goal has the value toll + 0.81, and staying has 0: at half of this
    toll the two differ by 1.5e-10 of the largest possible value, at 1.01 times the half by 8e-4."""
    domain = Toll(2 * (-0.81 - 1.5e-9))
    with pytest.raises(DomainError, match="ambiguous tie"):
        labels_at(domain, {"toll": -0.81 - 1.5e-9})
    variant = Hypotheses.of_domain(domain, scales=(0.5,)).variants[0]
    assert np.array_equal(variant[0b10], labels_at(domain, {"toll": -0.8181}))
    assert np.array_equal(variant[0b11], labels_at(domain, {"end": "left", "toll": -0.8181}))


@given(st.floats(-1, 1), st.floats(0.01, 0.2), seeds)
@settings(deadline=None, max_examples=25)
def test_values_without_ties_are_the_first_nudge_that_has_none(middle, width, seed):
    half = -float(np.random.default_rng(seed).uniform(0.5, 3))
    low = half * (1 + 0.05 * middle)
    domain = Toll(2 * half, (low - width, low + width))
    tolls = [half * nudge for nudge in NUDGES]
    fine = [toll for toll in tolls if not domain.refused[0] < toll < domain.refused[1]]
    try:
        labels_at(domain, {"end": "left", "toll": 2 * half})
    except XplainError:
        return  # the hypotheses themselves are ambiguous
    transitions = Setting.build(domain, (UserType("one", {}),)).reachable
    found, labels = FactLabels(domain, transitions).without_ties(
        {"end": "left", "toll": half}, np.arange(4)
    )
    assert found == {"end": "left", "toll": fine[0] if fine else 2 * half}
    assert np.array_equal(labels[0b11], labels_at(domain, found))


def test_values_on_the_other_side_are_variants_all_at_once_and_each_alone():
    """The robot's toll is 0, and people believe in one of −5: some may believe in a gift of 5."""
    domain = Toll(-5.0)
    hypotheses = Hypotheses.of_domain(domain)
    gift = labels_at(domain, {"toll": 5.0})
    assert not np.array_equal(gift, labels_at(domain, {"toll": -5.0}))
    (of_gift,) = (own[0b10] for own in hypotheses.variants[~hypotheses.sizes[1:]])
    assert np.array_equal(of_gift, gift)
    rooms = instantiate(compose_config("observe", ["domain=four_rooms"]).domain)
    hypotheses = Hypotheses.of_domain(rooms)
    names = [parameter.name for parameter in rooms.parameters]
    opposite = hypotheses.variants[~hypotheses.sizes[1:]]
    both = sum(1 << names.index(name) for name in ("step_cost", "penalty"))
    step_cost = 1 << names.index("step_cost")
    wanted = [
        {"step_cost": -2.0, "penalty": 9.0},
        {"step_cost": -2.0, "penalty": -1.0},
        {"step_cost": 2.0, "penalty": 9.0},
    ]
    for own, held in zip(opposite, wanted, strict=True):
        assert np.array_equal(own[both], labels_at(rooms, held))
        assert np.array_equal(own[step_cost], labels_at(rooms, {"step_cost": held["step_cost"]}))
    prior = hypotheses.variant_prior
    assert prior.sum() == pytest.approx(1)
    assert prior[0] == pytest.approx(AS_ASSUMED)
    assert prior[~hypotheses.sizes].sum() == pytest.approx(OPPOSITE)


def test_labels_of_sets_that_are_listed_later_are_those_of_the_variants():
    """Candidates of one fact and of two facts together are all sets."""
    domain = Toll(2 * (-0.81 - 1.5e-9))
    every = Hypotheses.of_domain(domain)
    grown = Hypotheses.of_domain(domain, most=1).with_sets(np.array([0b11]))
    assert np.array_equal(grown.tables, every.tables)
