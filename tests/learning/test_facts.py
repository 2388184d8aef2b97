"""The generative model's priors and likelihoods, by hand."""

from collections import Counter
from math import comb

import numpy as np
import pytest

from tests.learning.conftest import made
from xplain.learning.fact_model import model as facts


@pytest.mark.parametrize(("n", "depth"), [(6, 3), (5, 5), (2, 4), (9, 1)])
def test_each_further_fact_that_matters_halves_the_prior_of_a_size(n: int, depth: int) -> None:
    tables = facts.Tables.of(n, depth)
    mass: Counter[int] = Counter()
    number: Counter[int] = Counter()
    seen = set()
    for positions, log_prior in zip(tables.subsets, tables.log_subset, strict=True):
        members = frozenset(int(j) for j in positions if j >= 0)
        mass[len(members)] += np.exp(log_prior)
        number[len(members)] += 1
        seen.add(members)
        # Within a size all subsets are alike.
        assert np.exp(log_prior) * comb(n, len(members)) == pytest.approx(
            np.exp(tables.log_subset[0]) * 0.5 ** len(members)
        )
    deepest = min(n, depth)
    assert len(seen) == len(tables.subsets)
    assert number == {k: comb(n, k) for k in range(deepest + 1)}
    whole = sum(0.5**k for k in range(deepest + 1))
    assert mass == pytest.approx({k: 0.5**k / whole for k in range(deepest + 1)})


@pytest.mark.parametrize(("ones", "zeros"), [(0, 0), (3, 1), (0, 5), (40, 2)])
def test_a_cells_next_label_follows_bayes_rule(ones: int, zeros: int) -> None:
    tables = facts.Tables.of(2, 2)
    for empty in (0, 1):
        for e, noise in enumerate(facts.NOISE):
            prior = facts.CELL[empty]
            if_one = (1 - noise) ** ones * noise**zeros
            if_zero = noise**ones * (1 - noise) ** zeros
            is_one = prior * if_one / (prior * if_one + (1 - prior) * if_zero)
            next_one = is_one * (1 - noise) + (1 - is_one) * noise
            row = facts.REACH + ones - zeros
            found = np.exp(tables.predictive[empty, e, row])
            assert found == pytest.approx([1 - next_one, next_one])
            evidence = prior * if_one + (1 - prior) * if_zero
            assert tables.marginal[empty, e, row] == pytest.approx(np.log(evidence / if_one))


def test_cells_count_ones_less_zeros_of_what_is_still_held_wrong(rng: np.random.Generator) -> None:
    dataset, truth = made(rng, [[0, 1], [2]], size=60)
    answers, tables = facts.Answers.of(dataset), facts.Tables.of(4, 2)
    held = np.array([0b0011, 0b0100])[truth]
    subset = rng.integers(len(tables.subsets), size=len(dataset.features))
    state = facts.State(held, subset, np.zeros_like(subset), 0.0)
    expected = np.zeros((len(subset), 4), dtype=int)
    for o, t, given, label in zip(
        dataset.observer, dataset.transition, dataset.message_set, dataset.label, strict=True
    ):
        wrong = int(held[o]) & ~int(given)
        members = [int(j) for j in tables.subsets[subset[t]] if j >= 0]
        cell = sum(1 << i for i, j in enumerate(members) if wrong >> j & 1)
        expected[t, cell] += 1 if label else -1
    assert (facts.cells(answers, tables, state) == expected).all()


def test_the_likelihood_of_labels_follows_the_answers_in_their_cell() -> None:
    tables = facts.Tables.of(2, 2)
    pair = next(z for z, one in enumerate(tables.subsets.tolist()) if one == [0, 1])
    state = facts.State(np.zeros(0, dtype=np.int64), np.array([pair]), np.array([2]), 0.0)
    # Cells by the facts still held wrong: none, fact 0, fact 1, both.
    ahead = np.array([[4, -3, 0, 200]])
    who = np.array([0b00, 0b01, 0b11])
    given, label = np.array([0b00, 0b00, 0b01]), np.array([1, 0, 1])
    found = facts.log_likelihood(
        tables, state, ahead, who, np.zeros(3, dtype=np.int64), given, label
    )
    cells = [[0, 0, 0], [1, 1, 0], [3, 3, 2]]  # of each person's three labels
    for person, own in enumerate(cells):
        for p, cell in enumerate(own):
            lead = min(int(ahead[0, cell]), facts.REACH) + facts.REACH
            expected = tables.predictive[int(cell == 0), 2, lead, label[p]]
            assert found[person, p] == pytest.approx(expected)
