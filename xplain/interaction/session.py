"""A session: one trace explained to one user, by names (paper, "Explaining a plan trace")."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, one_of
from xplain.explanation.asking import NO_QUESTION
from xplain.explanation.label_table import LabelTable, joined
from xplain.explanation.listening import Explained
from xplain.explanation.message_sets import mask_of, names_of
from xplain.explanation.problem import Problem
from xplain.interaction.interaction import Interaction
from xplain.interaction.moves import Candidate, Move, Say, Show, Why, in_order, plain, questions_of
from xplain.interaction.planner import Planner
from xplain.solvers.base import Policy, asking

FORMAT = 3
"""Version of a session's JSON."""


class Session:
    """One trace, one user. Made by :meth:`xplain.Explainer.session`.

    Each step: :meth:`messages` to say, then the first ``shown`` transitions to show, then
    :meth:`observe` with the user's labels of them. :meth:`extend` at any time. Where something may
    be asked, :meth:`next` says what to do, and :meth:`answer` takes the user's answers.
    """

    def __init__(
        self, planner: Planner, expected_steps: int = 0, clips: tuple[Candidate, ...] = ()
    ) -> None:
        self._planner = planner
        self._expected_steps = expected_steps
        self._clips = clips
        self._trace: list[Any] = []
        self._table = planner.unknown(0)
        self._asked_about: LabelTable | None = None
        if clips:
            self._asked_about = planner.types.label_table([clip.transition for clip in clips])
        problem = self._problem(planner.unknown(1))
        if clips:  # refused at once, and not by the first question
            asking(planner.solver.plan(problem, planner.seed))
        self._talk = Interaction(problem, planner.plan(problem), planner.beliefs)
        self._said: list[int] = []
        self._answers: list[NDArray[np.uint8]] = []
        self._questions: list[tuple[int, int, int]] = []  # (step, number, answer)
        self._open = self._chosen = NO_QUESTION
        self._told = False
        self._decision: tuple[Policy, int, int, NDArray[np.float64], tuple[int, ...]] | None = None

    @property
    def trace(self) -> tuple[Any, ...]:
        """All transitions known so far, in order, as they were given."""
        return tuple(self._trace)

    @property
    def shown(self) -> int:
        """How many transitions are shown to the user at this step."""
        return len(self._answers) + (not self.finished)

    @property
    def finished(self) -> bool:
        """Whether the user has labelled the whole trace known so far."""
        return len(self._answers) == len(self._trace)

    @property
    def said(self) -> tuple[str, ...]:
        """Names of all messages given so far, sorted."""
        return self._names(self._talk.given)

    @property
    def again(self) -> tuple[str, ...]:
        """Names of the messages of this step that had been said before, as users may miss or
        forget some."""
        *earlier, now = self._said or [0]
        return self._names(now & int(np.bitwise_or.reduce(np.array([0, *earlier]))))

    @property
    def explained(self) -> Explained:
        """What was said and answered, of one person: the data of
        :func:`~xplain.explanation.listening.learned_habits`."""
        return Explained(self._talk.problem, tuple(self._said), tuple(self._answers))

    @property
    def belief(self) -> dict[str, float]:
        """``{type: probability}``, given all labels so far; they sum to 1."""
        return self._by_name(self._talk.belief)

    @property
    def cost(self) -> float:
        """Definition 2 of the paper for what happened so far, undiscounted; and κ for each
        question answered."""
        problem = self._talk.problem
        said = problem.communication(self._said)
        zeros = sum(int((labels == 0).sum()) for labels in self._answers)
        asked = problem.questions.limits.cost * len(self._questions) if problem.questions else 0.0
        return problem.trade_off * said + problem.inexplicability_cost * zeros + asked

    def extend(self, transitions: Sequence[Any] | NDArray[Any]) -> None:
        """The robot did (or plans) more: they follow the known transitions.

        The next decision is planned with them. What was said and answered stays.

        Raises:
            InputError: a transition that ``types`` does not take.
        """
        new = [plain(row) for row in transitions]
        if not new:
            return
        table = joined([self._table, self._planner.types.label_table(new)])
        known = len(self._trace) + len(new)
        ahead = self._planner.unknown(max(self._expected_steps - known, 0))
        problem = self._problem(joined([table, ahead]), [*self._trace, *new])
        self._table = table
        self._trace += new
        self._talk.problem, self._talk.policy = problem, self._planner.plan(problem)
        if problem.tracks_knowledge:  # more facts may matter now, and a belief is over these
            self._talk.begin()
            talk = self._talk.hear_answer, self._talk.give, self._talk.hear
            in_order(self._questions, self._said, self._answers, *talk)

    def _problem(self, table: LabelTable, trace: Sequence[Any] = ()) -> Problem:
        """What is planned for: the table of a trace, of which so much is known, and what may be
        asked."""
        planner, about = self._planner, self._asked_about
        if about is None or planner.ask is None:
            return planner.problem(table)
        asked = questions_of(self._clips, about, planner.ask, trace, len(table.p))
        return planner.problem(table, asked)

    def next(self) -> Move:
        """What to do now: ask a question, then :meth:`answer`; say messages, then ``next`` again;
        or show steps, then :meth:`observe`. Called again before that, it answers the same; once
        messages were told of, it is their steps.

        Raises:
            InputError: every transition known is answered.
        """
        if not self._waits:
            if self._open == NO_QUESTION and not self.finished:
                self._decide()
                self._open = self._chosen = self._talk.ask()
            if self._open != NO_QUESTION:
                assert self._talk.problem.questions is not None
                return self._talk.problem.questions.question(self._open)
        said = self.messages()
        if said and not self._told:
            self._told = True
            return Say(said)
        return Show(self.shown)

    def ask(self, number: int) -> None:
        """Asks this of the ``clips``, by its number, whatever the plan; :meth:`answer` follows.

        Raises:
            InputError: there is none, it was asked already, or this step's messages are said.
        """
        one_of("question", number, range(len(self._clips)), "number of a clip")
        if self._waits or self.finished or self._talk.asked >> number & 1:
            raise InputError("question", number, "one not asked yet, before the step's messages")
        self._decide()
        self._open = self._chosen = number

    def take_up(
        self,
        questions: Sequence[Sequence[int]],
        said: Sequence[Sequence[str]],
        answers: Sequence[ArrayLike],
        question: int,
        told: bool,
    ) -> None:
        """All that happened (:func:`~xplain.interaction.moves.in_order`), to where it stood: this
        question is not answered yet, and messages were told of.

        Raises:
            InputError: as :meth:`ask`, :meth:`answer`, :meth:`tell` and :meth:`observe`.
        """

        def ask(number: int, answer: int) -> None:
            self.ask(number)
            self.answer(answer)

        in_order(questions, said, answers, ask, self.tell, self.observe)
        if question != NO_QUESTION:
            self.ask(question)
        self._told = told

    def answer(self, answer: int) -> None:
        """The user's answer to the question of :meth:`next`: 1 (or True) for yes, and for who has
        a fact right.

        Raises:
            InputError: another answer, or nothing was asked.
        """
        if self._open == NO_QUESTION:
            raise InputError("answer", answer, "a question comes first: next()")
        if answer not in (0, 1):
            raise InputError("answer", answer, "0 or 1")
        self._talk.hear_answer(self._open, int(answer))
        self._questions.append((self._talk.step, self._open, int(answer)))
        self._open = NO_QUESTION

    @property
    def _waits(self) -> bool:
        """Whether messages were said, and the labels are not heard yet."""
        return len(self._said) > len(self._answers)

    def messages(self) -> tuple[str, ...]:
        """The messages to say now, before the first ``shown`` transitions are shown; none if it
        is best to say nothing. Asked again before :meth:`observe`, it answers the same. No
        question comes before them.

        Raises:
            InputError: every transition known is answered.
        """
        if not self._waits:
            if self.finished:
                raise InputError("session", len(self._trace), "is finished; extend the trace first")
            self._decide()
            self._said.append(self._talk.say())
            self._told = False
        return self._names(self._said[-1])

    def tell(self, names: Sequence[str]) -> None:
        """Says these messages at this step, whatever the plan.

        Raises:
            InputError: :meth:`messages` was called already, or a message is unknown, or was said as
                often as it may be.
        """
        if self._waits or self.finished:
            raise InputError("session", tuple(names), "told once a step, before messages()")
        new = mask_of(names, self._talk.problem.message_names, "session")
        if new & ~self._talk.problem.may_say(self._talk.said):
            wanted = f"messages that may be said after {self.said}"
            raise InputError("session", tuple(names), wanted)
        self._decide()
        self._talk.give(new)
        self._said.append(new)
        self._told = False

    def observe(self, labels: ArrayLike) -> None:
        """The user's labels of the first ``shown`` transitions, 1 = explicable.

        Raises:
            InputError: not so many labels, others than 0 and 1, or nothing was asked.
        """
        if not self._waits:
            raise InputError("labels", labels, "messages() comes first")
        given = np.asarray(labels)
        if given.shape != (self.shown,) or not np.isin(given, (0, 1)).all():
            wanted = f"{self.shown} labels, 0 or 1 for each transition shown so far"
            raise InputError("labels", given.tolist(), wanted)
        answer = given.astype(np.uint8)
        self._talk.hear(answer)
        self._answers.append(answer)

    def why(self) -> Why:
        """The values behind the last decision.

        Raises:
            InputError: nothing was decided yet.
        """
        if self._decision is None:
            raise InputError("session", 0, "messages() comes first")
        policy, step, given, belief, no_news = self._decision
        questions = self._talk.problem.questions
        values = policy.values(step, given, belief, *no_news)
        ranked = sorted(values.items(), key=lambda item: -item[1])
        asked = None if questions is None or self._chosen < 0 else questions.question(self._chosen)
        return Why(
            step=step,
            given=self._names(given),
            belief=self._by_name(belief),
            chosen=() if asked else self._names(self._said[-1]),
            values={self._names(mask): value for mask, value in ranked if mask >= 0},
            asked=asked,
            questions=tuple(
                (questions.question(~q), value) for q, value in ranked if q < 0 and questions
            ),
        )

    def to_json(self) -> str:
        """The whole session as text; :meth:`xplain.Explainer.from_json` takes it up again.

        Raises:
            InputError: a transition is nothing that JSON can hold.
        """
        state = {
            "format": FORMAT,
            "messages": self._planner.types.messages,
            "types": self._planner.types.names,
            "trace": self._trace,
            "expected_steps": self._expected_steps,
            "said": [self._names(mask) for mask in self._said],
            "answers": [answer.tolist() for answer in self._answers],
            "clips": [[clip.transition, clip.text, clip.right] for clip in self._clips],
            "questions": self._questions,
            "open": self._open,
            "told": self._told,
        }
        try:
            return json.dumps(state)
        except TypeError as error:
            first = [*self._trace, *(clip.transition for clip in self._clips)][0]
            raise InputError("trace", first, f"transitions for JSON ({error})") from None

    def _decide(self) -> None:
        """Keeps what the decision rests on, for :meth:`why`."""
        talk = self._talk
        self._open = self._chosen = NO_QUESTION
        no_news = (talk.no_news,) if talk.problem.questions else ()
        self._decision = talk.policy, talk.step, talk.said, talk.belief, no_news

    def _by_name(self, belief: NDArray[np.float64]) -> dict[str, float]:
        problem = self._talk.problem
        return dict(zip(problem.type_names, problem.type_belief(belief).tolist(), strict=True))

    def _names(self, mask: int) -> tuple[str, ...]:
        return names_of(mask, self._talk.problem.message_names)
