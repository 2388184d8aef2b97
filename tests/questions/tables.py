"""Small hypotheses, and Bayes' rule written out."""

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.domains.users.hypotheses import Hypotheses
from xplain.questions.questionnaire import NONE_ERROR


def random_hypotheses(seed: int, facts: int = 3, transitions: int = 5, variants: int = 0, **about):
    """Draws random tables of labels; ``about`` are further arguments of the hypotheses."""
    rng = np.random.default_rng(seed)
    shape = (1 << facts, transitions)
    more = rng.integers(0, 2, (variants, *shape), dtype=np.uint8)
    labels = rng.integers(0, 2, shape)
    while (labels == labels[0]).all():  # one in 2^9 of the smallest tables tells nothing
        labels = rng.integers(0, 2, shape)
    return Hypotheses.of(labels, variants=more, **about)


class Rates(NamedTuple):
    """P(an answer is wrong), P(no hypothesis fits), P(a clip is misread); by transition P(0 | label
    1) and P(1 | label 0), if people slip and guess."""

    error: float
    none: float
    misread: float = 0.0
    slip: NDArray[np.float64] | None = None
    guess: NDArray[np.float64] | None = None


def worlds(hypotheses: Hypotheses, rates: Rates):
    """Lists every (table, fact set, error) by which a person may answer, with its prior."""
    chances = [*((1 - rates.none) * hypotheses.variant_prior), rates.none]
    tables = [hypotheses.labels, *hypotheses.variants, hypotheses.labels]
    errors = [rates.error] * (len(tables) - 1) + [NONE_ERROR]
    for table, chance, error in zip(tables, chances, errors, strict=True):
        for facts, prior in zip(hypotheses.facts.tolist(), hypotheses.prior, strict=True):
            yield table, facts, error, chance * prior


def likelihood(hypotheses, table, facts, error, rates, transitions, told, labels):
    """Computes P(labels of a clip | a world)."""
    row = hypotheses.facts.tolist().index(facts & ~told)
    right = 1.0
    for transition, label in zip(transitions, labels, strict=True):
        one = float(table[row, transition])
        if rates.slip is not None:
            one = 1 - rates.slip[transition] if one else rates.guess[transition]
        one = (1 - error) * one + error * (1 - one)
        right *= one if label else 1 - one
    return (1 - rates.misread) * right + rates.misread * 0.5 ** len(labels)


def joint(hypotheses, rates, answers):
    """Computes P(world, answers so far) of every world; answers are (transitions, told, labels)."""
    found = []
    for table, facts, error, chance in worlds(hypotheses, rates):
        for answer in answers:
            chance *= likelihood(hypotheses, table, facts, error, rates, *answer)
        found.append(chance)
    return np.array(found) / sum(found)


def information(hypotheses, rates, weight, transitions, told):
    """Computes I(answer; world) in bits, by its definition. A world is (variant, candidate), or a
    candidate whom no hypothesis fits."""
    total = 0.0
    for labels in product((0, 1), repeat=len(transitions)):
        given = np.array(
            [
                likelihood(hypotheses, table, facts, error, rates, transitions, told, labels)
                for table, facts, error, _ in worlds(hypotheses, rates)
            ]
        )
        marginal = (weight * given).sum()
        some = (weight > 0) & (given > 0)
        total += (weight * given)[some] @ np.log2(given[some] / marginal)
    return total
