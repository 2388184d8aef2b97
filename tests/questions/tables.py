"""Small hypotheses, and Bayes' rule written out."""

from itertools import product

import numpy as np

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


def worlds(hypotheses: Hypotheses, error: float, none: float):
    """Lists every (table, fact set, error) by which a person may answer, with its prior."""
    tables = [hypotheses.labels, *hypotheses.variants]
    chances = (1 - none) * hypotheses.variant_prior
    for table, chance in zip(tables, chances, strict=True):
        for facts, prior in zip(hypotheses.facts.tolist(), hypotheses.prior, strict=True):
            yield table, facts, error, chance * prior
    for facts, prior in zip(hypotheses.facts.tolist(), hypotheses.prior, strict=True):
        yield hypotheses.labels, facts, NONE_ERROR, none * prior


def likelihood(hypotheses, table, facts, error, misread, transitions, told, labels):
    """Computes P(labels of a clip | a world)."""
    row = hypotheses.facts.tolist().index(facts & ~told)
    right = 1.0
    for transition, label in zip(transitions, labels, strict=True):
        right *= 1 - error if table[row, transition] == label else error
    return (1 - misread) * right + misread * 0.5 ** len(labels)


def joint(hypotheses, error, none, misread, answers):
    """Computes P(world, answers so far) of every world; answers are (transitions, told, labels)."""
    found = []
    for table, facts, rate, chance in worlds(hypotheses, error, none):
        for transitions, told, labels in answers:
            chance *= likelihood(hypotheses, table, facts, rate, misread, transitions, told, labels)
        found.append(chance)
    return np.array(found) / sum(found)


def information(hypotheses, error, none, misread, weight, transitions, told):
    """Computes I(answer; world) in bits, by its definition. A world is (variant, candidate), or a
    candidate whom no hypothesis fits."""
    total = 0.0
    for labels in product((0, 1), repeat=len(transitions)):
        given = np.array(
            [
                likelihood(hypotheses, table, facts, rate, misread, transitions, told, labels)
                for table, facts, rate, _ in worlds(hypotheses, error, none)
            ]
        )
        marginal = (weight * given).sum()
        some = (weight > 0) & (given > 0)
        total += (weight * given)[some] @ np.log2(given[some] / marginal)
    return total
