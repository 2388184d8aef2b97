"""Tests every pair of compatible features of an explanation: on random small problems the belief is
the literal POMDP's, the bounds hold, and a session restored from text continues like one that never
stopped."""

from __future__ import annotations

from functools import cache
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from sklearn.tree import DecisionTreeClassifier

from xplain import Explainer, GivenTypes, LabelTable, LearnedTypes
from xplain.explanation.asking import Limits, Question
from xplain.explanation.belief import Independent, Persistent
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem
from xplain.interaction.dialogue import Answered, Asked, Event, Given, Labelled
from xplain.interaction.session import Session
from xplain.learning.data.dataset import Dataset
from xplain.learning.labelers import LabelerTrainer
from xplain.learning.types import Clustering
from xplain.learning.user_types import learn_types
from xplain.solvers.bounds import bounds
from xplain.solvers.evaluate import evaluate
from xplain.solvers.greedy import QMDP
from xplain.solvers.hsvi import Certified, Effort
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.pomcp import POMCP
from xplain.solvers.simple import QHR, AskFirst
from xplain.testing.literal_pomdp import EXPLAIN, LiteralPOMDP, LiteralState

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
PAIRS = [pair for pair in combinations(FEATURES, 2) if pair != ("own table", "learned types")]
SOLVERS = [
    QMDP(),
    POMCP(simulations=100),
    Certified(nodes=50),
    Lookahead(),
    QHR(),
    AskFirst(),
]
TRANSITIONS, MANY = 8, 40


@cache
def learned_types(messages: int) -> LearnedTypes:
    """Two types, learned from labels: one needs the first message where a transition's feature is
    large, the other the second."""
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
    types = learn_types(
        data,
        Clustering(np.array([0, 0, 1, 1]), "given", "given"),
        LabelerTrainer(DecisionTreeClassifier()),
        0,
    )
    return LearnedTypes.of(types, data)


def given_types(rng: np.random.Generator, messages: int, own: bool) -> GivenTypes:
    """Three types that each look at two messages: as an array of numbered transitions, or of
    somebody's own transitions."""
    relevant = np.array([np.sort(rng.choice(messages, 2, replace=False)) for _ in range(3)])
    table = LabelTable.by_type(relevant, rng.choice([0.05, 0.3, 0.95], (3, TRANSITIONS, 4)))
    names = tuple(f"m{j}" for j in range(messages)), ("x", "y", "z")
    if own:
        return GivenTypes(lambda steps: table.of_steps([s["number"] for s in steps]), *names)
    return GivenTypes(table if messages == MANY else table.array(messages), *names)


class Situation:
    """An explanation with some features, and a person who answers at random."""

    def __init__(self, features: tuple[str, ...], seed: int) -> None:
        self.features, self.rng = features, np.random.default_rng(seed)
        messages = MANY if "many messages" in features else 3
        known = "learned types" in features
        own = "own table" in features
        self.types: Any = learned_types(messages) if known else given_types(self.rng, messages, own)
        steps = np.arange(TRANSITIONS)
        self.transitions: list[Any] = [
            [float(i)] if known else {"number": i} if own else i for i in steps.tolist()
        ]
        missed = (0.7, 0.2) if "missed messages" in features else (1.0, 0.0)
        error = 0.1 if "errors" in features else 0.0
        way = Persistent if "persistent belief" in features else Independent
        self.belief_update = way(error, *missed)

    def explainer(self, number: int) -> Explainer:
        """Makes an explainer with one of the solvers."""
        return Explainer(
            self.types,
            SOLVERS[number % len(SOLVERS)],
            trade_off=0.3,
            discount=0.9,
            discount_per="step" if "discount per step" in self.features else "action",
            belief_update=self.belief_update,
            ask=Limits(cost=0.02, most=2) if "questions" in self.features else None,
        )

    def session(self, explainer: Explainer) -> Session:
        """Makes a session about two or three transitions."""
        clips = self.transitions[4:7] if "questions" in self.features else []
        steps = 2 if "growing trace" in self.features else 3
        return explainer.session(self.transitions[:steps], clips=clips)

    def play(self, explainer: Explainer, seed: int, restored: bool) -> tuple[Session, list[Any]]:
        """Plays a session to its end. Returns its replies to all requests."""
        rng, session, seen = np.random.default_rng(seed), self.session(explainer), list[Any]()
        ahead = self.transitions[7:] if "growing trace" in self.features else []
        while not session.finished:
            move = session.next()
            if restored:
                session = explainer.from_json(session.to_json())
            seen.append((move, session.belief, session.said, session.cost, str(session.why())))
            if ahead and (session.shown == 2 or rng.random() < 0.5):
                session.extend(ahead)
                ahead = []
            elif isinstance(move, Question):
                session.answer(int(rng.integers(2)))
            else:
                session.observe(rng.integers(2, size=move.steps))
            if restored:
                session = explainer.from_json(session.to_json())
        return session, seen


def literal_belief(problem: Problem, events: list[Event]) -> NDArray[np.float64] | None:
    """[rows, N] the belief by Bayes' rule over the states of the literal POMDP; None if no state
    gives these answers."""
    pomdp, asked = LiteralPOMDP(problem), 0
    states = pomdp.initial()

    def after(action: int, seen: tuple[int, ...] | None) -> dict[LiteralState, float]:
        joint: dict[LiteralState, float] = {}
        for state, weight in states.items():
            for chance, new, observation, _ in pomdp.outcomes(state, action):
                if observation == seen:
                    joint[new] = joint.get(new, 0.0) + weight * chance
        return joint

    for event in events:
        match event:
            case Asked(question):
                asked = question
            case Answered(answer):
                states = after(EXPLAIN - 1 - asked, (answer,))
            case Given(messages):
                for j in indices(messages):
                    states = after(j, None)
            case Labelled(labels):
                states = after(EXPLAIN, labels)
    total = sum(states.values())
    if not total:
        return None
    belief = np.zeros((problem.table.p.shape[1], problem.n_types))
    for state, weight in states.items():
        facts = state.known if not problem.messages_land else ()
        row = problem.table.subset(sum(1 << j for j in facts))[state.user_type]
        belief[row, state.user_type] += weight / total
    return belief


@pytest.mark.parametrize(("number", "pair"), enumerate(PAIRS), ids=lambda one: str(one))
def test_a_restored_session_goes_on_as_one_that_never_stopped(
    number: int, pair: tuple[str, str]
) -> None:
    for seed in (0, 1):
        situation = Situation(pair, seed)
        explainer = situation.explainer(number + 3 * seed)
        _, whole = situation.play(explainer, seed, restored=False)
        session, again = situation.play(explainer, seed, restored=True)
        assert again == whole
        assert len(session.trace) == 3


@pytest.mark.parametrize("pair", PAIRS, ids=str)
def test_the_belief_is_the_literal_one_and_the_bounds_hold(pair: tuple[str, str]) -> None:
    for seed in (2, 3):
        situation = Situation(pair, seed)
        session, _ = situation.play(situation.explainer(0), seed, restored=False)
        talk = session._talk
        expected = literal_belief(talk.problem, talk.events)
        if expected is not None and talk.belief_update.fresh_labels:
            own = talk.state.belief.reshape(-1, talk.problem.n_types)
            assert own.sum(axis=0) == pytest.approx(expected.sum(axis=0), abs=1e-9)
            if not talk.problem.messages_land:
                assert own == pytest.approx(expected, abs=1e-9)
        found = bounds(talk.problem, Effort(nodes=60))
        value = evaluate(talk.problem, QMDP().plan(talk.problem), episodes=20)
        assert found.lower <= found.upper + 1e-9
        assert found.upper <= found.known_type + 1e-9
        assert value.value <= found.upper + 1e-9 + 4 * value.value_se
