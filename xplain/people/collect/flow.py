"""The flow of a collection:

consent → task → practice → ahead → clips → listening → beliefs → questions → done
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter
from typing import Any, ClassVar

from xplain.explanation.message_sets import indices
from xplain.people.collect import asking
from xplain.people.collect.asking import (
    ATTENTION,
    HEEDED,
    QUESTION,
    STATED,
    AskedClip,
    CollectState,
)
from xplain.people.collect.plan import CollectPlan
from xplain.people.flow import (
    CANNOT_TELL,
    Briefing,
    Consent,
    Flow,
    Form,
    LookingAhead,
    Participant,
    People,
    Practice,
    QuestionStage,
    Stage,
    pick,
)
from xplain.people.plan import Way
from xplain.questions.questionnaire import Questionnaire
from xplain.randomness import derive_seed, stream


class TaskStage(Briefing["Collection", CollectState]):
    """Screens with the robot's task, which omit the facts that people are asked about, and with the
    briefing, if one is assigned."""

    def facts(self, flow: Collection, state: CollectState) -> Mapping[str, Sequence[str]]:
        """Returns the facts of the briefing, if there is a briefing."""
        return {"told_to_you": flow.briefing(state).get("briefing", ())}


@dataclass(frozen=True)
class ClipStage(Stage["Collection", CollectState]):
    """Pages with clips. A clip has a few consecutive steps, under some messages.

    Attributes:
        lasting: True if messages stay valid on later pages.
    """

    lasting: bool = False

    def enter(self, flow: Collection, state: CollectState) -> CollectState:
        """Chooses the first clip."""
        return self._choose_next(flow, replace(state, wrong=False))

    def view(self, flow: Collection, state: CollectState) -> dict[str, Any]:
        """Shows the clip; hides the hypotheses, the posterior, and the clip's purpose."""
        assert state.clip is not None, "a clip is on the page"
        return flow.briefing(state) | {
            **_describe_clip(flow.plan, state.clip),
            "lasting": self.lasting,
            "clip_number": len(state.answered) + 1,
            "clip_count": len(asking.schedule(flow.plan, state.number)),
        }

    def read(self, flow: Collection, state: CollectState, form: Form) -> dict[str, Any]:
        """Reads a label for each step."""
        assert state.clip is not None, "a clip is on the page"
        sent = [form.get(f"label_{i}") for i in range(state.clip.size)]
        missing = flow.words["label_missing"]
        return {"labels": [pick(label, CANNOT_TELL + 1, missing) for label in sent]}

    def advance(
        self, flow: Collection, state: CollectState, payload: Mapping[str, Any]
    ) -> CollectState:
        """Moves to the next clip, or to the next stage after the last clip."""
        assert state.clip is not None, "a clip is on the page"
        clip = replace(state.clip, labels=tuple(payload["labels"]))
        state = replace(state, answered=(*state.answered, clip), clip=None)
        return self._choose_next(flow, state)

    def _choose_next(self, flow: Collection, state: CollectState) -> CollectState:
        """Moves to the next clip, or to the end of the clips."""
        step, known = len(state.answered), flow.questionnaire(state)
        state = replace(state, belief=asking.belief(known))
        tasks = asking.schedule(flow.plan, state.number)
        if step == len(tasks) or (tasks[step].purpose in HEEDED) != self.lasting:
            return flow.after(state)
        clip = asking.clip(flow.plan, state, tasks, known)
        question = clip.purpose == QUESTION
        bits = known.information((list(clip.transitions), clip.told)) if question else 0.0
        return state.to(stage=self.name, clip=replace(clip, bits=float(bits)))


class BeliefStage(Stage["Collection", CollectState]):
    """A page on which people state their belief about each fact."""

    def view(self, flow: Collection, state: CollectState) -> dict[str, Any]:
        """Shows the facts in the participant's order."""
        return flow.briefing(state) | {"statements": statements(flow.plan, state.number)}

    def read(self, flow: Collection, state: CollectState, form: Form) -> dict[str, Any]:
        """Reads the participant's statement about each fact: the statement's index in STATED."""
        sent = [form.get(f"fact_{j}") for j in range(len(flow.plan.facts))]
        return {"stated": [pick(one, len(STATED), flow.words["answer_all"]) for one in sent]}

    def advance(
        self, flow: Collection, state: CollectState, payload: Mapping[str, Any]
    ) -> CollectState:
        """Moves on with the statements."""
        return flow.after(state, stated=tuple(payload["stated"]))


@dataclass(frozen=True)
class Collection(Flow[CollectPlan, CollectState]):
    """A running plan with its questionnaires."""

    PLAN = CollectPlan
    PACKAGE = "xplain.people.collect"
    STATE: ClassVar = CollectState
    STAGES: ClassVar = (
        Consent("consent", "consent"),
        TaskStage("task", "read"),
        Practice("practice", "example"),
        LookingAhead("ahead", "ahead", attrgetter("ahead")),
        ClipStage("clips", "labels"),
        ClipStage("listening", "labels", attrgetter("rules.listening"), lasting=True),
        BeliefStage("beliefs", "beliefs"),
        QuestionStage("questions", "answers"),
    )

    def admit(self, person: Participant[CollectState], people: People) -> dict[str, Any]:
        """Returns the values that the consent event needs:

        - ``number``: the participant's number.
        - ``role``: index of the role whose briefing the participant gets; None without briefings.
        - ``others``: the mean posterior of the earlier participants of the same stream whose labels
          are used.
        - ``after``: the numbers of these earlier participants.

        Without ``design.from_others`` no earlier participants are used.
        """
        own = [one for one in people if one.stream == person.stream]
        kept = {
            one.number: one.state.belief
            for one in own
            if self.plan.design.from_others and not one.state.left_out
        }
        number = person.number
        shared = asking.mean_posterior([*kept.values()])
        consent = {"number": number, "role": None, "after": [*kept], "others": shared}
        if not self.plan.assigned:
            return consent
        # The role with the fewest participants who did not leave; ties are decided at random.
        there = [one.state.role for one in own if one.state.stage not in ("withdrawn", "timed_out")]
        counts = [there.count(role) for role in range(len(self.plan.roles))]
        fewest = [role for role, count in enumerate(counts) if count == min(counts)]
        rng = stream(self.plan.seed, "roles", number)
        return consent | {"role": int(rng.choice(fewest))}

    def forget(self) -> None:
        """Forgets the found types after an erasure. They are computed again when they are
        needed."""
        self.found.clear()

    def find_drawing(self, what: tuple[int, ...]) -> tuple[Way | None, int, Sequence[str]]:
        """Finds the drawing of a clip's transitions; without transitions, of the map alone."""
        shown = self.plan.shown
        if self.plan.scene is None:
            return None, 0, ()
        way = tuple(shown[t].way[0] for t in what or (0,))
        return way, len(what), shown[what[0]].gone if what else ()

    def briefing(self, state: CollectState) -> dict[str, Any]:
        """Returns the sentences of the participant's briefing, if they have one."""
        return {} if state.role is None else {"briefing": self.plan.roles[state.role].briefing}

    @cached_property
    def found(self) -> dict[tuple[str, ...], Any]:
        """Cache: the types found in the labels of some people; the key is these people's ids."""
        return {}

    @cached_property
    def blank(self) -> Questionnaire:
        """The questionnaire before the first answer."""
        known, own = self.plan.hypotheses, self.plan.design
        return Questionnaire(known, own.error, None, own.clip, none=own.none, misread=own.misread)

    def questionnaire(self, state: CollectState) -> Questionnaire:
        """Returns the questionnaire of a participant, with all their answers."""
        seed = derive_seed(self.plan.seed, "queries", state.number)
        known = self.blank.restart(asking.prior(self.plan, state.others), seed)
        for one in (clip.judged for clip in state.questions()):
            if one.labels:
                known.answer(list(one.labels), (list(one.transitions), one.told))
        return known


def statements(plan: CollectPlan, number: int) -> list[tuple[int, list[tuple[int, str]]]]:
    """Lists the facts in a random order for each participant, each fact with its two sentences in a
    random order: [(fact, [(index into STATED, sentence), …])]."""
    rng = stream(plan.seed, "beliefs", number)
    pairs = [[(0, fact.message), (1, fact.belief)] for fact in plan.facts]
    order = rng.permutation(len(pairs)).tolist()
    return [(j, pairs[j] if rng.random() < 0.5 else pairs[j][::-1]) for j in order]


def _describe_clip(plan: CollectPlan, clip: AskedClip) -> dict[str, Any]:
    told = [plan.facts[j].message for j in indices(clip.told)]
    if clip.purpose == ATTENTION:  # with a picture if other pages have one
        picture = [t for t, one in enumerate(plan.shown) if one.picture][:1]
        shown = {"told": told, "steps": [plan.attention], "transitions": (), "situation": ()}
        return shown | {"illustrated": picture}
    steps = clip.transitions
    return {
        "told": told,
        "steps": [f"{plan.subject} {plan.hypotheses.phrases[t]}".strip() for t in steps],
        "transitions": steps,
        "illustrated": steps,
        "situation": plan.shown[steps[0]].situation,
    }
