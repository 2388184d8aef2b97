"""Questions: their probabilities by definition, all questions if facts are few, and a search if
there are many."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xplain.domains.users.hypotheses import Hypotheses
from xplain.questions.matrix import CLOSE, QuestionMatrix

seeds = st.integers(0, 10_000)
FACTS, TRANSITIONS = 5, 6


def random_list(seed, variants=0):
    """Draws labels of all sets of at most 2 … 5 facts; each transition depends on a few facts."""
    rng = np.random.default_rng(seed)
    most = int(rng.integers(2, FACTS + 1))
    facts = np.array([f for f in range(1 << FACTS) if f.bit_count() <= most])
    about = rng.integers(1, 1 << FACTS, TRANSITIONS)
    tables = rng.integers(0, 2, (1 + variants, 1 << FACTS, TRANSITIONS), dtype=np.uint8)
    tables = tables[:, facts[:, None] & about, np.arange(TRANSITIONS)]
    tables[0, :, 0] = facts != 1  # some question tells something
    return Hypotheses.of(tables[0], facts, variants=tables[1:])


def by_definition(hypotheses, weight, transition, kept):
    """Computes Σ weight(v, R) f^v(R ∩ K)."""
    rows = hypotheses.row(hypotheses.facts & kept)
    return float((weight * hypotheses.tables[:, rows, transition]).sum())


def questions_by_definition(hypotheses, weight):
    """Computes P(label 1) of all questions: {(transition, facts without a message):
    probability}."""
    return {
        (t, kept): by_definition(hypotheses, weight, t, kept)
        for t, facts in enumerate(hypotheses.matters.tolist())
        for kept in range(1 << FACTS)
        if facts and kept & ~facts == 0
    }


@pytest.mark.parametrize("products", [1 << 26, 1])
@given(seed=seeds, variants=st.integers(0, 1), count=st.sampled_from([1, 3, 1000]))
@settings(deadline=None, max_examples=60)
def test_the_nearest_questions_are_found(seed, variants, count, products):
    """With few facts all questions are found. A search finds a question that is nearer than all
    questions with one fact more or less, or as near as the most probable candidate allows."""
    hypotheses = random_list(seed, variants)
    rng = np.random.default_rng(seed)
    weight = rng.dirichlet(np.full(hypotheses.tables[..., 0].size, 0.3))
    weight = weight.reshape(1 + variants, -1)
    every = questions_by_definition(hypotheses, weight)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("xplain.questions.matrix.PRODUCTS", products)
        matrix = QuestionMatrix.of(hypotheses)
        found = matrix.nearest(weight, 0.5, count, rng)
    pairs = {}
    for off, g, told in zip(*found, strict=True):
        for t in matrix.having(g).tolist():
            kept = int(matrix.facts[g] & ~told)
            assert int(told) & ~int(matrix.facts[g]) == 0
            assert off == pytest.approx(abs(every[t, kept] - 0.5), abs=1e-9)
            pairs[t, kept] = off
    assert sum(len(matrix.having(g)) for g in found.function) == len(pairs)  # each once
    best, least = min(pairs.values()), max(weight.max() - 0.5, 0.0)
    assert best >= least - 1e-9
    if products > 1:
        nearest = sorted(abs(value - 0.5) for value in every.values())[:count]
        distinct = {key for key in every if abs(every[key] - 0.5) <= nearest[-1]}
        assert best == pytest.approx(nearest[0], abs=1e-9)
        assert count < 1000 or distinct == set(pairs)
    elif best > least + CLOSE:
        t, kept = min(pairs, key=pairs.__getitem__)
        near = (
            abs(every[t, kept ^ 1 << j] - 0.5) for j in range(FACTS) if (t, kept ^ 1 << j) in every
        )
        assert best <= min(near) + 1e-9
