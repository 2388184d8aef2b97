"""How people listen and answer, learned from explanations that they were given, or from whatever
else was said to them and asked again.

Each explanation tells, by the exact filter over (type, habits, knowledge), how likely each habit is
to be that of the person: who labels as before a message missed it, who falls back forgot. How
common each habit is among people is the mode of its posterior: a Dirichlet prior around the
documented shares, everybody's habit hidden (EM; the objective is concave, so it ends at the mode).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.explanation.belief import told, update
from xplain.explanation.habits import Habits, habits_of
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem

PRIOR_PEOPLE = 5.0
"""The documented shares count as so many people."""
PRECISE = 1e-9


class Listener(Protocol):
    """Somebody who was told something, and answered."""

    def posterior(self, habits: Habits) -> NDArray[np.float64]:
        """[F] how likely each habit is to be theirs."""


@dataclass(frozen=True)
class Explained:
    """One explanation, as far as it went.

    Attributes:
        problem: of its trace and the user types; habits that it has are not looked at.
        said: by step, bitmask of the messages said before it, for the first time or again.
        answers: by step, the labels of the first k + 1 transitions.
    """

    problem: Problem
    said: Sequence[int]
    answers: Sequence[NDArray[np.uint8]]

    def posterior(self, habits: Habits) -> NDArray[np.float64]:
        """[F] how likely each habit is to be that of the person, by their answers. Where people may
        forget, every label is news (:func:`xplain.interaction.dialogue.advance`)."""
        problem = _of_the_paper(self.problem).with_habits(habits)
        belief, given = problem.start, 0
        for new, labels in zip(self.said, self.answers, strict=False):
            given |= new
            belief = update(problem, told(problem, belief, new), given, labels)
        hidden = belief.reshape(-1, problem.n_user_types, len(habits))
        found: NDArray[np.float64] = hidden.sum(axis=(0, 1))
        return found


def learned_habits(people: Sequence[Listener], grid: Habits | None = None) -> Habits:
    """The habits of the next person.

    Args:
        people: whose answers are known.
        grid: habits that people may have, with their documented shares; None takes those of
            ``xplain.explanation.habits.UNKNOWN``. Rates between two of them are shared out between
            both, rates beyond the last are taken for the last.

    Raises:
        InputError: there is nobody.
    """
    if not people:
        raise InputError("people", 0, "at least one who was told something and answered")
    habits = grid or habits_of("learned", "learned", "learned")
    likely = np.array([one.posterior(habits) for one in people]) / habits.prior
    counted, shares = PRIOR_PEOPLE * habits.prior, habits.prior
    while True:
        own = likely * shares
        found = counted + (own / own.sum(axis=1, keepdims=True)).sum(axis=0)
        found /= found.sum()
        if np.abs(found - shares).max() < PRECISE:
            return replace(habits, prior=found)
        shares = found


def _of_the_paper(problem: Problem) -> Problem:
    """The types that were found, as people without failings."""
    found = np.flatnonzero(problem.as_found)
    types, first = np.unique(problem.whose[found], return_index=True)
    table = problem.table.of_types(found[first].tolist())
    prior = np.bincount(problem.whose[found], problem.prior[found])
    names = tuple(problem.type_names[t] for t in types)
    alone = problem.with_types(LabelTable(table.relevant, table.p), names)
    return replace(alone, prior=prior / prior.sum())
