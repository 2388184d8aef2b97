"""Compares episodes with Definition 2 of the paper and with Bayes' rule."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xplain.explanation.actions import Action, VisibleState, give
from xplain.explanation.belief import Independent, Persistent
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.interaction.episode import explain
from xplain.interaction.explainees import SimulatedUser
from xplain.solvers.base import CachedPolicy


class Scripted:
    """A policy that gives the messages of a list."""

    def __init__(self, messages: list[int]) -> None:
        self.script = messages

    def decide(self, visible: VisibleState, belief: np.ndarray) -> Action:
        return give(self.script[visible.step] & ~visible.given)

    def values(self, visible: VisibleState, belief: np.ndarray) -> dict[Action, float]:
        return {}


@st.composite
def interactions(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    types, steps, n = rng.integers(1, 4), rng.integers(1, 6), rng.integers(0, 4)
    problem = Problem(
        table=rng.uniform(0.02, 0.98, (types, steps, 1 << n)),
        message_cost=rng.uniform(0, 2, n),
        inexplicability_cost=float(rng.uniform(0, 2)),
        trade_off=float(rng.uniform(0, 3)),
        prior=rng.dirichlet(np.ones(types)),
    )
    table = rng.integers(0, 2, (steps, 1 << n)).astype(np.uint8)
    script = [int(mask) for mask in rng.integers(0, 1 << n, steps)]
    return problem, table, script


@given(interactions(), st.sampled_from([Independent(), Persistent()]))
@settings(max_examples=80, deadline=None)
def test_cost_is_definition_2_and_beliefs_are_bayes(interaction, way):
    """The belief follows from all labels, or from the labels that were not given before with the
    same messages."""
    problem, table, script = interaction
    episode = explain(problem, CachedPolicy(Scripted(script)), SimulatedUser.of(table), way)
    total, zeros, weight = 0.0, 0, problem.prior.copy()
    given_so_far, seen = set[int](), set[tuple[int, int]]()
    for i in range(problem.n_steps):
        new = {j for j in range(problem.n_messages) if script[i] >> j & 1} - given_so_far
        given_so_far |= new
        total += problem.trade_off * sum(problem.message_cost[j] for j in new)
        mask = sum(1 << j for j in given_so_far)
        for j in range(i + 1):
            zeros += 1 - int(table[j, mask])
            total += (1 - int(table[j, mask])) * problem.inexplicability_cost
            if (j, mask) not in seen:
                p = problem.p_explicable[:, j, mask]
                weight = weight * (p if table[j, mask] else 1 - p)
                seen |= {(j, mask)} if way == Persistent() else set()
        np.testing.assert_allclose(episode.beliefs[i + 1], weight / weight.sum(), rtol=1e-9)
        asked = table[: i + 1, mask].tolist()
        assert episode.labels[i].tolist() == asked + [-1] * (problem.n_steps - i - 1)
        assert episode.messages[i] == sum(1 << j for j in new)
    assert episode.cost == pytest.approx(total)
    assert episode.communication == pytest.approx(
        sum(problem.message_cost[j] for j in given_so_far)
    )
    assert episode.inexplicability == pytest.approx(zeros * problem.inexplicability_cost)
    assert episode.n_messages == len(given_so_far)
    assert episode.n_inexplicable == zeros


class Careless(Scripted):
    """A policy that repeats its messages."""

    def decide(self, visible: VisibleState, belief: np.ndarray) -> Action:
        return give(self.script[visible.step])


@pytest.mark.parametrize("script", [[1, 1], [4, 0]])
def test_a_policy_that_repeats_or_invents_messages_is_caught(script):
    problem = Problem(np.full((1, 2, 4), 0.5), np.ones(2))
    with pytest.raises(ValueError, match="policy gave message set"):
        explain(
            problem,
            CachedPolicy(Careless(script)),
            SimulatedUser.of(np.ones((2, 4))),
            Independent(),
        )


@given(interactions())
@settings(max_examples=20, deadline=None)
def test_a_user_answers_alike_whatever_messages_the_table_is_over(interaction):
    problem, table, script = interaction
    whole = LabelTable.dense(table[None])
    one, other = (
        explain(problem, CachedPolicy(Scripted(script)), SimulatedUser(labels), Independent())
        for labels in (whole, whole.select_messages(whole.effective()))
    )
    assert np.array_equal(one.labels, other.labels)
    assert one.cost == other.cost
