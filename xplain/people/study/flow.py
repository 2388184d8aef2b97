"""The flow of the study:

    consent → before → briefing → training → ahead → eligibility → evaluation → quiz → questions
                           ↑__________________________|  (a failed attempt, while attempts are left)

Participants without a briefing have no eligibility test. Within the evaluation, a policy that asks
opens pages of the stage ``asking`` before a step.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, count
from typing import Any, ClassVar

import numpy as np

from xplain.errors import Refused
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
    choice,
    choices,
    small,
)
from xplain.people.plan import Way
from xplain.people.study.evaluation import (
    ENDS,
    EVALUATING,
    Asking,
    Evaluation,
    Explaining,
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
        known = [known.right for known in flow.plan.known]
        return {"told_to_all": known, "told_to_you": flow.role(state).briefing}

    def screens(self, flow: Study, state: StudyState) -> list[tuple[str, tuple[str, ...]]]:
        """Returns all screens; after a failed attempt, only the screens with facts."""
        every = super().screens(flow, state)
        return every[1:-1] if state.attempts else every

    def view(self, flow: Study, state: StudyState) -> dict[str, Any]:
        """Adds the number of attempts left."""
        left = flow.plan.rules.max_attempts - state.attempts
        return super().view(flow, state) | {"attempts_left": left}

    def advance(self, flow: Study, state: StudyState, payload: Mapping[str, Any]) -> StudyState:
        """Moves on; after a failed attempt directly to the test, because the practice is not
        repeated."""
        after = super().advance(flow, state, payload)
        again = state.attempts and after.stage != self.name
        return replace(after, stage="eligibility") if again else after


class TrainingStage(Practice["Study", StudyState]):
    """The example: an additional action that makes no sense without its message."""

    def view(self, flow: Study, state: StudyState) -> dict[str, Any]:
        """Shows the step: in the first part without its message, in the second part with the
        message."""
        slots = len(flow.plan.facts)
        return {"training": flow.plan.training, "part": state.part, "slots": slots}


class Eligibility(Stage["Study", StudyState]):
    """A test of the facts in the briefing."""

    def is_in(self, plan: StudyPlan) -> bool:
        """True if participants get a briefing, whose facts the test asks about."""
        return not plan.kinds

    def view(self, flow: Study, state: StudyState) -> dict[str, Any]:
        """Shows the questions in the participant's order."""
        questions = flow.role(state).eligibility
        return {"questions": [(i, questions[i]) for i in (state.orders or {})["eligibility"]]}

    def read(self, flow: Study, state: StudyState, form: Form) -> dict[str, Any]:
        """Reads the answers in the plan's order."""
        count = len(flow.role(state).eligibility)
        return {"answers": [small(form.get(f"q{i}")) for i in range(count)]}

    def advance(self, flow: Study, state: StudyState, payload: Mapping[str, Any]) -> StudyState:
        """Moves on if all answers are right; otherwise back to the briefing, or to the end."""
        questions = flow.role(state).eligibility
        counts = [len(question.options) for question in questions]
        chosen = choices(payload.get("answers"), counts, flow.words["answer_all"])
        attempts = state.attempts + 1
        if chosen == tuple(question.answer for question in questions):
            return flow.after(state, attempts=attempts)
        if attempts >= flow.plan.rules.max_attempts:
            return state.to(stage="ineligible", attempts=attempts)
        return state.to(stage="briefing", attempts=attempts, wrong=True)


class Quiz(Stage["Study", StudyState]):
    """A quiz: the participant ticks the statements that are true of the robot. The briefing cannot
    be opened here."""

    def view(self, flow: Study, state: StudyState) -> dict[str, Any]:
        """Shows the statements in the participant's order."""
        statements = flow.role(state).quiz
        return {"statements": [(i, statements[i].text) for i in (state.orders or {})["quiz"]]}

    def read(self, flow: Study, state: StudyState, form: Form) -> dict[str, Any]:
        """Reads the ticked statements."""
        return {"chosen": [small(text) for text in form.getlist("true")[:100]]}

    def advance(self, flow: Study, state: StudyState, payload: Mapping[str, Any]) -> StudyState:
        """Gives a point for each statement judged correctly."""
        statements, chosen = flow.role(state).quiz, payload.get("chosen")
        missing = flow.words["quiz_missing"]
        if not isinstance(chosen, list) or len(chosen) > len(statements):
            raise Refused(missing)
        ticked = {choice(c, len(statements), missing) for c in chosen}
        score = sum(statement.true == (i in ticked) for i, statement in enumerate(statements))
        return flow.after(state, score=score)


class LastQuestions(QuestionStage["Study", StudyState]):
    """The lab's questions after the quiz, including attention checks."""

    def advance(self, flow: Study, state: StudyState, payload: Mapping[str, Any]) -> StudyState:
        """Counts the failed checks. Participants with failed checks are excluded from the
        analysis."""
        wrong = [q for q in flow.plan.asked if q.right and payload.get(q.name) != q.right]
        return replace(super().advance(flow, state, payload), missed=len(wrong))


@dataclass(frozen=True)
class Study(Explaining):
    """A running plan with its policies. Places are permuted blocks of every type and condition. A
    participant takes a place at the consent, gives it back after dropping out, a time-out or failed
    tests, and uses it up by finishing. The participants' states have all this information."""

    PLAN = StudyPlan
    PACKAGE = "xplain.people.study"
    DATA = "CSV and Parquet tables"
    STATE: ClassVar = StudyState
    STAGES: ClassVar = (
        StudyConsent("consent", "consent"),
        QuestionStage("before", "screening", "before", "screened_out"),
        StudyBriefing("briefing", "read"),
        TrainingStage("training", "example"),
        LookingAhead("ahead", "ahead"),
        Eligibility("eligibility", "eligibility"),
        Evaluation("evaluation", "labels"),
        Asking("asking", "clip"),
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

    def advance(self, state: StudyState, kind: str, payload: Mapping[str, Any]) -> StudyState:
        """Gives a returning participant the free place."""
        after = super().advance(state, kind, payload)
        return replace(after, **payload) if kind == "return" else after

    # Places --------------------------------------------------------------------------------------

    def cell(self, stream_name: str, position: int) -> tuple[int, str]:
        """Returns type and condition of a place. Each block of places contains every cell once, in
        a seeded order."""
        block, place = divmod(position, len(self.plan.cells))
        rng = stream(self.plan.seed, "slots", stream_name, block)
        return self.plan.cells[int(rng.permutation(len(self.plan.cells))[place])]

    def holders(self, people: People) -> dict[tuple[str, int], StudyState]:
        """Returns {(stream, position): state} of participants who hold or have used up a place."""
        return {
            (one.stream, one.state.place): one.state
            for one in people
            if one.state.place is not None
        }

    def admit(self, person: Participant[StudyState], people: People) -> dict[str, Any]:
        """Chooses the first free place of the person's stream, and the orders of questions. A
        preview takes no place."""
        own, number, cell, position = person.stream, person.number, None, None
        if person.state.cell is None:
            position = self._find_free(own, people)
            cell = self.cell(own, position)
        user_type, condition = cell or self.plan.cells[person.state.cell or 0]
        role, rng = self.plan.roles[user_type], stream(self.plan.seed, "orders", own, number)
        tests = {"eligibility": role.eligibility, "quiz": role.quiz}
        orders = {name: rng.permutation(len(test)).tolist() for name, test in tests.items()}
        place = {"position": position, "user_type": user_type, "condition": condition}
        return place | {"orders": orders}

    def readmit(self, person: Participant[StudyState], people: People) -> dict[str, Any]:
        """Chooses a place with the same type and condition as the lost place."""
        state = person.state
        if state.position is None:
            return {}
        return {"position": self._find_free(person.stream, people, state)}

    def _find_free(self, own: str, people: People, like: StudyState | None = None) -> int:
        """Finds the first free place of a stream; with ``like``, a place with this type and
        condition.

        Raises:
            Full: all places of people are taken. (Pilots and bots always get a place.)
        """
        held, most = self.holders(people), self.plan.rules.per_cell * len(self.plan.cells)
        for position in range(most) if own == "person" else count():
            fits = like is None or self.cell(own, position) == (like.user_type, like.condition)
            if fits and (own, position) not in held:
                return position
        raise Full("full")

    def read_consent(self, payload: Mapping[str, Any]) -> dict[str, Any]:
        """Reads the assigned place (type and condition) and the orders of the questions.

        Raises:
            Refused: the browser window is too narrow.
        """
        width, least = payload.get("width"), self.plan.rules.min_width
        if least and (not isinstance(width, int) or width < least):
            raise Refused(self.words["too_narrow"].format(width=least))
        orders = {name: tuple(order) for name, order in payload["orders"].items()}
        place = {key: payload[key] for key in ("position", "user_type", "condition")}
        return place | {"orders": orders}

    # What a server shows -------------------------------------------------------------------------

    @property
    def cells(self) -> tuple[str, ...]:
        """The names of the cells: every type under every condition."""
        return tuple(f"{self.plan.roles[t].name}, {condition}" for t, condition in self.plan.cells)

    def find_drawing(self, what: int | tuple[str, int]) -> tuple[Way | None, int, Sequence[str]]:
        """Returns the way, the number of steps and the items taken: of the trace after ``what``
        steps, or of one clip."""
        plan = self.plan
        if isinstance(what, tuple):
            clip = plan.clips[what[1]]
            return clip.way or None, 1, clip.gone
        return plan.path, what, plan.taken[what] if plan.taken else ()

    @property
    def titles(self) -> dict[str, str]:
        """Adds the title of questions between steps."""
        return super().titles | {"asking": self.words["asking"]}

    def about(self, state: StudyState, blinded: bool) -> dict[str, str]:
        """Adds the columns of type and condition, unless types and conditions must stay hidden."""
        role = "" if state.user_type is None else self.plan.roles[state.user_type].name
        hidden = {} if blinded else {"Type": role, "Condition": state.condition or ""}
        return super().about(state, blinded) | hidden

    def step_of(self, state: StudyState) -> str:
        """Names the step of the evaluation."""
        before = "before " if state.stage == "asking" else ""
        return f"{before}step {state.step + 1}" if state.stage in EVALUATING else ""

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
        """Simulates one person of each kind who never errs, under each condition."""
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
        """Returns the smallest difference between two conditions: the difference in the number of
        messages (and questions) for people who never err, as a mean over types."""
        given = [
            [(one.n_messages, one.n_questions) for one in met] for met in self.faultless().values()
        ]
        gaps = [np.abs(np.subtract(a, b)).sum(axis=1).mean() for a, b in combinations(given, 2)]
        return float(min(gaps, default=np.inf))
