"""Learns how people listen and answer: how often they miss or forget messages, and answer wrongly.

The data are explanations, or answers to questions, some of which are asked again after a message.
An exact filter over (type, habits, knowledge) computes the posterior of a person's habits from the
answers. If a message should change a person's labels, and they do not change, the person probably
missed the message. If they change and later change back, the person probably forgot the message.

EM estimates how frequent each habit is among people, because the habit of each person is hidden.
The prior of these frequencies is a Dirichlet distribution whose mode is the shares in
``xplain.explanation.habits.UNKNOWN`` (or in another grid). EM ends at the mode of the posterior,
because the objective is concave.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.explanation.belief import update, update_by_messages
from xplain.explanation.habits import Habits, habits_of
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem

PRIOR_PEOPLE = 5.0
"""The documented shares count as this number of people."""
PRECISE = 1e-9


class Listener(Protocol):
    """A person who received messages and answered."""

    def posterior(self, habits: Habits) -> NDArray[np.float64]:
        """Computes [F] the posterior of the person's habit."""


@dataclass(frozen=True)
class ExplanationRecord:
    """The messages and answers of one explanation so far.

    Attributes:
        problem: the problem of the explained trace and the user types; its habits are not used.
        said: for each step, a bitmask of the messages given before *explain*, new or repeated.
        answers: for each step k, the labels of the first k + 1 transitions.
    """

    problem: Problem
    said: Sequence[int]
    answers: Sequence[NDArray[np.uint8]]

    def posterior(self, habits: Habits) -> NDArray[np.float64]:
        """Computes [F] the posterior of the person's habit, given the answers. If people may
        forget, every label is evidence (:func:`xplain.interaction.dialogue.advance`)."""
        problem = _remove_habits(self.problem).with_habits(habits)
        belief, given = problem.start, 0
        for new, labels in zip(self.said, self.answers, strict=False):
            given |= new
            belief = update(problem, update_by_messages(problem, belief, new), given, labels)
        hidden = belief.reshape(-1, problem.n_user_types, len(habits))
        found: NDArray[np.float64] = hidden.sum(axis=(0, 1))
        return found


def learn_habits(people: Sequence[Listener], grid: Habits | None = None) -> Habits:
    """Learns the distribution of the habits of the next person.

    Args:
        people: people with known answers.
        grid: possible habits with their documented shares; None: all combinations of the rates in
            ``xplain.explanation.habits.UNKNOWN``. A person whose rate is between two rates of the
            grid counts partly for each of the two. A rate outside the grid counts as the nearest
            rate of the grid.

    Raises:
        InputError: no people.
    """
    if not people:
        raise InputError("people", 0, "at least one person who received a message and answered")
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


def _remove_habits(problem: Problem) -> Problem:
    """Reduces a problem to the found user types, without errors, missed messages and forgetting."""
    found = np.flatnonzero(problem.as_found)
    types, first = np.unique(problem.whose[found], return_index=True)
    table = problem.table.of_types(found[first].tolist())
    prior = np.bincount(problem.whose[found], problem.prior[found])
    names = tuple(problem.type_names[t] for t in types)
    alone = problem.with_types(LabelTable(table.relevant, table.p), names)
    return replace(alone, prior=prior / prior.sum())
