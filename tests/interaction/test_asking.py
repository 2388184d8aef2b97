"""Compares sessions that ask with the experiments' loop, also across restarts."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from xplain import Explainer, GivenTypes
from xplain.errors import InputError
from xplain.explanation.actions import AskQuestion
from xplain.explanation.asking import Limits, Question
from xplain.explanation.belief import Independent, Persistent
from xplain.explanation.label_table import join_steps
from xplain.explanation.message_sets import indices, mask_of
from xplain.interaction.dialogue import Answered, Asked, Dialogue, Given, Labelled
from xplain.interaction.session import Candidate, Session, Show
from xplain.solvers.base import messages_of
from xplain.solvers.greedy import QMDP
from xplain.solvers.hsvi import Certified
from xplain.testing.problems import random_problem, with_questions

TABLE = np.array([[[0.05, 0.95], [0.05, 0.95]], [[0.95, 0.95], [0.95, 0.95]]])
TYPES = GivenTypes(TABLE, ("fuel",), ("new", "old"))


@dataclass(frozen=True)
class Situation:
    """A session before its start, and a user's answers [m + Q, 2^n] about transitions and then
    clips."""

    explainer: Explainer
    steps: int
    clips: tuple[Any, ...]
    answers: np.ndarray
    rng: np.random.Generator

    def session(self) -> Session:
        return self.explainer.session(range(self.steps), clips=self.clips)

    def by_hand(self) -> tuple[list[tuple[int, int]], list[int], np.ndarray]:
        """Questions with their steps, messages, and the last belief of the experiments' loop."""
        problem = self.session()._talk.problem
        policy = self.explainer.solver.plan(problem)
        talk = Dialogue(problem, policy, self.explainer.belief_update)
        questions, messages = [], []
        while (k := talk.state.visible.step) < problem.n_steps:
            action = talk.decide()
            if isinstance(action, AskQuestion):
                q, given = action.question, talk.state.visible.given
                questions.append((k, q))
                talk.hear(Asked(q), Answered(int(self.answers[self.clips[q], given])))
                continue
            messages.append(messages_of(action))
            talk.hear(Given(messages[-1]))
            labels = self.answers[: k + 1, talk.state.visible.given]
            talk.hear(Labelled(tuple(labels.tolist())))
        return questions, messages, problem.type_belief(talk.state.belief)

    def move(self, session: Session) -> Any:
        """One move of the session, answered."""
        move = session.next()
        assert session.next() == move
        given = mask_of(session.said, self.explainer.types.messages)
        if isinstance(move, Question):
            row = self.clips[move.number]
            session.answer(int(self.answers[row, given]))
        elif isinstance(move, Show):
            session.observe(self.answers[: move.steps, given])
        return move

    def play(self, session: Session) -> list[Any]:
        moves = []
        while not session.finished:
            moves.append(self.move(session))
        return moves


@st.composite
def situations(draw: st.DrawFn) -> Situation:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    problem = random_problem(rng, max_steps=4, max_messages=2)
    assume(problem.p_explicable.any() and problem.habits.never_err)
    problem = with_questions(rng, problem, most=3)
    asked = problem.questions
    table = join_steps([problem.table, asked.table])
    m, count = problem.n_steps, len(asked)
    clips = [m + q if rng.random() < 0.7 else int(rng.integers(m)) for q in range(count)]
    update = (Independent if rng.random() < 0.5 else Persistent)(
        [0.0, 0.1, "learned"][rng.integers(3)]
    )
    exact = rng.random() < 0.3
    explainer = Explainer(
        GivenTypes(table, problem.message_names, problem.type_names, problem.prior),
        Certified(gap=0.05, nodes=200) if exact else QMDP(),
        problem.trade_off,
        problem.message_cost,
        problem.inexplicability_cost,
        problem.discount,
        problem.discount_per,
        update,
        ask=asked.limits,
    )
    answers = rng.integers(0, 2, (m + count, 1 << problem.n_messages)).astype(np.uint8)
    # The experiments' questions come after the trace, as do their copies of its transitions.
    for q, row in enumerate(clips):
        answers[m + q] = answers[row]
    return Situation(explainer, m, tuple(clips), answers, rng)


@given(situations())
@settings(max_examples=60, deadline=None)
def test_a_session_that_asks_is_the_experiments_loop(situation: Situation) -> None:
    session, (questions, messages, belief) = situation.session(), situation.by_hand()
    moves, step, asked = situation.play(session), 0, []
    for move in moves:
        asked += [(step, move.number)] if isinstance(move, Question) else []
        step += isinstance(move, Show)
    assert asked == questions
    assert list(session.explained.said) == messages
    np.testing.assert_array_equal(list(session.belief.values()), belief)
    problem = session._talk.problem
    said = sum(float(problem.message_cost[j]) for new in messages for j in indices(new))
    zeros = sum(int((labels == 0).sum()) for labels in session.explained.answers)
    price = problem.questions.limits.cost * len(questions)
    wanted = problem.trade_off * said + problem.inexplicability_cost * zeros + price
    assert session.cost == pytest.approx(wanted)


ASKING = Explainer(TYPES, trade_off=0.5, discount=1.0, ask=Limits(cost=0.01))


def test_it_asks_says_and_shows_in_turn() -> None:
    session = ASKING.session([0, 0, 0], clips={"refuels": 1})
    question = session.next()
    assert isinstance(question, Question)
    assert (question.about, question.replies) == ("refuels", (("yes", 1), ("no", 0)))
    why = session.why()
    assert why.asked == question
    assert "refuels" in str(why).splitlines()[0]
    assert [one for one, _ in why.questions] == [question]
    session.answer(False)
    assert session.belief["new"] > 0.9
    assert session.next() == session.next() == Show(("fuel",), 1)
    assert session.why().chosen == ("fuel",)
    session.observe([1])
    assert session.next() == Show((), 2)
    assert session.cost == pytest.approx(0.5 + 0.01)


def test_what_is_answered_out_of_turn_is_refused_in_one_line() -> None:
    session = ASKING.session([0, 0], clips=[1])
    for wrong in (0, 1, True):
        with pytest.raises(InputError, match="a question comes first"):
            session.answer(wrong)
    session.next()
    for no_answer in (2, -1, "yes", 0.5, None, [1]):
        with pytest.raises(InputError, match="one of 0, 1"):
            session.answer(no_answer)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"messages\(\) comes first"):
        session.observe([1])
    session.answer(1)
    with pytest.raises(InputError, match="a question comes first"):
        session.answer(1)
    with pytest.raises(InputError, match="not asked yet"):
        session.ask(0)
    with pytest.raises(InputError):
        session.ask(1)
    session.messages()
    with pytest.raises(InputError, match="a question comes first"):
        session.answer(0)


def test_who_never_asks_is_given_no_clips() -> None:
    with pytest.raises(InputError, match="ask=Limits"):
        replace(ASKING, ask=None).session([0], clips=[1])
    with pytest.raises(InputError, match="a whole number in 0 … 1"):
        ASKING.session([0], clips=[9])
    assert ASKING.session([0, 0]).next() == Explainer(TYPES, trade_off=0.5).session([0, 0]).next()


def test_a_belief_is_asked_by_its_two_sentences_in_their_order() -> None:
    clip = Candidate(1, "It needs fuel.\nIt needs none.", right=1)
    question = ASKING.session([0, 0, 0], clips=[clip]).next()
    assert isinstance(question, Question)
    assert question.replies == (("It needs fuel.", 0), ("It needs none.", 1))
    with pytest.raises(InputError, match="two sentences"):
        ASKING.session([0], clips=[replace(clip, text="one")])


def test_a_trace_that_grows_keeps_what_was_asked() -> None:
    for update in (Independent(), Persistent(error=0.1)):
        explainer = replace(ASKING, belief_update=update)
        session = explainer.session([0], clips={"refuels": 1})
        session.ask(0)
        session.answer(0)
        before, cost = session.belief, session.cost
        session.extend([1, 0])
        assert session.belief == pytest.approx(before)
        assert session.cost == cost
        assert session._talk.problem.questions.shows.tolist() == [[False, True, False]]


def test_a_copy_of_a_transition_is_no_news_where_people_repeat_themselves() -> None:
    session = Explainer(TYPES, trade_off=100, belief_update=Persistent(0.1)).session([0, 0])
    for labels in ([0], [0, 0]):
        assert session.messages() == ()
        before = session.belief
        session.observe(labels)
    assert session.belief == before
