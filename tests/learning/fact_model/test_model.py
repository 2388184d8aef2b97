"""The generative model's priors and likelihoods, by hand."""

from collections import Counter
from math import comb

import numpy as np
import pytest

from xplain.learning.mixture import sampler as facts


@pytest.mark.parametrize(("n", "depth"), [(6, 3), (5, 5), (2, 4), (9, 1)])
def test_each_further_fact_that_matters_halves_the_prior_of_a_size(n: int, depth: int) -> None:
    tables = facts.Prior.of(n, depth)
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
    tables = facts.Prior.of(2, 2)
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
