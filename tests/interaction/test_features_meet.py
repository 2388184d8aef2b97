"""Tests every pair of compatible features of an explanation: on random small problems the belief is
the one of Bayes' rule over people's types, errors and knowledge, the bounds hold for policies
whose value is summed over all answers, and a session restored from text continues like one that
never stopped. The probabilities are those of the types, not those of the problem that is planned
for."""

from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sklearn.tree import DecisionTreeClassifier

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
    Problem,
    Question,
    Session,
)
from xplain.explanation.actions import Action, AskQuestion, VisibleState, give
from xplain.explanation.files import load, save
from xplain.explanation.message_sets import indices
from xplain.interaction.session import Candidate
from xplain.learning.user_types import learn_types
from xplain.solvers.base import CachedPolicy, Policy, messages_of
from xplain.solvers.bounds import bounds
from xplain.solvers.evaluate import evaluate
from xplain.solvers.greedy import QMDP
from xplain.solvers.hsvi import Certified, Effort
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.pomcp import POMCP
from xplain.solvers.simple import QHR, AskFirst

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
    for letters in ["qenld", "emnpl", "emogd", "nogpd", "qmngpl", "qeopd", "qmnog", "emgld"]
]
SOLVERS = [
    QMDP(),
    POMCP(simulations=100),
    Certified(nodes=50),
    Lookahead(),
    QHR(),
    AskFirst(),
]
TRANSITIONS, MANY, DISCOUNT = 8, 40, 0.9
ERRORS, ACCEPTS = {0.05: 0.6, 0.25: 0.4}, {0.6: 0.7, 0.9: 0.3}
"""Possible rates of errors and of acceptance, with their shares among people."""
People = dict[tuple[int, int], float]
"""The probability of each hidden type with a bitmask of known facts; the probabilities need not sum
to 1."""


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


@cache
def learned_label(messages: int, t: int, row: int, facts: int) -> float:
    """Returns a learned type's P(label is 1) of one transition and known facts."""
    labeler = learned_types(messages).labelers[t]
    return float(labeler.probability(np.array([[float(row)]]), np.array([facts]))[0])


def moved(people: Iterable[tuple[int, int, int, float, float]]) -> People:
    """Returns the people after a share of each changed the known facts: (hidden type, facts, other
    facts, probability, share)."""
    after: defaultdict[tuple[int, int], float] = defaultdict(float)
    for h, facts, changed, p, share in people:
        after[h, facts] += (1 - share) * p
        after[h, changed] += share * p
    return {person: p for person, p in after.items() if p > 0}


class Situation:
    """An explanation with some features, and people who answer at random. A transition comes twice.
    People may be asked about the trace, about other transitions, and about a fact."""

    def __init__(self, features: tuple[str, ...], seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.messages = MANY if "many messages" in features else 3
        self.learned, own = "learned types" in features, "own table" in features
        self.rows = rng.permutation(TRANSITIONS)[:5].tolist()
        self.rows[rng.integers(1, 3)] = self.rows[0]
        self.rows[4] = self.rows[1 if seed % 2 else 4]
        self.transitions: list[Any] = [
            [float(i)] if self.learned else {"number": i} if own else i for i in self.rows
        ]
        types = learned_types(self.messages) if self.learned else self.draw_types(rng, own)
        self.n_types = len(types.names)
        self.trace, self.grows = [*self.rows[:3], None], "growing trace" in features
        self.expected = 4 * (seed % 2) if self.grows else 0
        missed, self.repeats = "missed messages" in features, "persistent belief" in features
        errors = ERRORS if "errors" in features else {0.0: 1.0}
        accepts, self.forget = (ACCEPTS, 0.2 * (seed % 2)) if missed else ({1.0: 1.0}, 0.0)
        every = product(np.asarray(types.prior).tolist(), errors.items(), accepts.items())
        hidden = [(p * e_share * a_share, e, a) for p, (e, e_share), (a, a_share) in every]
        prior, self.error, self.accept = zip(*hidden, strict=True)
        self.anybody: People = {(h, 0): p for h, p in enumerate(prior)}
        self.trade_off = (0.3, 3.0)[seed // 2 % 2]
        self.per: Any = "step" if "discount per step" in features else "action"
        self.message_discount = 1.0 if self.per == "step" or missed else DISCOUNT
        self.limits = Limits(0.02, 2, ("anytime", "first")[seed % 2])
        asks = "questions" in features
        self.clips = [Candidate(one, str(one)) for one in self.transitions] if asks else []
        self.clips[4:] = [Candidate(self.transitions[4], "It is.\nIt is not.", 1)] * asks
        self.explainer = Explainer(
            types,
            SOLVERS[(len(features[0]) + seed) % len(SOLVERS)],
            trade_off=self.trade_off,
            discount=DISCOUNT,
            discount_per=self.per,
            belief_update=(Persistent if self.repeats else Independent)(
                errors, accepts, self.forget
            ),
            ask=self.limits if asks else None,
        )

    def draw_types(self, rng: np.random.Generator, own: bool) -> GivenTypes:
        """Makes three types whose labels depend on two messages each, for numbered transitions or a
        user's own transitions."""
        self.pairs = [np.sort(rng.choice(self.messages, 2, replace=False)).tolist() for _ in "xyz"]
        self.values = rng.choice([0.05, 0.3, 0.95], (3, TRANSITIONS, 4))
        if self.rows[0] % 2 == 0:  # the second message changes answers about others alone
            self.values[:, self.rows[:3], 2:] = self.values[:, self.rows[:3], :2]
            self.values[:, self.rows[3], 2:] = 1 - self.values[:, self.rows[3], :2]
        table = LabelTable.by_type(self.pairs, self.values)
        names = tuple(f"m{j}" for j in range(self.messages)), ("x", "y", "z"), (0.5, 0.3, 0.2)
        if own:
            return GivenTypes(lambda steps: table.of_steps([s["number"] for s in steps]), *names)
        return GivenTypes(table if self.messages == MANY else table.array(self.messages), *names)

    @property
    def useful(self) -> list[int]:
        """The messages that may change a label of somebody."""
        return [0, 1] if self.learned else sorted({j for pair in self.pairs for j in pair})

    def label(self, h: int, row: int | None, facts: int) -> float:
        """Returns P(label is 1). An unknown transition (None) is explicable."""
        t = h * self.n_types // len(self.error)
        if row is None:
            return 1.0
        if self.learned:
            return learned_label(self.messages, t, row, facts)
        first, second = self.pairs[t]
        return float(self.values[t, row, (facts >> first & 1) + 2 * (facts >> second & 1)])

    def answer(self, people: People, row: int | None, answer: int) -> People:
        """Multiplies each probability by the probability of an answer about a transition."""
        after = {}
        for (h, facts), p in people.items():
            meant = abs(1 - answer - self.label(h, row, facts))
            after[h, facts] = p * ((1 - self.error[h]) * meant + self.error[h] * (1 - meant))
        return after

    def hear(self, people: People, messages: list[int]) -> People:
        """Some people learn the fact of each message."""
        for j in messages:
            people = moved((h, f, f | 1 << j, p, self.accept[h]) for (h, f), p in people.items())
        return people

    def finish_step(self, people: People) -> People:
        """Some people forget facts."""
        for j in self.useful:
            people = moved((h, f, f & ~(1 << j), p, self.forget) for (h, f), p in people.items())
        return people

    def play(self, seed: int, restored: bool) -> tuple[Session, list[Any]]:
        """Plays a session to its end, and compares each belief and cost with those by hand. Some
        questions and messages are the policy's, some are not. Returns the session with its answers
        to every request."""
        rng, seen = np.random.default_rng(seed), list[Any]()
        known = 2 if self.grows else 3
        session = self.explainer.session(self.transitions[:known], self.expected, self.clips)
        ahead, left = self.transitions[known:3], [*range(len(self.clips))]
        people, heard, cost = self.anybody, set[int | None](), 0.0
        while not session.finished:
            if asked := bool(left) and rng.random() < 0.5:
                session.ask(left[rng.integers(len(left))])
            elif rng.random() < 0.5:
                told = {f"m{j}" for j in rng.choice(self.useful, 2)}
                session.tell(sorted(told if self.accept[0] < 1 else told - {*session.said}))
            move = session.next()
            if ahead and (session.shown == 2 or rng.random() < 0.5):
                session.extend(ahead)
                ahead = []
            if restored:
                session = self.explainer.from_json(session.to_json())
            state = session.belief, session.said, session.again, session.cost
            seen.append((move, *state, str(session.why())))
            if isinstance(move, Question):
                row, answer = self.rows[move.number], int(rng.integers(2))
                clip = self.clips[move.number].right < 0
                repeated = self.repeats and clip and row in heard
                if not asked:  # the policy asks
                    assert not repeated
                    assert len(self.clips) - len(left) < self.limits.most
                    assert self.limits.when == "anytime" or not (session.shown > 1 or session.said)
                session.answer(answer)
                left.remove(move.number)
                people = people if repeated else self.answer(people, row, answer)
                heard |= {row} if clip else set()
                cost += self.limits.cost
            else:
                labels = rng.integers(2, size=move.steps).tolist()
                session.observe(labels)
                new = [int(name[1:]) for name in move.messages]
                people, heard = self.hear(people, new), set() if new else heard
                for row, label in zip(self.rows, labels, strict=False):
                    if not (self.repeats and row in heard):
                        people = self.answer(people, row, label)
                    heard.add(row)
                people = self.finish_step(people)
                heard = set() if self.forget else heard
                cost += self.trade_off * len(new) + labels.count(0)
            shares = np.zeros(len(self.error))
            for (h, _), p in people.items():
                shares[h] += p / sum(people.values())
            by_type = shares.reshape(self.n_types, -1).sum(axis=1)
            assert [*session.belief.values()] == pytest.approx(by_type, abs=1e-9)
            assert session.cost == pytest.approx(cost)
            if restored:
                session = self.explainer.from_json(session.to_json())
        return session, seen

    def evaluate(
        self, problem: Problem, policy: Policy, visible: VisibleState, people: People
    ) -> float:
        """Computes the policy's expected discounted return over all answers of these people, who
        answer independently each time."""
        step, given, asked = visible
        if step == problem.n_steps:
            return 0.0
        total, states = sum(people.values()), problem.start.size // problem.n_types
        belief = np.zeros((states, problem.n_types))
        for (h, facts), p in people.items():
            belief[0 if problem.messages_land else problem.table.subset(facts)[h], h] += p / total
        action = policy.decide(visible, belief.ravel())
        if isinstance(action, AskQuestion):
            row, after = self.rows[action.question], asked | 1 << action.question
            answers = [self.answer(people, row, answer) for answer in (0, 1)]
            visible = visible._replace(asked=after)
            later = sum(self.evaluate(problem, policy, visible, these) for these in answers)
            return later - self.limits.cost * total
        new, factor, value = indices(messages_of(action)), 1.0, 0.0
        for _ in new:
            value -= factor * self.trade_off * total
            factor *= self.message_discount
        people, shown = self.hear(people, new), self.trace[: step + 1]
        for (h, facts), p in people.items():
            value -= factor * p * sum(1 - self.label(h, row, facts) for row in shown)
        after = VisibleState(step + 1, given | messages_of(action), asked)
        for labels in product((0, 1), repeat=step + 1 if step + 1 < problem.n_steps else 0):
            these = people
            for row, label in zip(shown, labels, strict=False):
                these = self.answer(these, row, label)
            later = self.evaluate(problem, policy, after, self.finish_step(these))
            value += factor * DISCOUNT * later
        return value


@dataclass
class DoesAnything:
    """A policy that tells anything, then asks anything. It depends on the belief."""

    situation: Situation
    problem: Problem
    seed: int

    def decide(self, visible: VisibleState, belief: np.ndarray) -> Action:
        rng = np.random.default_rng((self.seed, *visible, int(97 * belief[0])))
        left = [q for q in range(len(self.problem.questions)) if not visible.asked >> q & 1]
        if visible.given and len(left) > 3 and rng.random() < 0.7:
            return AskQuestion(left[rng.integers(len(left))])
        told = sum({1 << j for j in rng.choice(self.situation.useful, 2).tolist()})
        return give(told & self.problem.may_give(visible.given))

    def values(self, visible: VisibleState, belief: np.ndarray) -> dict[Action, float]:
        return {}


@pytest.mark.parametrize("features", SITUATIONS, ids="+".join)
def test_a_restored_session_goes_on_and_its_belief_and_bounds_are_right(
    features: tuple[str, ...], tmp_path: Path
) -> None:
    for seed in range(4):
        situation = Situation(features, seed)
        _, whole = situation.play(seed, restored=False)
        session, again = situation.play(seed, restored=True)
        assert again == whole
        assert list(session.trace) == situation.transitions[:3]
        problem = session.explained.problem
        assert problem.n_steps == max(3, situation.expected)
        certified, values = Certified(nodes=60).plan(problem), []
        own = situation.explainer.solver.plan(problem)
        for each in (certified, own, DoesAnything(situation, problem, seed)):
            policy = CachedPolicy(each)
            value = situation.evaluate(problem, policy, VisibleState(), situation.anybody)
            assert evaluate(problem, policy).value == pytest.approx(value, abs=1e-9)
            values.append(value)
        found = bounds(problem, Effort(nodes=60))
        assert found.lower <= values[0] + 1e-9
        assert max(values[:2]) <= found.upper + 1e-9
        assert found.upper <= found.known_type + 1e-9
        save(problem, tmp_path / "problem.npz")
        kept = load(tmp_path / "problem.npz")
        assert evaluate(kept, policy).value == pytest.approx(values[2], abs=1e-9)
        for key in ("start", "copies", "whose", "as_found"):
            np.testing.assert_array_equal(getattr(kept, key), getattr(problem, key))
