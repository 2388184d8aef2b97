"""Questions about many facts: the same probabilities as the tables', and no better one next to
those found."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xplain.domains.users.hypotheses import Hypotheses
from xplain.questions.expectation import AllQuestions, groups, questions_of
from xplain.questions.interactions import Interactions

seeds = st.integers(0, 10_000)
FACTS, TRANSITIONS = 5, 6


def random_list(seed, variants=0):
    """Labels at random of all sets of at most 2 … 5 facts, each transition of its own few."""
    rng = np.random.default_rng(seed)
    most = int(rng.integers(2, FACTS + 1))
    facts = np.array([f for f in range(1 << FACTS) if f.bit_count() <= most])
    about = rng.integers(1, 1 << FACTS, TRANSITIONS)
    tables = rng.integers(0, 2, (1 + variants, 1 << FACTS, TRANSITIONS), dtype=np.uint8)
    tables = tables[:, facts[:, None] & about, np.arange(TRANSITIONS)]
    tables[0, :, 0] = facts != 1  # some question tells something
    return Hypotheses.of(tables[0], facts, variants=tables[1:])


def by_definition(hypotheses, weight, transition, kept):
    """Σ weight(v, R) f^v(R ∩ K)."""
    rows = hypotheses.row(hypotheses.facts & kept)
    return float((weight * hypotheses.tables[:, rows, transition]).sum())


@given(seeds, st.integers(0, 2))
@settings(deadline=None)
def test_expected_labels_are_those_of_the_tables(seed, variants):
    hypotheses = random_list(seed, variants)
    weight = np.random.default_rng(seed).random((1 + variants, len(hypotheses.facts)))
    sparse = Interactions.of(hypotheses)
    function = {t: g for g, own in enumerate(sparse.transitions) for t in own.tolist()}
    covered = set()
    for group in groups(hypotheses):
        dense = group.expected(weight)
        for row, kept in enumerate(group.facts.tolist()):
            found = sparse.expected(weight, np.full(len(sparse.transitions), kept))
            for g, own in enumerate(group.transitions):
                for t in own.tolist():
                    assert found[function[t]] == pytest.approx(dense[row, g], abs=1e-9)
                    covered.add(t)
    assert covered == set(function)


@given(seeds, st.integers(0, 1))
@settings(deadline=None)
def test_no_question_that_differs_in_one_message_tells_more(seed, variants):
    hypotheses = random_list(seed, variants)
    weight = np.random.default_rng(seed).random((1 + variants, len(hypotheses.facts)))
    middle = weight.sum() / 2
    sparse = Interactions.of(hypotheses)
    found = sparse.nearest(weight, middle, 1)
    assert set(found.function.tolist()) == set(range(len(sparse.transitions)))
    for off, g, told in zip(*found, strict=True):
        facts, transition = int(sparse.facts[g]), int(sparse.transitions[g][0])
        kept = facts & ~int(told)
        assert int(told) & ~facts == 0
        value = by_definition(hypotheses, weight, transition, kept)
        assert off == pytest.approx(abs(value - middle), abs=1e-9)
        for j in range(FACTS):
            other = by_definition(hypotheses, weight, transition, kept ^ 1 << j)
            assert abs(other - middle) >= off - 1e-8


@given(seeds)
@settings(deadline=None)
def test_where_all_sets_are_listed_all_questions_are_weighed(seed):
    hypotheses = random_list(seed)
    every = len(hypotheses.facts) == 1 << FACTS
    assert isinstance(questions_of(hypotheses), AllQuestions) == every
    weight = np.random.default_rng(seed).random((1, len(hypotheses.facts)))
    middle = weight.sum() / 2
    best = AllQuestions(groups(hypotheses)).nearest(weight, middle, 1).off.min()
    assert Interactions.of(hypotheses).nearest(weight, middle, 1).off.min() >= best - 1e-9
