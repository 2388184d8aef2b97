"""Lookahead where messages may be missed or forgotten: as :mod:`xplain.solvers.lookahead`, over
what users know."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from xplain.explanation import knowledge
from xplain.explanation.belief import told
from xplain.explanation.message_sets import indices, subsets
from xplain.solvers.answering import Answering, check_sets
from xplain.solvers.model import best_set
from xplain.solvers.reminding import Reminding

NEGLIGIBLE = 1e-9
"""Answers less likely keep the score of who is told the state."""


@dataclass(frozen=True)
class LookaheadKnowing:
    """One step of expectimax over QMDP, whose actions are sets of messages here.

    Attributes:
        policy: QMDP's.
        candidates, answers: as :class:`~xplain.solvers.lookahead.Lookahead` has them.
    """

    policy: Reminding
    candidates: int
    answers: int
    _scores: dict[tuple[int, int], tuple[NDArray[np.int64], NDArray[np.float64]]] = field(
        default_factory=dict
    )

    def __post_init__(self) -> None:
        """Raises TooLargeError: more than MAX_SETS messages matter."""
        check_sets("lookahead", self.policy.kept)

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """The messages to give before the next *explain*, some of them perhaps again."""
        return best_set(self.values(step, given, belief))

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """Upper bounds of the sets looked into."""
        problem = self.policy.problem
        sets, worths = self._of_sets(step, given)
        scores = worths @ belief
        found = {}
        for i in np.argsort(-scores, kind="stable")[: self.candidates].tolist():
            chosen, score = int(sets[i]), float(scores[i])
            if step + 1 < problem.n_steps:
                score = min(score, self._looked_into(step, given, chosen, belief))
            found[chosen] = score
        return found

    def _looked_into(
        self, step: int, given: int, chosen: int, belief: NDArray[np.float64]
    ) -> float:
        """The value of a set where QMDP decides after the answers; inf where these are too many."""
        problem, policy = self.policy.problem, self.policy
        heard = told(problem, belief, chosen)
        answers = self._answering.after(step, heard, NEGLIGIBLE, self.answers)
        if answers is None:
            return np.inf
        weights, tail = answers
        after = problem.again.after(given, chosen, problem.n_messages)
        _, worths = self._of_sets(step + 1, after)
        later = tail @ policy.known(step + 1, after) + (weights @ worths.T).max(axis=1).sum()
        cost = heard @ policy.explain_cost(step)
        price, delay = policy.paid(given, chosen)
        return float(delay * (problem.discount * later - cost) - price)

    @cached_property
    def _answering(self) -> Answering:
        return Answering(self.policy.problem)

    def _of_sets(self, step: int, given: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The sets of messages that may be given, and [sets, S] what each is worth, the state being
        known from *explain* on."""
        problem, policy = self.policy.problem, self.policy
        key = step, given if problem.levels else 0
        if key not in self._scores:
            may_say = problem.may_say(given)
            sets, found = subsets(j for j in policy.kept if may_say >> j & 1), []
            for chosen in sets.tolist():
                price, delay = policy.paid(given, chosen)
                after = problem.again.after(given, chosen, problem.n_messages)
                value = policy.explained(step, after).reshape(-1, problem.n_types)
                for j in indices(chosen):
                    landed = knowledge.with_message(value, problem.table.relevant, j)
                    value = problem.accept * landed + (1 - problem.accept) * value
                found.append(delay * value.ravel() - price)
            self._scores[key] = sets, np.array(found)
        return self._scores[key]
