"""Compares sessions with the experiments' loop, with and without questions, and as traces grow."""

from contextlib import nullcontext
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.refusals import refused
from xplain import (
    BeliefUpdate,
    Explainer,
    GivenTypes,
    Independent,
    InputError,
    Persistent,
    Problem,
    SimulatedUser,
)
from xplain.explanation.asking import Limits, Question, Questions
from xplain.explanation.label_table import join_steps
from xplain.explanation.message_sets import mask_of, names_of
from xplain.interaction.episode import explain
from xplain.interaction.session import Candidate, Session, Show
from xplain.solvers.base import CachedPolicy
from xplain.solvers.greedy import QMDP, Conformant
from xplain.solvers.hsvi import Certified
from xplain.solvers.simple import QHR
from xplain.testing.problems import random_problem, with_questions

TABLE = np.array([[[0.05, 0.95], [0.05, 0.95]], [[0.95, 0.95], [0.95, 0.95]]])
TYPES = GivenTypes(TABLE, ("fuel",), ("new", "old"))
LISTENING = [(1.0, 0.0), (1.0, 0.0), (0.6, 0.0), (0.9, 0.2), ("learned", 0.1)]


@dataclass(frozen=True)
class Situation:
    """An explainer, the problem that it should plan for, the clips that it may ask about, and a
    user's answers [m + Q, 2^n] about transitions and then clips."""

    explainer: Explainer
    problem: Problem
    clips: tuple[int, ...]
    answers: np.ndarray

    def play(self) -> tuple[Session, list[tuple[int, int]]]:
        """Plays a session to its end; returns it, and its questions with their steps."""
        session, asked = self.explainer.session(range(self.problem.n_steps), clips=self.clips), []
        while not session.finished:
            move = session.next()
            assert session.next() == move
            given = mask_of(session.said, self.problem.message_names)
            if isinstance(move, Question):
                asked.append((session.shown - 1, move.number))
                session.answer(int(self.answers[self.clips[move.number], given]))
            else:
                session.observe(self.answers[: move.steps, given])
        return session, asked


@st.composite
def situations(draw: st.DrawFn, most: int = 3) -> Situation:
    """Draws situations with at most this number of questions; one problem of three has no
    questions."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    problem = random_problem(rng, max_steps=5, max_messages=3)
    assume(problem.p_explicable.any() and problem.habits.never_err)  # errors are the belief's
    m, table, clips, limits = problem.n_steps, problem.table, [], None
    if most and rng.random() < 0.67:
        asked = with_questions(rng, problem, most).questions
        table, limits = join_steps([table, asked.table]), asked.limits
        clips = [m + q if rng.random() < 0.7 else int(rng.integers(m)) for q in range(len(asked))]
        shows = np.array(clips)[:, None] == np.arange(m)
        asked = Questions(table.of_steps(clips), limits, shows)
        problem = replace(problem, questions=asked)
    answers = rng.integers(0, 2, (m + len(clips), 1 << problem.n_messages)).astype(np.uint8)
    listening = LISTENING[rng.integers(len(LISTENING))]
    solvers = [QMDP()] if listening != (1.0, 0.0) else [QMDP(), QHR(), Conformant()]
    if clips:
        # The experiments' questions come after the trace, as do their copies of its transitions.
        answers[m:] = answers[clips]
        solvers[1:] = [Certified(gap=0.05, nodes=200)] * (listening == (1.0, 0.0))
    update = (Independent if rng.random() < 0.5 else Persistent)(
        [0.0, 0.2, "learned"][rng.integers(3)], *listening
    )
    explainer = Explainer(
        GivenTypes(table, problem.message_names, problem.type_names, problem.prior),
        solvers[rng.integers(len(solvers))],
        problem.trade_off,
        problem.message_cost,
        problem.inexplicability_cost,
        problem.discount,
        problem.discount_per,
        update,
        ask=limits,
    )
    problem = problem.with_habits(update.habits(None))
    return Situation(explainer, problem, tuple(clips), answers)


@given(situations())
@settings(max_examples=90, deadline=None)
def test_a_session_is_an_episode_of_the_experiments(situation: Situation) -> None:
    explainer, problem = situation.explainer, situation.problem
    policy, user = explainer.solver.plan(problem), SimulatedUser.of(situation.answers)
    episode = explain(problem, CachedPolicy(policy), user, explainer.beliefs)
    session, asked = situation.play()
    assert asked == [(k, q) for k, q, _ in episode.questions.tolist()]
    assert list(session.explained.said) == episode.messages.tolist()
    np.testing.assert_array_equal(list(session.belief.values()), episode.beliefs[-1])
    assert session.cost == pytest.approx(episode.cost)


@given(situations(most=0))
@settings(max_examples=40, deadline=None)
def test_a_trace_that_grows_is_planned_for_with_all_that_is_known(situation: Situation) -> None:
    """Each decision is that of a session with the same knowledge from the start."""
    explainer, problem = situation.explainer, situation.problem
    session = explainer.session()
    for k in range(problem.n_steps):
        session.extend([k])
        wiser = explainer.session(range(k + 1))
        before = session.explained
        for mask, labels in zip(before.said, before.answers, strict=True):
            wiser.tell(names_of(mask, problem.message_names))
            wiser.observe(labels)
        assert wiser.messages() == session.messages()
        session.observe(situation.answers[: k + 1, mask_of(session.said, problem.message_names)])
    assert session.finished


ASKING = Explainer(TYPES, trade_off=0.5, discount=1.0, ask=Limits(cost=0.01))


@pytest.mark.parametrize("beliefs", [Independent(), Persistent()])
def test_it_asks_says_and_shows_in_turn(beliefs: BeliefUpdate) -> None:
    explainer = replace(ASKING, belief_update=beliefs)
    session = explainer.session([0, 0, 0], clips={"refuels": 1})
    question = session.next()
    assert (question.about, question.replies) == ("refuels", (("yes", 1), ("no", 0)))
    why = session.why()
    assert why.chosen == question
    assert "refuels" in str(why).splitlines()[0]
    assert [one for one in why.values if isinstance(one, Question)] == [question]
    session.answer(False)
    assert session.belief["new"] > 0.9
    assert session.next() == session.next() == Show(("fuel",), 1)
    assert session.why().chosen == ("fuel",)
    session.observe([1])
    assert session.next() == Show((), 2)
    assert session.cost == pytest.approx(0.5 + 0.01)
    assert explainer.session([0, 0, 0], clips=[1, 0, 1]).messages() == ("fuel",)  # no question
    assert explainer.session([0, 0, 0], clips=[0]).next().about == "0"  # not labelled yet


TURNS = [
    *(("answer", wrong, "a question comes first") for wrong in (0, 1, True)),
    ("next", None, None),
    *(("answer", wrong, "one of 0, 1") for wrong in (2, -1, "yes", 0.5, None, [1])),
    ("observe", [1], r"messages\(\) comes first"),
    ("answer", 1, None),
    ("answer", 1, "a question comes first"),
    ("ask", 0, "not asked yet"),
    ("ask", 1, "="),
    ("messages", None, None),
    ("answer", 0, "a question comes first"),
]
"""The calls of a session, their argument, and what is said if they are out of turn."""


def test_what_is_out_of_turn_is_refused_in_one_line() -> None:
    session = ASKING.session([0, 0], clips=[1])
    for name, value, said in TURNS:
        arguments = () if name in ("next", "messages") else (value,)
        with nullcontext() if said is None else refused(said):
            getattr(session, name)(*arguments)


def test_who_never_asks_is_given_no_clips() -> None:
    with pytest.raises(InputError, match="ask=Limits"):
        replace(ASKING, ask=None).session([0], clips=[1])
    with pytest.raises(InputError, match="a whole number in 0 … 1"):
        ASKING.session([0], clips=[9])


def test_a_belief_is_asked_by_its_two_sentences_in_their_order() -> None:
    clip = Candidate(1, "It needs fuel.\nIt needs none.", right=1)
    for right in (0, 1):
        question = ASKING.session([0, 0, 0], clips=[replace(clip, right=right)]).next()
        assert question.replies == (("It needs fuel.", 1 - right), ("It needs none.", right))
    with pytest.raises(InputError, match="two sentences"):
        ASKING.session([0], clips=[replace(clip, text="one")])
