"""Hypotheses: which candidates behave alike, what a question's answer is expected to be, files."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.questions.tables import random_hypotheses
from xplain.errors import DomainError, InputError
from xplain.questions.expectation import groups
from xplain.questions.hypotheses import Hypotheses
from xplain.users.setting import Setting, UserType

seeds = st.integers(0, 10_000)


def every_label(hypotheses, row):
    """The labels of a candidate for all questions, by the definition."""
    facts = hypotheses.facts.tolist()
    sets = range(1 << hypotheses.n_messages)
    return [hypotheses.labels[facts.index(facts[row] & ~told)].tolist() for told in sets]


def few_facts(seed):
    """Labels that depend on some facts only, and candidates of at most two."""
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
    labels, facts = few_facts(seed)
    hypotheses = Hypotheses.of(labels, facts) if labels.min() == 0 else random_hypotheses(seed)
    said = [every_label(hypotheses, row) for row in range(len(hypotheses.facts))]
    for i, one in enumerate(said):
        for j, other in enumerate(said):
            assert (one == other) == (hypotheses.classes[i] == hypotheses.classes[j])


@given(seeds)
@settings(deadline=None)
def test_the_essential_facts_are_the_smallest_candidate_that_behaves_alike(seed):
    labels, facts = few_facts(seed)
    hypotheses = Hypotheses.of(labels, facts) if labels.min() == 0 else random_hypotheses(seed)
    for essential, own in zip(hypotheses.essential, hypotheses.classes, strict=True):
        members = hypotheses.facts[hypotheses.classes == own]
        assert essential == np.bitwise_and.reduce(members)
        assert essential in members


@given(seeds, st.integers(0, 2))
@settings(deadline=None)
def test_expected_labels_are_the_sum_over_candidates(seed, variants):
    hypotheses = random_hypotheses(seed, variants=variants)
    weight = np.random.default_rng(seed).random((1 + variants, 8))
    tables = [hypotheses.labels, *hypotheses.variants]
    covered = set()
    for group in groups(hypotheses):
        expected = group.expected(weight)
        for g, transitions in enumerate(group.transitions):
            for kept, facts in enumerate(group.facts.tolist()):
                for t in transitions.tolist():
                    told = int(group.facts[-1]) & ~facts
                    plain = sum(
                        weight[v, held] * table[held & ~told, t]
                        for v, table in enumerate(tables)
                        for held in range(8)
                    )
                    assert expected[kept, g] == pytest.approx(plain, abs=1e-12)
                    covered.add(t)
    assert covered == set(np.flatnonzero(hypotheses.matters).tolist())


def test_of_a_domain_they_are_the_labels_of_its_inaccurate_values(corridor):
    hypotheses = Hypotheses.of_domain(corridor)
    names = [parameter.name for parameter in corridor.parameters]
    wrong = {parameter.name: parameter.inaccurate for parameter in corridor.parameters}
    for row, facts in enumerate(hypotheses.facts.tolist()):
        held = {name: wrong[name] for j, name in enumerate(names) if facts >> j & 1}
        setting = Setting.build(corridor, (UserType("one", held),))
        table = setting.label_table(setting.reachable)[0]
        assert np.array_equal(table[:, 0], hypotheses.labels[row])


def test_sets_of_few_facts_are_those_rows_of_all(corridor):
    every, few = Hypotheses.of_domain(corridor), Hypotheses.of_domain(corridor, most=1)
    assert few.facts.tolist() == [f for f in every.facts.tolist() if f.bit_count() <= 1]
    assert np.array_equal(few.labels, every.labels[every.row(few.facts)])


def test_a_file_holds_all_of_them(tmp_path, corridor):
    made = Hypotheses.of_domain(corridor)
    made.save(tmp_path / "h.npz")
    read = Hypotheses.load(tmp_path / "h.npz")
    for name in ("labels", "facts", "prior", "features", "states", "variants"):
        assert np.array_equal(getattr(made, name), getattr(read, name))
    for name in ("messages", "feature_names", "phrases"):
        assert getattr(made, name) == getattr(read, name)


def test_a_file_of_labels_alone_is_enough(tmp_path):
    labels = np.array([[1, 1], [0, 1], [1, 0], [0, 0]])
    np.savez(tmp_path / "h.npz", labels=labels)
    read = Hypotheses.load(tmp_path / "h.npz")
    assert read.messages == ("fact_0", "fact_1")
    assert np.array_equal(read.labels, labels)
    assert read.prior.tolist() == [0.25] * 4


@pytest.mark.parametrize(
    ("labels", "about", "said"),
    [
        ([[1, 2], [0, 1]], {}, "labels 0 and 1"),
        ([1, 0], {}, "a table"),
        ([[1], [0], [1]], {}, "2\\^n rows"),
        ([[1], [0]], {"prior": [0.5, 0.6]}, "sum to 1"),
        ([[1], [0]], {"prior": [1.5, -0.5]}, "sum to 1"),
        ([[1], [0]], {"prior": [1.0]}, "one a candidate"),
        ([[1], [0]], {"messages": ["a", "a"]}, "all different"),
        ([[1], [0]], {"facts": [1, 2]}, "the empty one"),
        ([[1], [0], [1]], {"facts": [0, 1, 6]}, "all of its subsets"),
        ([[1], [0]], {"phrases": ("a", "b")}, "1 texts"),
        ([[1, 0], [1, 0]], {"messages": ["rubble"]}, "rubble.*cannot be told apart"),
    ],
)
def test_bad_tables_are_one_line(labels, about, said):
    with pytest.raises(InputError, match=said) as caught:
        Hypotheses.of(labels, **about)
    assert "\n" not in str(caught.value)


def test_bad_files_are_one_line(tmp_path):
    text, other = tmp_path / "text.npz", tmp_path / "other.npz"
    text.write_text("no arrays")
    np.savez(other, table=np.eye(2))
    for path in (text, other, tmp_path / "none.npz"):
        with pytest.raises(InputError, match="npz") as caught:
            Hypotheses.load(path)
        assert "\n" not in str(caught.value)


def test_a_variant_that_cannot_be_solved_is_left_out(corridor, monkeypatch):
    solved = Setting.build
    calls = []

    def build(domain, types):
        calls.append(types)
        if len(calls) == 2:
            raise DomainError("ambiguous")
        return solved(domain, types)

    monkeypatch.setattr(Setting, "build", build)
    assert len(Hypotheses.of_domain(corridor, scales=(0.5, 2.0)).variants) == 1
