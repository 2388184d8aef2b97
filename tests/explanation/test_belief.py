"""Beliefs after labels: Bayes' rule, the labels that count as evidence, and impossible labels."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.explanation.problems import random_problem, tiny_problems
from xplain.explanation.belief import Independent, Persistent, round_belief, update
from xplain.explanation.problem import Problem
from xplain.interaction.dialogue import Dialogue, Given, Labelled
from xplain.solvers.greedy import QMDP


@settings(deadline=None, max_examples=60)
@given(tiny_problems(), st.data())
def test_belief_update_is_bayes_by_enumeration(problem: Problem, data: st.DataObject) -> None:
    """P(t | labels of the first k steps) from the joint probability of everything seen. Labels
    that no type can give leave the belief as it was."""
    n_steps = data.draw(st.integers(1, problem.n_steps))
    belief, joint, shown = problem.prior, problem.prior.copy(), 0
    for k in range(n_steps):
        shown |= data.draw(st.integers(0, (1 << problem.n_messages) - 1))
        labels = data.draw(st.sampled_from(list(product((0, 1), repeat=k + 1))))
        after = joint.copy()
        for i, label in enumerate(labels):
            p = problem.table.answered[i, shown]
            after *= p if label else 1 - p
        joint = after if after.sum() > 0 else joint
        belief = update(problem, belief, shown, np.array(labels, dtype=np.uint8))
        assert belief == pytest.approx(joint / joint.sum(), abs=1e-9)


def test_labels_that_types_cannot_give_rule_them_out_or_nobody() -> None:
    """Types a, b call the one transition explicable, c does not; d has probability 0. A label that
    no type can give leaves the belief unchanged: not uniform, not the prior, not NaN."""
    p = np.array([1.0, 1.0, 0.0, 0.5])[:, None, None]
    problem = Problem(p, np.empty(0), prior=np.array([0.2, 0.3, 0.5, 0.0]))
    no, yes = (update(problem, problem.prior, 0, np.array([label], np.uint8)) for label in (0, 1))
    assert yes == pytest.approx([0.4, 0.6, 0.0, 0.0])
    assert no.tolist() == [0.0, 0.0, 1.0, 0.0]
    before = np.array([0.4, 0.6, 0.0, 0.0])
    after = update(problem, before, 0, np.array([0], dtype=np.uint8))
    assert after.tolist() == [0.4, 0.6, 0.0, 0.0]
    after[0] = 9
    assert before[0] == 0.4


def test_a_thousand_labels_do_not_underflow() -> None:
    """Probabilities of about 1e-1000 each; the ratio is (0.1 / 0.1001) to the 1000th."""
    p = np.array([0.1, 0.1001])[:, None, None] * np.ones((1, 1000, 1))
    problem = Problem(p, np.empty(0))
    belief = update(problem, problem.prior, 0, np.ones(1000, dtype=np.uint8))
    assert belief[0] / belief[1] == pytest.approx((0.1 / 0.1001) ** 1000, rel=1e-9)


@pytest.mark.parametrize("seed", range(40))
def test_the_belief_is_that_of_the_literal_person(seed: int) -> None:
    """In the paper each label is drawn independently; people who repeat themselves have one answer
    for each transition and message set, also for copies in the trace."""
    rng = np.random.default_rng(seed)
    copies = np.array([rng.integers(i + 1) for i in range(5)])
    copies = copies[copies]  # the first of all equal ones
    while (copies[copies] != copies).any():
        copies = copies[copies]
    p = rng.uniform(0.1, 0.9, (3, 5, 4))[:, copies]
    problem = Problem(p, np.zeros(2), copies=copies)
    for way, repeats in ((Independent(), False), (Persistent(), True)):
        talk = Dialogue(problem, QMDP().plan(problem), way)
        answers: dict[tuple[int, ...], int] = {}
        for k in range(5):
            new = int(rng.integers(4)) & ~talk.state.visible.given if rng.random() < 0.4 else 0
            talk.hear(Given(new))
            said, labels = talk.state.visible.given, []
            for i in range(k + 1):
                key = (int(copies[i]), said) if repeats else (i, said, k)
                labels.append(answers.setdefault(key, int(rng.integers(2))))
            talk.hear(Labelled(tuple(labels)))
        posterior = problem.prior
        for (i, said, *_), answer in answers.items():
            posterior = posterior * (p[:, i, said] if answer else 1 - p[:, i, said])
        np.testing.assert_allclose(talk.state.belief, posterior / posterior.sum(), rtol=1e-9)


def test_rounding_makes_beliefs_equal_whatever_the_order_of_evidence() -> None:
    rng = np.random.default_rng(0)
    problem = Problem(rng.random((3, 6, 1)), np.empty(0))
    labels = rng.integers(0, 2, 6).astype(np.uint8)
    beliefs = []
    for order in (range(6), reversed(range(6))):
        belief = problem.prior
        for i in order:
            belief = update(problem, belief, 0, labels, slice(i, i + 1))
        beliefs.append(belief)
    assert np.array_equal(round_belief(beliefs[0]), round_belief(beliefs[1]))
    assert round_belief(beliefs[0]) == pytest.approx(beliefs[0], abs=1e-12)
    assert not np.array_equal(round_belief(np.array([0.5])), round_belief(np.array([0.5 + 1e-11])))


def test_who_cannot_tell_says_nothing() -> None:
    """After a label 2 the belief is the same as after the other labels alone."""
    rng = np.random.default_rng(1)
    for _ in range(40):
        problem = random_problem(rng)
        labels = rng.integers(3, size=problem.n_steps).astype(np.uint8)
        shown = int(rng.integers(1 << problem.n_messages))
        after = update(problem, problem.start, shown, labels)
        alone = update(problem, problem.start, shown, labels, labels < 2)
        assert after == pytest.approx(alone, abs=1e-12)
