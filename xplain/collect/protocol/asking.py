"""Which clip comes next, and what the answers so far say.

Questions are those of :class:`xplain.questions.questionnaire.Questionnaire`, or of one list for
everybody. Among them are an obvious step, and some of the first questions a second time.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.collect.protocol.plan import Collection, CollectPlan
from xplain.collect.protocol.state import ATTENTION, QUESTION, REPEAT, Clip, State
from xplain.questions.questionnaire import Questionnaire
from xplain.randomness import derived_seed, stream

KEPT = 1e-6
"""Fact sets with a smaller posterior are left out of what is written down."""
SHARED = 1e-3
"""… and of what the next participant's prior takes from others."""


class Task(NamedTuple):
    """What one clip is for: a question, a second look at the question ``again``, or attention."""

    purpose: str
    again: int = -1


def schedule(plan: CollectPlan, number: int) -> tuple[Task, ...]:
    """What the clips of one participant are for, in order: questions, the obvious step amid them,
    and near the end some of the first questions again."""
    asked = questions_of(plan)
    rng = stream(plan.seed, "schedule", number)
    tasks = [Task(QUESTION)] * asked
    again = rng.permutation(max(asked // 2, 1))[: plan.rules.repeats].tolist()
    late = np.sort(rng.integers(asked - asked // 4, asked + 1, len(again)))[::-1].tolist()
    for place, question in zip(late, again, strict=True):
        tasks.insert(place, Task(REPEAT, question))
    if plan.rules.attention:
        tasks.insert(int(rng.integers(asked // 3, asked - asked // 3 + 1)), Task(ATTENTION))
    return tuple(tasks)


def shared(beliefs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """What people asked before hold wrong, as the next one's prior takes it: the mean of their
    posteriors, rounded, so that it does not depend on who came first."""
    total: dict[str, float] = {}
    for belief in beliefs:
        some = 1 - belief.get("none", 0.0)
        for facts, share in belief.items():
            if facts != "none" and some > 0:
                total[facts] = total.get(facts, 0.0) + share / some / len(beliefs)
    return {f: round(total[f], 6) for f in sorted(total, key=int) if total[f] >= SHARED}


def questionnaire(collection: Collection, state: State) -> Questionnaire:
    """The questionnaire of a participant, with all that they answered."""
    kept, whose = collection.kept, (state.person, frozenset(state.others.items()))
    answers = tuple((one.labels, one.transitions, one.told) for one in state.questions())
    before = kept.get((whose, answers[:-1])) if answers else None
    if before is None:
        seed = derived_seed(collection.plan.seed, "queries", state.person)
        asking = collection.blank.anew(_prior(collection.plan, state), seed)
    else:
        asking = copy.copy(before)
    for labels, transitions, told in answers[len(asking.asked) :]:
        asking.answer(list(labels), (list(transitions), told))
    kept.keep((whose, answers), asking)
    return copy.copy(asking)


def _prior(plan: CollectPlan, state: State) -> NDArray[np.float64]:
    """[C] in part what is known of others, where there are any."""
    known = plan.hypotheses
    if not state.others or not plan.design.from_others:
        return known.prior
    weight = np.zeros(len(known.facts))
    for facts, share in state.others.items():
        weight[known.row(np.array(int(facts)))] = share
    mixed = plan.design.from_others * weight / weight.sum()
    return np.asarray((1 - plan.design.from_others) * known.prior + mixed)


def belief(asking: Questionnaire) -> dict[str, float]:
    """The posterior {facts of a class, or "none": probability}; what is less than KEPT is left
    out."""
    known = asking.hypotheses
    facts, first = np.unique(known.classes, return_index=True)
    weight = asking.classes
    found = {str(known.essential[first[c]]): float(weight[c]) for c in facts if weight[c] >= KEPT}
    return found | {"none": asking.none}


def questions_of(plan: CollectPlan) -> int:
    """Questions a participant; the last one may be shorter than a clip."""
    return -(-plan.rules.points // plan.design.clip)


def clip(plan: CollectPlan, state: State, task: Task, asking: Questionnaire) -> Clip:
    """The clip for a task, after all that was answered."""
    questions = state.questions()
    if task.purpose == REPEAT:
        return replace(questions[task.again], purpose=REPEAT, labels=())
    if task.purpose == ATTENTION:
        return Clip(ATTENTION, (), 0)
    left = plan.rules.points - sum(one.size for one in questions)
    if plan.questions:
        order = _order(plan.seed, state.person, len(plan.questions))
        transition, told = plan.questions[order[len(questions)]]
        return Clip(QUESTION, (transition,), told)
    about, told = asking.next()
    return Clip(QUESTION, tuple(np.atleast_1d(about)[:left].tolist()), told)


@cache
def _order(seed: int, number: int, count: int) -> tuple[int, ...]:
    """In which order one participant is asked the list."""
    return tuple(stream(seed, "order", number).permutation(count).tolist())
