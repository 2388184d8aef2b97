"""Compares sessions with the experiments' loop, across restarts, and on growing traces."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.explanation.problems import random_problem
from xplain import Explainer, GivenTypes
from xplain.errors import InputError
from xplain.explanation.belief import Independent, Persistent
from xplain.explanation.label_table import LabelTable
from xplain.explanation.listening import learn_habits
from xplain.explanation.message_sets import mask_of, names_of
from xplain.interaction.episode import explain
from xplain.interaction.explainees import SimulatedUser
from xplain.solvers.base import CachedPolicy
from xplain.solvers.greedy import QMDP, Conformant
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.pomcp import POMCP
from xplain.solvers.simple import QHR

SOLVERS = [QMDP(), QHR(), Conformant()]
ERRORS = [0.0, 0.0, 0.2, "learned"]
LISTENING = [(1.0, 0.0), (1.0, 0.0), (0.6, 0.0), (0.9, 0.2), ("learned", 0.1)]


def explainer_of(problem, solver, belief_update):
    types = GivenTypes(
        problem.p_explicable, problem.message_names, problem.type_names, problem.prior
    )
    return Explainer(
        types,
        solver,
        problem.trade_off,
        problem.message_cost,
        problem.inexplicability_cost,
        problem.discount,
        problem.discount_per,
        belief_update,
    )


@pytest.mark.parametrize("solver", [*SOLVERS, POMCP(), Lookahead()], ids=lambda s: type(s).__name__)
def test_without_messages_there_is_nothing_to_say(solver):
    """Labels update the belief all the same: 0 is three times likelier for the second type."""
    types = GivenTypes(np.array([[[0.9]] * 3, [[0.7]] * 3]), (), ("a", "b"))
    session = Explainer(types, solver).session([0, 1, 2])
    while not session.finished:
        assert session.messages() == ()
        session.observe([0] * session.shown)
    assert session.belief["b"] == pytest.approx(3**6 / (1 + 3**6))
    assert session.cost == 6


@st.composite
def situations(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    problem = random_problem(rng, max_steps=5, max_messages=3)
    assume(problem.p_explicable.any())  # a table of zeros is refused
    assume(not problem.table.answers.size)  # these come from the belief update alone
    answers = rng.integers(0, 2, problem.p_explicable.shape[1:]).astype(np.uint8)
    error = ERRORS[rng.integers(len(ERRORS))]
    listening = LISTENING[rng.integers(len(LISTENING))]
    solver = SOLVERS[rng.integers(len(SOLVERS))] if listening == (1.0, 0.0) else QMDP()
    update = (Independent if rng.random() < 0.5 else Persistent)(error, *listening)
    return problem, answers, explainer_of(problem, solver, update), rng


def play(session, answers, steps=None):
    """Continues to the end (or for some steps). Returns the messages."""
    said = []
    while not session.finished and steps != 0:
        said.append(session.messages())
        given = mask_of(session.said, session._talk.problem.message_names)
        session.observe(answers[: session.shown, given])
        steps = None if steps is None else steps - 1
    return said


@given(situations())
@settings(max_examples=60, deadline=None)
def test_a_session_is_an_episode_of_the_experiments(situation):
    problem, answers, explainer, _ = situation
    problem = problem.with_habits(explainer.belief_update.habits(None))
    policy = explainer.solver.plan(problem)
    episode = explain(
        problem, CachedPolicy(policy), SimulatedUser.of(answers), explainer.belief_update
    )
    session = explainer.session(range(problem.n_steps))
    said = play(session, answers)
    names = problem.message_names
    assert [mask_of(step, names) for step in said] == episode.messages.tolist()
    np.testing.assert_array_equal(list(session.belief.values()), episode.beliefs[-1])
    assert session.cost == pytest.approx(episode.cost)


@given(situations())
@settings(max_examples=60, deadline=None)
def test_a_trace_that_grows_is_planned_for_with_all_that_is_known(situation):
    """Each decision is that of a session with the same knowledge from the start."""
    problem, answers, explainer, _ = situation
    session = explainer.session()
    for k in range(problem.n_steps):
        session.extend([k])
        wiser = explainer.session(range(k + 1))
        before = session.explained
        for mask, labels in zip(before.said, before.answers, strict=True):
            wiser.tell(names_of(mask, problem.message_names))
            wiser.observe(labels)
        assert wiser.messages() == session.messages()
        session.observe(answers[: k + 1, mask_of(session.said, problem.message_names)])
    assert session.finished


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
    assert "fuel" in str(before)


def test_types_may_be_a_function_of_whatever_a_transition_is():
    def table(transitions):
        hard = np.array([move["hard"] for move in transitions])
        return np.where(hard[None, :, None], [[[0.2, 0.9]]], 0.9)

    explainer = Explainer(GivenTypes(table, ("why",), ("anyone",)), trade_off=0.1)
    session = explainer.session([{"hard": False}])
    assert session.messages() == ()
    session.observe([1])
    session.extend([{"hard": True}])
    assert session.messages() == ("why",)
    assert explainer.from_json(session.to_json()).messages() == ("why",)


TYPES = GivenTypes(np.full((2, 3, 4), 0.5), ("a", "b"), ("x", "y"))


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
    with pytest.raises(InputError) as error:
        make()
    assert said in str(error.value)
    assert "\n" not in str(error.value)


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
    explainer = Explainer(TYPES)
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
        with pytest.raises(InputError) as error:
            action()
        assert "\n" not in str(error.value)
        assert words in str(error.value)


def test_importing_the_package_imports_nothing_heavy():
    code = (
        "import sys, xplain; print([m for m in ('numpy', 'numba', 'sklearn') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_message_that_was_not_taken_in_is_said_again():
    """If a transition still makes no sense after its message, the message is repeated; ``again``
    has it."""
    table = np.zeros((1, 6, 2))
    table[..., 1] = 1
    types = GivenTypes(np.clip(table, 0.02, 0.98), ("fuel",), ("novice",))
    session = Explainer(types, belief_update=Independent(0.0, 0.7, 0.0)).session(range(6))
    assert (session.messages(), session.again) == (("fuel",), ())
    session.observe([0])
    assert (session.messages(), session.again) == (("fuel",), ("fuel",))
    assert session.cost == 3  # twice the message, and a label
    session.observe([1, 1])
    assert (session.messages(), session.again, session.said) == ((), (), ("fuel",))


def test_what_people_are_like_is_learned_from_sessions_and_used_by_the_next():
    """Half of the messages are missed. So messages are repeated sooner, and also to other
    people."""
    table = np.zeros((1, 6, 2))
    table[..., 1] = 1
    types = GivenTypes(np.clip(table, 0.02, 0.98), ("fuel",), ("novice",))
    weighs = Independent(0.0, "learned", "learned")
    missed, took_in = [], []
    for people, first in ((missed, 0), (took_in, 1)):
        for _ in range(8):
            session = Explainer(types, belief_update=weighs).session(range(6))
            while not session.finished:
                session.messages()
                session.observe([first if session.shown == 1 else 1] * session.shown)
            people.append(session)
    rates = []
    for people in (missed, took_in):
        found = learn_habits([one.explained for one in people])
        own = replace(types, habits=found)
        belief = Explainer(own, belief_update=weighs).session(range(6)).explained.problem.habits
        assert belief.accept @ belief.prior == pytest.approx(found.accept @ found.prior)
        rates.append(found.accept @ found.prior)
    assert rates[0] < 0.75 < 0.9 < rates[1]
