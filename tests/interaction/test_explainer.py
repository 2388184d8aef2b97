"""Sessions of an embedded explainer: decisions, reasons, habits, what is refused, and people of no
type."""

import json
import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.refusals import refused
from xplain import (
    Clustering,
    Dataset,
    Explainer,
    GivenTypes,
    Hypotheses,
    Independent,
    LabelTable,
    LearnedTypes,
)
from xplain import GivenTypes as Types
from xplain.explanation.anybody import Open
from xplain.explanation.habits import WAYS
from xplain.explanation.label_table import DENSE
from xplain.explanation.listening import learn_habits
from xplain.learning.mixture.labeler import HypothesisTrainer
from xplain.learning.user_types import learn_types
from xplain.solvers.greedy import QMDP, Conformant
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.pomcp import POMCP
from xplain.solvers.simple import QHR

SOLVERS = [QMDP(), QHR(), Conformant(), POMCP(), Lookahead()]


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: type(s).__name__)
def test_without_messages_there_is_nothing_to_say(solver):
    """Labels still update the belief: label 0 is three times likelier for the second type."""
    types = GivenTypes(np.array([[[0.9]] * 3, [[0.7]] * 3]), (), ("a", "b"))
    session = Explainer(types, solver).session([0, 1, 2])
    while not session.finished:
        assert session.messages() == ()
        session.observe([0] * session.shown)
    assert session.belief["b"] == pytest.approx(3**6 / (1 + 3**6))
    assert session.cost == 6


def test_the_expected_length_makes_an_early_message_worth_its_cost():
    # One message at cost 3 mends the first transition, which is inexplicable without it.
    table = np.array([[[0.0, 1.0]]])
    explainer = Explainer(GivenTypes(table, ("m",), ("t",)), message_cost=3.0, discount=1.0)
    assert explainer.session([0]).messages() == ()
    assert explainer.session([0], expected_steps=3).messages() == ()  # a tie: say nothing
    assert explainer.session([0], expected_steps=4).messages() == ("m",)


def test_why_ranks_the_choice_first_and_keeps_the_reasons_of_the_moment():
    table = np.array([[[0.1, 0.9], [0.1, 0.9]], [[0.9, 0.9], [0.9, 0.9]]])
    explainer = Explainer(GivenTypes(table, ("fuel",), ("new", "old")), trade_off=0.5)
    session = explainer.session([0, 1])
    assert session.messages() == ("fuel",)
    before = session.why()
    assert next(iter(before.values)) == before.chosen == ("fuel",)
    assert before.belief == {"new": 0.5, "old": 0.5}
    session.observe([1])
    assert session.why() == before
    assert [line.split()[1] for line in str(before).splitlines()[1:]] == ["fuel", "say"]


HALF = np.full((2, 3, 4), 0.5)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: types_of(np.full((2, 3, 8), 0.5)), "2**2 = 4 sets of 2 messages"),
        (lambda: types_of(np.full((3, 3, 4), 0.5)), "table=3: 2 types, one for each name"),
        (lambda: types_of([[1], [2, 3]]), "numbers"),
        (lambda: types_of(np.zeros((2, 3, 4))), "all of these are 0"),
        (
            lambda: types_of(LabelTable.dense(np.full((3, 3, 4), 0.5))),
            "2 types, one for each name",
        ),
        (lambda: asked(lambda trace: np.full((2, len(trace), 8), 0.5)), "sets of 2 messages"),
        (lambda: Explainer(types_of(), solver="qmdp"), "solver='qmdp': an object, such as QMDP()"),
        (lambda: Explainer(types_of(), solver=QMDP), "an object, such as QMDP()"),
        (lambda: Explainer(types_of(), belief_update="persistent"), "an object"),
        (lambda: Explainer(types_of(), trade_off="1"), "trade_off='1': a number ≥ 0"),
        (lambda: Explainer(types_of(), trade_off=None), "trade_off=None: a number ≥ 0"),
        (lambda: Explainer(types_of(), message_cost="x"), "message_cost="),
        (lambda: Explainer(types_of(), seed="1"), "seed='1': a whole number"),
        (lambda: Explainer(types_of(names=("x", "x"))), "without repetition"),
        (lambda: Explainer(None), "types.messages"),
        (lambda: answered([1, 0]), "1 labels, 0 or 1 for each transition shown so far"),
    ],
)
def test_what_a_stranger_gives_wrong_is_told_in_plain_words(make, said):
    with refused(re.escape(said)):
        make()


def types_of(table=HALF, names=("x", "y")):
    return GivenTypes(table, ("a", "b"), names)


def asked(table):
    Explainer(types_of(table)).session([0]).messages()


def answered(labels):
    session = Explainer(types_of()).session([0, 1])
    session.messages()
    session.observe(labels)


TWICE = [["tell", []], ["observe", [1]], ["observe", [1]]]
UNKNOWN = [["tell", ["z"]]]


def test_misuse_is_one_clear_line():
    explainer = Explainer(types_of())
    session = explainer.session([0])
    session.messages()
    text = session.to_json()
    state = json.loads(text)
    anything = Explainer(GivenTypes(lambda steps: np.ones((1, len(steps), 2)), ("m",), ("t",)))

    def told_again():
        twice = explainer.session([0, 1])
        twice.tell(["a"])
        twice.observe([1])
        twice.tell(["b", "a"])

    broken = [
        (lambda: explainer.session([7]), "trace"),
        (lambda: explainer.session([0.5]), "trace"),
        (lambda: explainer.session([0], -1), "expected_steps"),
        (lambda: explainer.session([0], True), "expected_steps"),
        (lambda: explainer.session([0]).observe([1]), "messages() comes first"),
        (lambda: explainer.session([0]).why(), "messages() comes first"),
        (lambda: session.observe([1, 1]), "labels"),
        (lambda: session.observe([2]), "labels"),
        (lambda: session.observe(["yes"]), "labels"),
        (lambda: explainer.session().messages(), "finished"),
        (lambda: session.tell(["a"]), "before messages()"),
        (lambda: explainer.session([0]).tell(["c"]), "unknown message"),
        (told_again, "may be said after ('a',)"),
        (lambda: explainer.session().tell(["a"]), "before messages()"),
        (lambda: explainer.session([-1]), "trace"),
        (lambda: explainer.from_json(json.dumps(state | {"messages": ["b", "a"]})), "messages"),
        (lambda: explainer.from_json(json.dumps(state | {"events": [["say", []]]})), "event"),
        (lambda: explainer.from_json(json.dumps(state | {"events": [["tell"]]})), "JSON"),
        (lambda: anything.session([object()]).to_json(), "JSON"),
        (lambda: explainer.from_json("{}"), "JSON"),
        (lambda: explainer.from_json("no"), "JSON"),
        (lambda: explainer.from_json(json.dumps(state | {"format": 9})), "format"),
        (lambda: explainer.from_json(json.dumps(state | {"types": ["x"]})), "types"),
        (lambda: explainer.from_json(json.dumps(state | {"events": TWICE})), "comes first"),
        (lambda: explainer.from_json(json.dumps(state | {"events": UNKNOWN})), "unknown message"),
    ]
    for action, words in broken:
        with refused(re.escape(words)):
            action()


FUEL = np.repeat([[[0.02, 0.98]]], 6, axis=1)
"""One type, who finds each of six transitions inexplicable until told about the fuel."""
NOVICE = GivenTypes(FUEL, ("fuel",), ("novice",))


def test_a_message_that_was_not_taken_in_is_said_again():
    """If a transition still makes no sense after its message, the message is repeated; ``again``
    has it."""
    session = Explainer(NOVICE, belief_update=Independent(0.0, 0.7, 0.0)).session(range(6))
    assert (session.messages(), session.again) == (("fuel",), ())
    session.observe([0])
    assert (session.messages(), session.again) == (("fuel",), ("fuel",))
    assert session.cost == 3  # twice the message, and a label
    session.observe([1, 1])
    assert (session.messages(), session.again, session.said) == ((), (), ("fuel",))


def test_what_people_are_like_is_learned_from_sessions_and_used_by_the_next():
    """Half of the messages are missed. So messages are repeated earlier, and also to other
    people."""
    weighs = Independent(0.0, "learned", "learned")
    missed, took_in = [], []
    for people, first in ((missed, 0), (took_in, 1)):
        for _ in range(8):
            session = Explainer(NOVICE, belief_update=weighs).session(range(6))
            while not session.finished:
                session.messages()
                session.observe([first if session.shown == 1 else 1] * session.shown)
            people.append(session)
    rates = []
    for people in (missed, took_in):
        found = learn_habits([one.explained for one in people])
        next_ = replace(NOVICE, habits=found)
        belief = Explainer(next_, belief_update=weighs).session(range(6)).explained.problem.habits
        for own, taken in ((found.accept, belief.accept), (found.forget, belief.forget)):
            assert taken @ belief.prior == pytest.approx(own @ found.prior)
        rates.append(found.accept @ found.prior)
    assert rates[0] < 0.75 < 0.9 < rates[1]


N, STEPS = 3, 10
SETS = np.arange(1 << N)


def types_with_facts(seed: int = 0) -> Types:
    """Makes two types that believe one fact incorrectly each; labels are nearly certain."""
    labels = np.random.default_rng(seed).choice([0.02, 0.98], (STEPS, 1 << N))
    labels[:, 0] = 0.98
    table = np.stack([labels[:, wrong & ~SETS] for wrong in (1, 2)])
    everything = labels[None, :, 7 & ~SETS]
    return GivenTypes(table, ("a", "b", "c"), ("x", "y"), wrong=(1, 2), about_everything=everything)


def test_people_may_be_of_no_type_where_facts_are_known() -> None:
    types = types_with_facts()
    assert isinstance(Explainer(types).beliefs, Open)
    session = Explainer(types).session(range(STEPS))
    assert session.belief["none of these"] == pytest.approx(0.1, abs=0.08)
    before = session.fit
    assert before == pytest.approx(0.78, abs=0.03)
    session.messages()
    assert session.why().fit == before
    assert "fit none" not in str(session.why())
    for facts in (replace(types, wrong=None, about_everything=None), types):
        closed = Explainer(facts, belief_update=Independent()).session(range(STEPS))
        assert closed.belief.keys() == {"x", "y"}
        assert closed.fit == 1


def test_answers_that_fit_no_type_are_told_of() -> None:
    """A person who answers at random soon fits no type; a restored session says the same."""
    explainer, rng = Explainer(types_with_facts(), trade_off=100), np.random.default_rng(0)
    session = explainer.session(range(STEPS))
    while not session.finished:
        session.messages()
        session.observe(rng.integers(0, 2, session.shown))
    assert session.fit < 0.01
    assert "the answers fit none of the types" in str(session.why())
    assert explainer.from_json(session.to_json()).fit == pytest.approx(session.fit)


@pytest.mark.parametrize("many", [0, 1])
def test_where_facts_are_many_people_are_taken_as_found(
    caplog: pytest.LogCaptureFixture, many: int
) -> None:
    p, names = np.full((1, 1, 1 << DENSE + many), 0.9), map(str, range(DENSE + many))
    types = GivenTypes(p, tuple(names), ("x",), wrong=(1,), about_everything=p)
    with caplog.at_level(logging.WARNING):
        assert Explainer(types).beliefs.open != many
    assert ("all users are assumed to have one of the types" in caplog.text) == many


def test_learned_types_keep_their_facts_in_a_file(tmp_path: Path) -> None:
    labels = np.random.default_rng(0).integers(0, 2, (1 << N, 8)).astype(np.uint8)
    features = np.arange(8.0)[:, None]
    known = Hypotheses.of(labels, messages=("a", "b", "c"), features=features, feature_names=("f",))
    rng = np.random.default_rng(1)
    transition, told = rng.integers(0, 8, 200), rng.integers(0, 8, 200)
    observer = np.repeat([0, 1], 100)
    answers = labels[np.array([1, 6])[observer] & ~told, transition]
    dataset = Dataset(
        features, ("f",), ("a", "b", "c"), ("one", "two"), observer, transition, told, answers
    )
    trainer = HypothesisTrainer(hypotheses=known)
    found = learn_types(dataset, Clustering(np.array([0, 1]), "", ""), trainer, 0)
    learned = LearnedTypes.of(found, dataset)
    assert learned.wrong == (1, 6)
    learned.save(tmp_path / "types.npz")
    loaded = LearnedTypes.load(tmp_path / "types.npz")
    assert (loaded.wrong, loaded.new) == (learned.wrong, learned.new)
    assert loaded.habits.ways.tolist() == learned.habits.ways.tolist() != WAYS.tolist()
    for types in (learned, loaded):
        everything = types.everything(features.tolist())
        one = everything.array(N)[0]
        np.testing.assert_allclose(one, np.where(labels[7 & ~SETS].T, 0.998, 0.002))
        assert Explainer(types).beliefs == Open("learned")  # nobody missed a message
