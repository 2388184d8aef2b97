"""Questions about many facts: the same probabilities as the tables', and no better one next to
those found."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xplain.domains.users.hypotheses import Hypotheses
from xplain.questions.matrix import Interactions, QuestionMatrix, questions_of

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
    assert isinstance(questions_of(hypotheses), QuestionMatrix) == every
    weight = np.random.default_rng(seed).random((1, len(hypotheses.facts)))
    middle = weight.sum() / 2
    best = QuestionMatrix.of(hypotheses).nearest(weight, middle, 1).off.min()
    assert Interactions.of(hypotheses).nearest(weight, middle, 1).off.min() >= best - 1e-9


def test_where_questions_are_too_many_for_a_matrix_they_are_searched(monkeypatch):
    hypotheses = Hypotheses.of(np.random.default_rng(0).integers(0, 2, (1 << FACTS, 4)))
    assert isinstance(questions_of(hypotheses), QuestionMatrix)
    monkeypatch.setattr("xplain.questions.matrix.MAX_CELLS", 100)
    assert isinstance(questions_of(hypotheses), Interactions)
