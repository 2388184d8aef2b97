"""Tests every pair of compatible features of an explanation: on random small problems the belief is
the literal POMDP's, the bounds hold, and a session restored from text continues like one that never
stopped."""

from collections import Counter
from functools import cache
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from sklearn.tree import DecisionTreeClassifier

from tests.decisions import belief_over_rows, states_after
from xplain import (
    Clustering,
    Dataset,
    Explainer,
    GivenTypes,
    Independent,
    LabelerTrainer,
    LabelTable,
    LearnedTypes,
    Limits,
    Persistent,
    Question,
    Session,
)
from xplain.explanation.actions import AskQuestion, GiveMessages
from xplain.explanation.message_sets import indices
from xplain.interaction.dialogue import (
    Dialogue,
    QuestionAnswered,
    StepLabelled,
)
from xplain.learning.user_types import learn_types
from xplain.solvers.bounds import bounds
from xplain.solvers.evaluate import evaluate
from xplain.solvers.greedy import QMDP
from xplain.solvers.hsvi import Certified, Effort
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.pomcp import POMCP
from xplain.solvers.simple import QHR, AskFirst
from xplain.testing.literal_pomdp import EXPLAIN, LiteralPOMDP

FEATURES = (
    "questions",
    "errors",
    "missed messages",
    "many messages",
    "own table",
    "growing trace",
    "persistent belief",
    "learned types",
    "discount per step",
)
SITUATIONS = [
    tuple(FEATURES["qemnogpld".index(letter)] for letter in letters)
    for letters in ["qenld", "emnpl", "emogd", "nogpd", "qmgpl", "qeopd", "qmnog", "emgld"]
]
SOLVERS = [
    QMDP(),
    POMCP(simulations=100),
    Certified(nodes=50),
    Lookahead(),
    QHR(),
    AskFirst(),
]
TRANSITIONS, MANY = 8, 40


def test_every_two_features_meet_twice() -> None:
    met = Counter(pair for one in SITUATIONS for pair in combinations(one, 2))
    impossible = ("own table", "learned types")
    assert all(met[pair] >= 2 for pair in combinations(FEATURES, 2) if pair != impossible)


@cache
def learned_types(messages: int) -> LearnedTypes:
    """Makes two types, learned from labels. If a transition's feature is large, one type needs the
    first message, the other type the second."""
    rng = np.random.default_rng(0)
    transition, observer = rng.integers(TRANSITIONS, size=500), rng.integers(4, size=500)
    given = rng.integers(4, size=500)
    needed = (transition > 3) & (given >> (observer // 2) & 1 == 0)
    data = Dataset(
        np.arange(TRANSITIONS, dtype=float)[:, None],
        ("feature",),
        tuple(f"m{j}" for j in range(messages)),
        ("a", "b", "c", "d"),
        observer,
        transition,
        given,
        1 - needed.astype(np.uint8),
    )
    clustering = Clustering(np.array([0, 0, 1, 1]), "given", "given")
    types = learn_types(data, clustering, LabelerTrainer(DecisionTreeClassifier()), 0)
    return LearnedTypes.of(types, data)


def given_types(rng: np.random.Generator, messages: int, own: bool) -> GivenTypes:
    """Makes three types whose labels depend on two messages each, for numbered transitions or a
    user's own transitions."""
    relevant = np.array([np.sort(rng.choice(messages, 2, replace=False)) for _ in range(3)])
    table = LabelTable.by_type(relevant, rng.choice([0.05, 0.3, 0.95], (3, TRANSITIONS, 4)))
    names = tuple(f"m{j}" for j in range(messages)), ("x", "y", "z")
    if own:
        return GivenTypes(lambda steps: table.of_steps([s["number"] for s in steps]), *names)
    return GivenTypes(table if messages == MANY else table.array(messages), *names)


class Situation:
    """An explanation with some features, and somebody who answers at random. A transition comes
    twice, and is asked about."""

    def __init__(self, features: tuple[str, ...], seed: int) -> None:
        self.features, rng = features, np.random.default_rng(seed)
        messages = MANY if "many messages" in features else 3
        known, own = "learned types" in features, "own table" in features
        types = learned_types(messages) if known else given_types(rng, messages, own)
        rows = rng.integers(TRANSITIONS, size=6)
        rows[2] = rows[0]
        self.transitions: list[Any] = [
            [float(i)] if known else {"number": i} if own else i for i in rows.tolist()
        ]
        way = Persistent if "persistent belief" in features else Independent
        missed = (0.7, 0.2 * (seed % 2)) if "missed messages" in features else (1.0, 0.0)
        self.explainer = Explainer(
            types,
            SOLVERS[(len(features[0]) + seed) % len(SOLVERS)],
            trade_off=(0.3, 3.0)[seed // 2 % 2],
            discount=0.9,
            discount_per="step" if "discount per step" in features else "action",
            belief_update=way(0.1 if "errors" in features else 0.0, *missed),
            ask=Limits(cost=0.02, most=2) if "questions" in features else None,
        )

    def play(self, seed: int, restored: bool) -> tuple[Session, list[Any]]:
        """Plays a session to its end; returns it with its answers to every request."""
        rng, seen = np.random.default_rng(seed), list[Any]()
        clips = self.transitions[1:4] if "questions" in self.features else []
        grows = "growing trace" in self.features
        session = self.explainer.session(self.transitions[: 2 if grows else 3], clips=clips)
        ahead = self.transitions[2:3] if grows else []
        while not session.finished:
            move = session.next()
            if restored:
                session = self.explainer.from_json(session.to_json())
            seen.append((move, session.belief, session.said, session.cost, str(session.why())))
            if ahead and (session.shown == 2 or rng.random() < 0.5):
                session.extend(ahead)
                ahead = []
            elif isinstance(move, Question):
                session.answer(int(rng.integers(2)))
            else:
                session.observe(rng.integers(2, size=move.steps))
            if restored:
                session = self.explainer.from_json(session.to_json())
        return session, seen


def literal_belief(talk: Dialogue) -> NDArray[np.float64] | None:
    """Computes the belief [rows, N] by Bayes' rule over the states of the literal POMDP; None if no
    state gives these answers. People who repeat themselves answer about a transition once while
    their knowledge is the same: their other labels are ignored."""
    problem, pomdp = talk.problem, LiteralPOMDP(talk.problem)
    states, asked, heard = pomdp.initial(), 0, set[int]()
    repeats = not talk.belief_update.fresh_labels

    for event in talk.events:
        match event:
            case AskQuestion(question):
                asked = question
            case QuestionAnswered(answer):
                states = states_after(pomdp, states, EXPLAIN - 1 - asked, (answer,))
                shown = problem.questions.shows[asked]
                heard |= set(problem.copies[: len(shown)][shown].tolist())
            case GiveMessages(messages):
                for j in indices(messages):
                    states = states_after(pomdp, states, j)
                heard = set()
            case StepLabelled(labels):
                news: list[int | None] = []
                for label, copy in zip(labels, problem.copies.tolist(), strict=False):
                    news.append(None if repeats and copy in heard else label)
                    heard.add(copy)
                states = states_after(pomdp, states, EXPLAIN, tuple(news))
                heard = set() if problem.habits.forget.any() else heard
    return belief_over_rows(problem, states) if states else None


@pytest.mark.parametrize("features", SITUATIONS, ids="+".join)
def test_a_restored_session_goes_on_and_its_belief_and_bounds_are_right(
    features: tuple[str, ...],
) -> None:
    for seed in range(4):
        situation = Situation(features, seed)
        _, whole = situation.play(seed, restored=False)
        session, again = situation.play(seed, restored=True)
        assert again == whole
        assert len(session.trace) == 3
        talk = session._talk
        expected = literal_belief(talk)
        if expected is not None:
            own = talk.state.belief.reshape(-1, talk.problem.n_types)
            assert own.sum(axis=0) == pytest.approx(expected.sum(axis=0), abs=1e-9)
            if not talk.problem.messages_land:
                assert own == pytest.approx(expected, abs=1e-9)
        found = bounds(talk.problem, Effort(nodes=60))
        value = evaluate(talk.problem, QMDP().plan(talk.problem), episodes=20)
        assert found.lower <= found.upper + 1e-9
        assert found.upper <= found.known_type + 1e-9
        assert value.value <= found.upper + 1e-9 + 4 * value.value_se
