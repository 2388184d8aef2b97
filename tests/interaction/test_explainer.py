"""Sessions against the experiments' loop, across restarts, and on traces that grow."""

import json
import subprocess
import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.explanation.problems import random_problem
from xplain import Explainer, GivenTypes
from xplain.errors import InputError
from xplain.explanation.belief import Independent, Persistent
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import DENSE, LabelTable, joined
from xplain.explanation.listening import learned_habits
from xplain.explanation.message_sets import mask_of, names_of
from xplain.interaction.episode import explain
from xplain.interaction.explainees import SimulatedUser
from xplain.interaction.session import Show
from xplain.solvers.greedy import QMDP, Conformant, KnownType
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
    """Goes on until the end (or for some steps); returns what was said."""
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
    episode = explain(problem, policy, SimulatedUser.of(answers), explainer.belief_update)
    session = explainer.session(range(problem.n_steps))
    said = play(session, answers)
    names = problem.message_names
    assert [mask_of(step, names) for step in said] == episode.messages.tolist()
    np.testing.assert_array_equal(list(session.belief.values()), episode.beliefs[-1])
    assert session.cost == pytest.approx(episode.cost)


@given(situations())
@settings(max_examples=60, deadline=None)
def test_a_session_goes_on_in_another_process_as_if_nothing_had_happened(situation):
    problem, answers, explainer, rng = situation
    there = explainer.session(range(problem.n_steps), int(rng.integers(2 * problem.n_steps)))
    play(there, answers, int(rng.integers(problem.n_steps + 1)))
    if not there.finished and rng.random() < 0.5:
        there.messages()  # said, and the user's answer not heard yet
    here = explainer.from_json(there.to_json())
    assert here.belief == there.belief
    assert (here.said, here.shown, here.cost) == (there.said, there.shown, there.cost)
    assert play(here, answers) == play(there, answers)
    assert here.belief == there.belief
    assert here.to_json() == there.to_json()


def test_a_restore_before_each_request_changes_no_move():
    table = np.array([[[0.05, 0.95], [0.05, 0.9]]])
    explainer = Explainer(GivenTypes(table, ("fuel",), ("novice",)), trade_off=0.2)

    def moves(restored):
        session, seen = explainer.session([0, 1]), []
        while not session.finished and len(seen) < 9:
            if restored:
                session = explainer.from_json(session.to_json())
            seen.append(session.next())
            if isinstance(seen[-1], Show):
                session.observe([1] * seen[-1].steps)
        return seen

    assert moves(restored=True) == moves(restored=False)


@given(situations())
@settings(max_examples=60, deadline=None)
def test_a_trace_that_grows_is_planned_for_with_all_that_is_known(situation):
    """Each decision is the one of a session that knew as much from the start."""
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


def test_a_session_taken_up_still_expects_the_rest_of_the_trace():
    table = np.array([[[0.0, 1.0]]])
    explainer = Explainer(GivenTypes(table, ("m",), ("t",)), message_cost=3.0, discount=1.0)
    text = explainer.session([0], expected_steps=4).to_json()
    assert explainer.from_json(text).messages() == ("m",)


def test_why_tells_of_the_newest_decision_alone():
    """The second transition needs another message; the first one's is among those given."""
    mends = np.array([[0, 1, 0, 1], [0, 0, 1, 1]], dtype=float)
    explainer = Explainer(GivenTypes(mends[None], ("a", "b"), ("t",)), trade_off=0.5, discount=1.0)
    session = explainer.session([0])
    assert session.messages() == ("a",)
    session.observe([1])
    session.extend([1])
    assert session.messages() == ("b",)
    why = session.why()
    assert (why.step, why.given, why.chosen) == (1, ("a",), ("b",))
    assert set(why.values) == {(), ("b",)}


@dataclass
class Noting:
    """QMDP that notes what it is asked to plan, and on which seed."""

    planned: list
    knows = "types"

    def plan(self, problem, seed=0):
        self.planned.append((problem, seed))
        return QMDP().plan(problem, seed)


def test_the_solver_plans_for_exactly_what_the_explainer_was_told():
    planned = []
    table = np.full((2, 1, 4), 0.5)
    types = GivenTypes(table, ("a", "b"), ("x", "y"), (0.2, 0.8))
    explainer = Explainer(
        types, Noting(planned), 0.7, [2.0, 3.0], 1.5, 0.9, "step", Persistent(), seed=5
    )
    explainer.session([0]).messages()
    ((problem, seed),) = planned
    assert seed == 5
    assert np.array_equal(problem.p_explicable, table)
    assert problem.message_cost.tolist() == [2.0, 3.0]
    assert problem.prior.tolist() == [0.2, 0.8]
    told = (problem.trade_off, problem.inexplicability_cost, problem.discount)
    assert told == (0.7, 1.5, 0.9)
    assert problem.discount_per == "step"
    assert (problem.message_names, problem.type_names) == (("a", "b"), ("x", "y"))


@pytest.mark.parametrize("n", [3, DENSE + 2])
@pytest.mark.parametrize("expected_steps", [0, 2, 4, 9])
def test_a_trace_in_parts_is_planned_as_the_whole(n, expected_steps):
    """The transitions of all parts, and as many unknown ones as are still expected."""
    rng = np.random.default_rng(n)
    types = GivenTypes(
        LabelTable.by_type(np.array([[0, 2], [1, -1]]), np.tile(rng.random((2, 5, 2)), 2)),
        tuple(f"m{j:02}" for j in range(n)),
        ("x", "y"),
    )
    planned = []
    explainer = Explainer(types, Noting(planned))
    explainer.session(range(5), expected_steps).messages()
    parts = explainer.session([], expected_steps)
    for part in ([0], [1, 2], [], [3, 4]):
        parts.extend(part)
        if part == [1, 2]:
            parts.messages()  # planned between parts, too
    parts.observe([1])
    parts.messages()
    whole, _, last = (problem for problem, _ in planned)
    assert whole.n_steps == last.n_steps == max(5, expected_steps)
    for mask in range(8):
        one, other = (p.table.label_probabilities(p.n_steps, mask) for p in (whole, last))
        assert np.array_equal(one, other)
        known = types.label_table(range(5)).label_probabilities(5, mask)
        assert np.array_equal(one[:, :5], known)
        assert (one[:, 5:] == 1).all()


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


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ({"trade_off": -1}, ["trade_off", "-1", "≥ 0"]),
        ({"discount": 0}, ["discount", "(0, 1]"]),
        ({"message_cost": [1, 2, 3]}, ["message_cost", "2 costs"]),
        ({"solver": KnownType()}, ["solver", "KnownType"]),
        ({"types": GivenTypes(TYPES.table, ("a", "a"), ("x", "y"))}, ["messages", "once"]),
        ({"types": GivenTypes(TYPES.table, ("a", "b"), ("x", "y"), (0.9, 0.9))}, ["prior"]),
    ],
)
def test_a_bad_setting_is_one_clear_line(setting, words):
    with pytest.raises(InputError) as error:
        Explainer(**{"types": TYPES} | setting)
    assert "\n" not in str(error.value)
    for word in words:
        assert word in str(error.value)


HALF = np.full((2, 3, 4), 0.5)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: types_of(np.full((2, 3, 8), 0.5)), "2**2 = 4 sets of 2 messages"),
        (lambda: types_of(np.full((3, 3, 4), 0.5)), "table=3: 2 types, as there are names"),
        (lambda: types_of([[1], [2, 3]]), "numbers"),
        (lambda: types_of(np.zeros((2, 3, 4))), "all of these are 0"),
        (
            lambda: types_of(LabelTable.dense(np.full((3, 3, 4), 0.5))),
            "2 types, as there are names",
        ),
        (lambda: asked(lambda trace: np.full((2, len(trace), 8), 0.5)), "sets of 2 messages"),
        (lambda: Explainer(types_of(), solver="qmdp"), "solver='qmdp': an object, such as QMDP()"),
        (lambda: Explainer(types_of(), solver=QMDP), "an object, such as QMDP()"),
        (lambda: Explainer(types_of(), belief_update="persistent"), "an object"),
        (lambda: Explainer(types_of(), trade_off="1"), "trade_off='1': a number ≥ 0"),
        (lambda: Explainer(types_of(), trade_off=None), "trade_off=None: a number ≥ 0"),
        (lambda: Explainer(types_of(), message_cost="x"), "message_cost="),
        (lambda: Explainer(types_of(), seed="1"), "seed='1': a whole number"),
        (lambda: Explainer(types_of(names=("x", "x"))), "each once"),
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


TWICE = [["give", []], ["labels", [1]], ["labels", [1]]]
UNKNOWN = [["give", ["z"]]]


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
        (lambda: explainer.from_json(json.dumps(state | {"events": [["give"]]})), "JSON"),
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


def test_rows_of_arrays_are_transitions_that_json_holds():
    """As numpy's rows and numbers, or as plain lists."""

    def table(transitions):
        return np.array([[[0.3 * row[0], 0.2 * row[1]] for row in transitions]])

    explainer = Explainer(GivenTypes(table, ("m",), ("t",)))
    rows = np.array([[1.0, 2.0], [3.0, 4.0]])
    session, plain = explainer.session(rows), explainer.session(rows.tolist())
    assert session.trace == plain.trace == ([1.0, 2.0], [3.0, 4.0])
    assert session.to_json() == plain.to_json()
    assert explainer.from_json(session.to_json()).trace == session.trace
    indices = Explainer(TYPES).session(np.array([0, 2]))
    assert Explainer(TYPES).from_json(indices.to_json()).trace == indices.trace == (0, 2)


def test_an_answer_may_come_before_more_is_known():
    """What was said and answered stays when the trace grows, and messages asked for twice are
    said once."""
    session = Explainer(TYPES).session([0, 1])
    first = session.messages()
    session.extend([2])
    assert session.messages() == first
    session.observe([0])
    assert (session.shown, session.finished) == (2, False)
    assert len(session.trace) == 3


def test_importing_the_package_imports_nothing_heavy():
    code = (
        "import sys, xplain; print([m for m in ('numpy', 'numba', 'sklearn') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def many(steps=6, n=40):
    """Two types of forty messages; each finds its own message wanting at every second step."""
    table = np.full((2, steps, 2), 0.95)
    table[:, ::2, 0] = 0.05
    by_type = LabelTable.by_type(np.array([[7], [33]]), table)
    names = tuple(f"m{j:02}" for j in range(n))
    return GivenTypes(by_type, names, ("seven", "thirty-three"), (1.0, 0.0))


def test_forty_messages_are_kept_by_type():
    session = Explainer(many()).session([0, 1, 2])
    assert session.messages() == ("m07",)
    session.observe([1])
    session.extend([3, 4])
    assert session.messages() == ()
    again = Explainer(many()).from_json(session.to_json())
    assert again.said == ("m07",)
    assert again.belief == session.belief


def test_transitions_not_known_yet_puzzle_nobody_however_many_messages_there_are():
    """As many steps of which nothing is known: the message pays all the same."""
    sure = Explainer(many(), trade_off=3.0)
    assert sure.session([0]).messages() == ()
    assert sure.session([0], expected_steps=6).messages() == ("m07",)


def test_a_trace_in_parts_is_the_trace_however_its_parts_are_kept():
    rng = np.random.default_rng(0)
    one = LabelTable.by_type(np.array([[3, 1], [0, -1]]), rng.random((2, 2, 4)))
    other = LabelTable.by_type(np.array([[3], [2]]), rng.random((2, 3, 2)))
    parts = [one, other, LabelTable.dense(rng.random((2, 1, 16)))]
    expected = np.concatenate([part.array(4) for part in parts], axis=1)
    assert np.array_equal(joined(parts).array(4), expected)
    twice = joined([parts[2], parts[2]])
    assert twice.is_dense(4)
    assert np.array_equal(twice.array(4), np.concatenate([parts[2].array(4)] * 2, axis=1))


def test_more_than_62_messages_are_refused():
    names = tuple(f"m{j}" for j in range(63))
    with pytest.raises(InputError, match=r"types\.messages"):
        Explainer(
            GivenTypes(
                LabelTable.by_type(np.empty((1, 0), int), np.ones((1, 1, 1))), names, ("one",)
            )
        )


def test_a_message_that_was_not_taken_in_is_said_again():
    """One who still finds odd what a message explains is told once more; ``again`` says so."""
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
    """Messages are missed half of the time: then they are said again sooner, and to others too."""
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
        found = learned_habits([one.explained for one in people])
        own = replace(types, habits=found)
        belief = Explainer(own, belief_update=weighs).session(range(6)).explained.problem.habits
        assert belief.accept @ belief.prior == pytest.approx(found.accept @ found.prior)
        rates.append(found.accept @ found.prior)
    assert rates[0] < 0.75 < 0.9 < rates[1]


RATES = Habits(np.array([0.02, 0.2]), np.ones(2), np.zeros(2), np.array([0.7, 0.3]))


@pytest.mark.parametrize(
    ("habits", "usual"), [(None, Independent()), (RATES, Persistent("learned"))]
)
def test_learned_rates_are_heeded_unless_told_otherwise(habits, usual):
    """The same beliefs and messages as of an explainer that is told so, and others than the other
    update gives: a label that is shown again is no news to one, and rates make it weaker."""
    table = np.array([[[0.9, 0.9]] * 3, [[0.2, 0.9]] * 3])
    types = GivenTypes(table, ("m",), ("a", "b"), habits=habits)
    found = []
    for update in (None, usual, Independent(), Persistent("learned")):
        session = Explainer(types, trade_off=5.0, belief_update=update).session([0, 1, 2])
        for labels in ([1], [1, 0]):
            session.messages()
            session.observe(labels)
        found.append((session.belief, session.messages()))
    assert found[0] == found[1]
    assert found[2][0]["a"] != pytest.approx(found[3][0]["a"], abs=0.01)
