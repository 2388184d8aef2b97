"""The state of a participant, the choice of the next clip, and the results of the answers so far.

:class:`xplain.questions.questionnaire.Questionnaire` chooses the questions, or all people get the
questions of one list. An obvious step is among the questions, and some of the first questions are
repeated. At the end, people may get messages that stay valid on later pages. Labels on these pages
show if people accept and remember the messages.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.people import flow as core
from xplain.people.collect.plan import CollectPlan
from xplain.people.flow import CANNOT_TELL
from xplain.questions.questionnaire import Questionnaire
from xplain.randomness import stream

FINISHED = ("beliefs", "questions", "done")
"""Stages after the last clip."""
QUESTION, REPEAT, ATTENTION = "question", "repeat", "attention"
TOLD, LATER, AGAIN = "told", "later", "again"
"""Purposes of the clips at the end: a step with a message that stays valid, the same step later
without the message, and the step with the message given again."""
HEEDED = (TOLD, LATER, AGAIN)
STATED = ("accurate", "inaccurate", "unsure")
"""Possible statements about a fact; the payload has the index of a statement."""
KEPT = 1e-6
"""Fact sets with a smaller posterior are not stored."""
ALTERNATIVES, AS_MUCH = 200, 0.9
"""Number of questions that are compared. A question with at least this share of the best question's
information counts as equally good."""
SHARED = 1e-3
"""Fact sets with a smaller share are left out of the next participant's prior."""


@dataclass(frozen=True)
class AskedClip:
    """A page that shows a few transitions under one message set, and the labels that it received.

    Attributes:
        purpose: QUESTION, REPEAT, ATTENTION (no transitions, one label), or a purpose in HEEDED.
        transitions: indices of transitions of the hypotheses.
        told: bitmask of the messages shown.
        labels: one for each transition, possibly CANNOT_TELL; empty before the answer.
        bits: expected information of the answer to a question, in bits.
    """

    purpose: str
    transitions: tuple[int, ...]
    told: int
    labels: tuple[int, ...] = ()
    bits: float = 0.0

    @property
    def size(self) -> int:
        """Number of steps on the page."""
        return max(len(self.transitions), 1)

    @property
    def judged(self) -> AskedClip:
        """The clip without the transitions labelled CANNOT_TELL."""
        pairs = zip(self.transitions, self.labels, strict=True)
        kept = [pair for pair in pairs if pair[1] != CANNOT_TELL]
        transitions, labels = zip(*kept, strict=True) if kept else ((), ())
        return replace(self, transitions=transitions, labels=labels)


@dataclass(frozen=True)
class CollectState(core.State):
    """The state of a participant. The default values are the start.

    Attributes:
        number: the participant's number, which seeds the questions; 0 before the consent.
        role: index of the role whose briefing the participant gets; None without a briefing.
        others: {fact set: share among earlier participants}.
        answered: clips with their labels.
        clip: the clip on the page.
        belief: {fact set, or "none": posterior} after the last question.
        stated: the participant's statement about each fact, as an index into STATED.
    """

    number: int = 0
    role: int | None = None
    others: Mapping[str, float] = field(default_factory=dict)
    answered: tuple[AskedClip, ...] = ()
    clip: AskedClip | None = None
    belief: Mapping[str, float] = field(default_factory=dict)
    stated: tuple[int, ...] = ()

    def questions(self) -> list[AskedClip]:
        """Returns the answered clips that are questions; types are learned from them."""
        return [clip for clip in self.answered if clip.purpose == QUESTION]

    @property
    def left_out(self) -> str:
        """The reason to leave this person's labels out of learning; "" if they are used."""
        if self.stage not in FINISHED:
            return self.stage if self.over else "unfinished"
        return "inattentive" if self.attentive is False else ""

    @property
    def attentive(self) -> bool | None:
        """False if the obvious step made sense to the person; None before the person saw it."""
        seen = [clip.labels[0] for clip in self.answered if clip.purpose == ATTENTION]
        return None if not seen else seen[0] != 1

    @property
    def consistency(self) -> float | None:
        """Share of equal labels in repeated clips; None without repeated clips."""
        first = {(c.transitions, c.told): c.labels for c in reversed(self.questions())}
        pairs = [
            pair
            for clip in self.answered
            if clip.purpose == REPEAT
            for pair in zip(clip.labels, first[clip.transitions, clip.told], strict=True)
            if CANNOT_TELL not in pair
        ]
        return sum(a == b for a, b in pairs) / len(pairs) if pairs else None


class ClipTask(NamedTuple):
    """The purpose of one clip.

    Attributes:
        purpose: as in :class:`AskedClip`.
        again: for REPEAT, the index of the question that is asked again; for a purpose in HEEDED, a
            number from 0 for each message that stays valid; otherwise −1.
    """

    purpose: str
    again: int = -1


def schedule(plan: CollectPlan, number: int) -> tuple[ClipTask, ...]:
    """Lists the purposes of one participant's clips, in order: questions with the obvious step
    among them; near the end some of the first questions again; then messages that stay valid."""
    asked = questions_of(plan)
    rng = stream(plan.seed, "schedule", number)
    tasks = [ClipTask(QUESTION)] * asked
    again = rng.permutation(max(asked // 2, 1))[: plan.rules.repeats].tolist()
    late = np.sort(rng.integers(asked - asked // 4, asked + 1, len(again)))[::-1].tolist()
    for place, question in zip(late, again, strict=True):
        tasks.insert(place, ClipTask(REPEAT, question))
    if plan.rules.attention:
        tasks.insert(int(rng.integers(asked // 3, asked - asked // 3 + 1)), ClipTask(ATTENTION))
    rounds = [ClipTask(what, which) for what in HEEDED for which in range(plan.rules.listening)]
    return (*tasks, *rounds)


def mean_posterior(beliefs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Computes the mean posterior of earlier participants, as a prior for the next participant. The
    mean is rounded, so it does not depend on the order of participants."""
    total: dict[str, float] = {}
    for belief in beliefs:
        some = 1 - belief.get("none", 0.0)
        for facts, share in belief.items():
            if facts != "none" and some > 0:
                total[facts] = total.get(facts, 0.0) + share / some / len(beliefs)
    return {f: round(total[f], 6) for f in sorted(total, key=int) if total[f] >= SHARED}


def prior(plan: CollectPlan, others: Mapping[str, float]) -> NDArray[np.float64]:
    """Returns [C] prior over fact sets: the hypotheses' prior, mixed with the shares of fact sets
    among earlier participants, if there are any (weight ``design.from_others``)."""
    known = plan.hypotheses
    if not others or not plan.design.from_others:
        return known.prior
    weight = np.zeros(len(known.facts))
    for facts, share in others.items():
        weight[known.row(np.array(int(facts)))] = share
    mixed = plan.design.from_others * weight / weight.sum()
    return np.asarray((1 - plan.design.from_others) * known.prior + mixed)


def belief(asking: Questionnaire) -> dict[str, float]:
    """Returns the posterior {fact set, or "none": probability}, without fact sets whose posterior
    is below KEPT. One fact set represents all candidates that no question separates."""
    known = asking.hypotheses
    facts, first = np.unique(known.classes, return_index=True)
    weight = asking.classes
    found = {str(known.essential[first[c]]): float(weight[c]) for c in facts if weight[c] >= KEPT}
    return found | {"none": asking.none}


def questions_of(plan: CollectPlan) -> int:
    """Returns the number of questions for each participant. The last question may have fewer
    steps."""
    return -(-plan.rules.points // plan.design.clip)


def clip(
    plan: CollectPlan, state: CollectState, tasks: Sequence[ClipTask], asking: Questionnaire
) -> AskedClip:
    """Chooses the clip for the next of the ``tasks``, given all answers so far. If other steps are
    possible, two consecutive clips never show the same step."""
    step, questions = len(state.answered), state.questions()
    task, following = tasks[step], tasks[step + 1 : step + 2]
    if task.purpose == REPEAT:
        return replace(questions[task.again], purpose=REPEAT, labels=())
    if task.purpose == ATTENTION:
        return AskedClip(ATTENTION, (), 0)
    if task.purpose in HEEDED:
        return _choose_lasting(plan, state, task)
    looks_back = [questions[n.again] for n in following if n.purpose == REPEAT]
    beside = [*state.answered[-1:], *looks_back]
    near = {t for one in beside for t in one.transitions}
    left = plan.rules.points - sum(one.size for one in questions)
    if plan.questions:
        order = stream(plan.seed, "order", state.number).permutation(len(plan.questions))
        listed = [plan.questions[which] for which in order.tolist()]
        for one in questions:
            listed.remove((one.transitions[0], one.told))
        last = {t for one in state.answered[-1:] for t in one.transitions}
        many = Counter(transition for transition, _ in listed)  # spreads the steps
        about, told = max(listed, key=lambda q: (q[0] not in last, q[0] not in near, many[q[0]]))
        return AskedClip(QUESTION, (about,), told)
    if asking.clip == 1:
        about, told = _vary_question(plan, questions, near, asking)
        return AskedClip(QUESTION, (about,), told)
    about, told = asking.next()
    if (tuple(np.atleast_1d(about).tolist()), told) in _list_unknown(questions):
        about, told = _vary_question(plan, questions, near, asking)
    return AskedClip(QUESTION, tuple(np.atleast_1d(about)[:left].tolist()), told)


def _vary_question(
    plan: CollectPlan, before: Sequence[AskedClip], near: set[int], asking: Questionnaire
) -> tuple[int, int]:
    """Chooses the most informative question about a step that was not shown before, if it gives at
    least the share AS_MUCH of the information of the best question. Otherwise chooses the most
    informative question about a step that the neighbouring clips do not show."""
    phrases, every = plan.hypotheses.phrases, asking.alternatives(ALTERNATIVES)
    unknown = _list_unknown(before)
    found = [one for one in every if ((one[0],), one[1]) not in unknown] or every
    seen = {phrases[t] for one in before for t in one.transitions}
    apart = [one for one in found if phrases[one[0]] not in {phrases[t] for t in near}]
    for one in [one for one in apart if phrases[one[0]] not in seen][:1]:
        if asking.information(one) >= AS_MUCH * asking.information(found[0]):
            return one
    return (apart or found)[0]


def _list_unknown(before: Sequence[AskedClip]) -> set[tuple[tuple[int, ...], int]]:
    """Lists the questions with an answer CANNOT_TELL, so that other questions are asked instead.
    This answer is no evidence. So such a question could remain the best question, and would be
    asked again."""
    return {(one.transitions, one.told) for one in before if CANNOT_TELL in one.labels}


def _choose_lasting(plan: CollectPlan, state: CollectState, task: ClipTask) -> AskedClip:
    """Chooses a message that stays valid on later pages, and a step that probably makes sense only
    with this message. For the purposes LATER and AGAIN, repeats the step of the earlier clip
    (purpose TOLD) with the same ``task.again``."""
    before = [clip for clip in state.answered if clip.purpose == TOLD]
    if task.purpose != TOLD:
        first = before[task.again]
        told = first.told if task.purpose == AGAIN else 0
        return AskedClip(task.purpose, first.transitions, told)
    known, said = plan.hypotheses, sum(clip.told for clip in before)
    shares = {int(facts): share for facts, share in state.belief.items() if facts != "none"}
    held, share = np.array([*shares]) & ~said, np.array([*shares.values()])
    order = stream(plan.seed, "listening", state.number).permutation(known.n_messages)
    left = [j for j in order.tolist() if not said >> j & 1]
    now = known.labels[known.row(held)]
    turns = np.array([share @ (known.labels[known.row(held & ~(1 << j))] > now) for j in left])
    best, about = np.unravel_index(turns.round(9).argmax(), turns.shape)
    return AskedClip(TOLD, (int(about),), 1 << left[int(best)])
