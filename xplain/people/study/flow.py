"""The flow of the study:

    consent → before → briefing → practice → ahead → eligibility → evaluation → quiz → questions
                           ↑__________________________|  (a failed attempt, while attempts are left)

Participants without a briefing have no eligibility test. Within the evaluation, a policy that asks
opens pages of the stage ``asking`` before a step.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, count
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np

from xplain.explanation.label_table import LabelTable, join_steps
from xplain.interaction.episode import Episode, explain
from xplain.interaction.explainees import SimulatedUser
from xplain.people.flow import (
    Briefing,
    Consent,
    Form,
    Full,
    LookingAhead,
    Participant,
    People,
    Practice,
    QuestionStage,
    Stage,
    pick,
)
from xplain.people.plan import Way
from xplain.people.study.evaluation import (
    ENDS,
    ClipQuestion,
    Evaluation,
    ExplanationFlow,
    StudyState,
)
from xplain.people.study.plan import ASKING, StudyPlan
from xplain.randomness import derive_seed, stream
from xplain.solvers.base import CachedPolicy

__all__ = ["ENDS", "Study", "StudyState"]
_WIDTH = re.compile(r"[1-9][0-9]{1,4}\Z")


class StudyConsent(Consent["Study", StudyState]):
    """The consent, with the width of the window."""

    def read(self, flow: Study, state: StudyState, form: Form) -> dict[str, Any]:
        """Reads the decision, and the width of the window, which is None without scripts."""
        width = (form.getlist("width") or [""])[-1]
        return super().read(flow, state, form) | {
            "width": int(width) if _WIDTH.match(width) else None
        }


class StudyBriefing(Briefing["Study", StudyState]):
    """The facts that all participants learn, and the facts as this user type believes them."""

    def facts(self, flow: Study, state: StudyState) -> Mapping[str, Sequence[str]]:
        """Returns the facts for all participants, and the facts in the briefing of the role."""
        known = [known.message for known in flow.plan.known]
        return {"told_to_all": known, "told_to_you": flow.role(state).briefing}

    def screens(self, flow: Study, state: StudyState) -> list[tuple[str, tuple[str, ...]]]:
        """Returns all screens; after a failed attempt, only the screens with facts."""
        every = super().screens(flow, state)
        return every[1:-1] if state.attempts else every

    def view(self, flow: Study, state: StudyState) -> dict[str, Any]:
        """Adds the number of eligibility tests that the participant may still take."""
        left = flow.plan.rules.max_attempts - state.attempts
        return super().view(flow, state) | {"attempts_left": left}

    def advance(self, flow: Study, state: StudyState, payload: Mapping[str, Any]) -> StudyState:
        """Moves to the next stage. After a failed eligibility test, moves directly to the next
        test, because the practice is not repeated."""
        after = super().advance(flow, state, payload)
        again = state.attempts and after.stage != self.name
        return replace(after, stage="eligibility") if again else after


class Eligibility(Stage["Study", StudyState]):
    """A test of the facts in the briefing."""

    def view(self, flow: Study, state: StudyState) -> dict[str, Any]:
        """Shows the questions in the participant's order."""
        questions = flow.role(state).eligibility
        return {"questions": [(i, questions[i]) for i in (state.orders or {})["eligibility"]]}

    def read(self, flow: Study, state: StudyState, form: Form) -> dict[str, Any]:
        """Reads the answers in the plan's order."""
        counts = [len(question.options) for question in flow.role(state).eligibility]
        missing = flow.words["answer_all"]
        return {"answers": [pick(form.get(f"q{i}"), n, missing) for i, n in enumerate(counts)]}

    def advance(self, flow: Study, state: StudyState, payload: Mapping[str, Any]) -> StudyState:
        """Moves on if all answers are right; otherwise back to the briefing, or to the end."""
        right = [question.answer for question in flow.role(state).eligibility]
        attempts = state.attempts + 1
        if payload["answers"] == right:
            return flow.after(state, attempts=attempts)
        if attempts >= flow.plan.rules.max_attempts:
            return state.to(stage="ineligible", attempts=attempts)
        # The practice ended at its second part; the briefing starts at its first screen.
        return state.to(stage="briefing", part=0, attempts=attempts, wrong=True)


class Quiz(Stage["Study", StudyState]):
    """A quiz: the participant ticks the statements that are true of the robot. The briefing cannot
    be opened here."""

    def view(self, flow: Study, state: StudyState) -> dict[str, Any]:
        """Shows the statements in the participant's order."""
        statements = flow.role(state).quiz
        return {"statements": [(i, statements[i].text) for i in (state.orders or {})["quiz"]]}

    def read(self, flow: Study, state: StudyState, form: Form) -> dict[str, Any]:
        """Reads the ticked statements."""
        count, wrong = len(flow.role(state).quiz), flow.words["quiz_missing"]
        return {"chosen": [pick(text, count, wrong) for text in form.getlist("true")]}

    def advance(self, flow: Study, state: StudyState, payload: Mapping[str, Any]) -> StudyState:
        """Stores the score: one point for each statement that the participant judged correctly."""
        judged = enumerate(flow.role(state).quiz)
        score = sum(statement.true == (i in payload["chosen"]) for i, statement in judged)
        return flow.after(state, score=score)


class LastQuestions(QuestionStage["Study", StudyState]):
    """The lab's questions after the quiz, including attention checks."""

    def advance(self, flow: Study, state: StudyState, payload: Mapping[str, Any]) -> StudyState:
        """Counts the failed checks. Participants with failed checks are excluded from the
        analysis."""
        wrong = [q for q in flow.plan.asked if q.right and payload.get(q.name) != q.right]
        return replace(super().advance(flow, state, payload), missed=len(wrong))


@dataclass(frozen=True)
class Study(ExplanationFlow):
    """A running plan with its policies.

    A *place* is one numbered opening for a participant of one type and condition. The places are
    divided into blocks. Each block has one place for every pair of a type and a condition, in
    random order. A participant takes a place at the consent, gives it back after dropping out, a
    time-out or failed tests, and uses it up by finishing. The states of the participants tell which
    places are free.
    """

    PLAN = StudyPlan
    PACKAGE = "xplain.people.study"
    STATE: ClassVar = StudyState
    STAGES: ClassVar = (
        StudyConsent("consent", "consent"),
        QuestionStage("before", "screening", attrgetter("before"), missed="screened_out"),
        StudyBriefing("briefing", "read"),
        Practice("practice", "example"),
        LookingAhead("ahead", "ahead", attrgetter("ahead")),
        Eligibility("eligibility", "eligibility", lambda plan: not plan.kinds),
        Evaluation("evaluation", "labels"),
        ClipQuestion("asking", "clip", within="evaluation"),
        Quiz("quiz", "quiz"),
        LastQuestions("questions", "answers"),
    )

    @classmethod
    def of(cls, plan: StudyPlan) -> Study:
        """Creates the study, with policies from the conditions' configurations."""
        from hydra.utils import instantiate  # needed only at the start

        seed = derive_seed(plan.seed, "solver")
        policies = {
            condition: CachedPolicy(instantiate(solver).plan(plan.problem_of(condition), seed))
            for condition, solver in plan.conditions.items()
        }
        return cls(plan, policies, instantiate(plan.belief))

    def view(self, state: StudyState) -> dict[str, Any]:
        """Adds to the last page the untrue sentences of the briefing, unless the participant may
        return."""
        view = super().view(state)
        if not state.over or state.stage == "timed_out" or state.user_type is None:
            return view
        role, facts = self.role(state), self.plan.facts
        untrue = role.wrong if role.briefing else ()
        return view | {"untrue": [(role.briefing[j], facts[j].message) for j in untrue]}

    # Places --------------------------------------------------------------------------------------

    def cell(self, stream_name: str, position: int) -> tuple[int, str]:
        """Returns type and condition of a place. Each block of places contains every pair (type,
        condition) once, in a seeded order.

        Args:
            stream_name: kind of participants: "person", "pilot" or "bot"; each kind has its own
                places.
            position: number of the place, from 0.
        """
        block, place = divmod(position, len(self.plan.cells))
        rng = stream(self.plan.seed, "slots", stream_name, block)
        return self.plan.cells[int(rng.permutation(len(self.plan.cells))[place])]

    def holders(self, people: People) -> dict[tuple[str, int], StudyState]:
        """Returns {(stream, place): state} of participants who hold or have used up a place; a
        stream is "person", "pilot" or "bot"."""
        return {
            (one.stream, one.state.place): one.state
            for one in people
            if one.state.place is not None
        }

    def admit(self, person: Participant[StudyState], people: People) -> dict[str, Any]:
        """Chooses the first free place for a person, and the orders of the questions. A pilot for
        whom a researcher chose type and condition (a preview) takes no place.

        Returns:
            {"position", "user_type", "condition", "orders"}, as in :class:`StudyState`.
        """
        own, number, preview = person.stream, person.number, person.state.cell
        position = self._find_free(own, people) if preview is None else None
        user_type, condition = (
            self.plan.cells[preview or 0] if position is None else self.cell(own, position)
        )
        role, rng = self.plan.roles[user_type], stream(self.plan.seed, "orders", own, number)
        tests = {"eligibility": role.eligibility, "quiz": role.quiz}
        orders = {name: tuple(rng.permutation(len(test)).tolist()) for name, test in tests.items()}
        place = {"position": position, "user_type": user_type, "condition": condition}
        return place | {"orders": orders}

    def readmit(self, person: Participant[StudyState], people: People) -> dict[str, Any]:
        """Chooses a free place for a participant who returns after a time-out. It has the type and
        condition of the place that the participant lost.

        Returns:
            {"position": number of the place}; {} if the participant never had a place.
        """
        state = person.state
        if state.position is None:
            return {}
        return {"position": self._find_free(person.stream, people, state)}

    def _find_free(self, own: str, people: People, like: StudyState | None = None) -> int:
        """Returns the number of the first free place.

        Args:
            own: kind of participants: "person", "pilot" or "bot"; each kind has its own places.
            people: all participants.
            like: a state whose type and condition the place must have; None allows every place.

        Raises:
            Full: all places of people are taken. (Pilots and bots always get a place.)
        """
        held, most = self.holders(people), self.plan.rules.per_cell * len(self.plan.cells)
        for position in range(most) if own == "person" else count():
            fits = like is None or self.cell(own, position) == (like.user_type, like.condition)
            if fits and (own, position) not in held:
                return position
        raise Full("full")

    # What a server shows -------------------------------------------------------------------------

    @property
    def cells(self) -> tuple[str, ...]:
        """The names of the cells: every type under every condition."""
        return tuple(f"{self.plan.roles[t].name}, {condition}" for t, condition in self.plan.cells)

    def find_drawing(self, what: int | tuple[str, int]) -> tuple[Way | None, int, Sequence[str]]:
        """Returns what a map shows.

        Args:
            what: number of steps of the trace; or ("clip", index of a question), for the transition
                that the question is about.

        Returns:
            The robot's moves (None if there is no map), the number of moves to draw, and the names
            of the items that are no longer on the map.
        """
        plan = self.plan
        if isinstance(what, tuple):
            clip = plan.clips[what[1]]
            return clip.way or None, 1, clip.gone
        return plan.path, what, plan.taken[what] if plan.taken else ()

    def about(self, state: StudyState) -> dict[str, str]:
        """Returns the type and the condition of a participant, for the researcher's page."""
        role = "" if state.user_type is None else self.plan.roles[state.user_type].name
        return {"Type": role, "Condition": state.condition or ""}

    # What to expect ------------------------------------------------------------------------------

    def announcement(self) -> str:
        """Returns a line with the cost of each condition for people who never err; "" if no
        condition asks."""
        if ASKING not in self.plan.conditions:
            return ""
        met = self.faultless().items()
        costs = ", ".join(f"{np.mean([o.cost for o in every]):.2f} {name}" for name, every in met)
        asked = np.mean([one.n_questions for name, every in met if name == ASKING for one in every])
        return (
            f"study: λ · messages + inexplicable labels + κ · questions of people who never err: "
            f"{costs} ({asked:.1f} questions)\n"
        )

    def faultless(self) -> dict[str, list[Episode]]:
        """Simulates one person of each user type (or of each kind of ``plan.kinds``) who never
        errs.

        Returns:
            {condition: the episode of each person}.
        """
        plan, found = self.plan, {}
        of_clips = () if plan.clip_labels is None else (plan.clip_labels,)
        tables = [
            join_steps([LabelTable.dense(one[None]), *(clips.of_types([i]) for clips in of_clips)])
            for i, one in enumerate(plan.true_labels)
        ]
        for condition, policy in self.policies.items():
            problem = plan.problem_of(condition)
            found[condition] = [
                explain(problem, policy, SimulatedUser(labels), self.belief) for labels in tables
            ]
        return found

    def difference(self) -> float:
        """Returns how much the two most similar conditions differ, for people who never err: the
        mean over people of the difference in messages plus the difference in questions."""
        given = [
            [(one.n_messages, one.n_questions) for one in met] for met in self.faultless().values()
        ]
        gaps = [np.abs(np.subtract(a, b)).sum(axis=1).mean() for a, b in combinations(given, 2)]
        return float(min(gaps, default=np.inf))
