"""Lookahead: one step of expectimax over QMDP, for problems that are too large for a search.

At a decision QMDP scores every set of messages. The best few are evaluated further: for each
possible answer the belief is updated, and QMDP gives the best value *after* it. So the policy acts
to gain information from answers, which QMDP never does.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Count, Positive, checks
from xplain.explanation.actions import Action, VisibleState, give
from xplain.explanation.message_sets import indices, subsets
from xplain.explanation.problem import Problem
from xplain.solvers.base import TIE, Knowledge, Policy, best_action, check_memory
from xplain.solvers.greedy import greedy_policy
from xplain.solvers.process import (
    KnownValues,
    Process,
    all_given,
    before_step,
    matters,
    outcomes,
    set_prices,
    weighable,
)
from xplain.solvers.voi import with_questions

NEGLIGIBLE = 1e-9
"""After less likely answers, the value of the known state is used."""
KEPT = 16
"""Maximum number of bitmasks of messages whose subsets are cached."""
Sets = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]
"""[B] sets of messages, [B, S] the number that each adds to a cell, [B] their prices and
discounts."""


@checks("solver")
@dataclass(frozen=True)
class Lookahead:
    """Plans with one step of expectimax over QMDP.

    Args:
        candidates: number of sets of messages evaluated at a decision.
        answers: maximum number of distinguishable answers for each set; a set with more answers
            keeps its QMDP score.
        memory_gib: maximum memory of the tables of known types and of all sets of messages.
    """

    candidates: Count = 16
    answers: Count = 4096
    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation; see :class:`xplain.solvers.base.Solver`."""
        greedy = greedy_policy(problem, "lookahead", self.memory_gib)
        process, known = greedy.process, greedy.known
        messages = sum(1 << j for j in weighable(problem, "lookahead"))
        size = 24 * process.n_states << messages.bit_count()
        check_memory("lookahead", size, self.memory_gib, "qmdp needs less")
        policy = Expectimax(process, known, messages, self.candidates, self.answers)
        return with_questions(policy, process, known, seed)


@dataclass(frozen=True)
class Expectimax:
    """One step of expectimax, computed at each decision.

    Attributes:
        process, known: the model, and its values for known states.
        messages: bitmask of the messages with an effect.
        candidates, answers: see :class:`Lookahead`.
        kept: cache of :meth:`_list_sets`, by bitmask of messages, at most KEPT.
    """

    process: Process
    known: KnownValues
    messages: int
    candidates: int
    answers: int
    kept: dict[int, Sets] = field(default_factory=dict)

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """Chooses the action with the largest value."""
        return best_action(self.values(visible, belief))

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Returns the values of the evaluated sets, in descending order of QMDP's score. The
        evaluation ends at a score below the best value, because no value exceeds its score."""
        process, step = self.process, visible.step
        said = before_step(process, visible.given)
        messages = self.messages & matters(process, belief) & ~said
        sets, added, prices, discounts = self._list_sets(messages)
        explained = self.known.explain[step].take(process.cells.at(said) + added)
        if process.jump is None:
            scores = discounts * (explained @ belief) - prices
        else:
            heard = all_given(process, belief, indices(messages))
            scores = discounts * (explained * heard).sum(axis=1) - prices
        found: dict[Action, float] = {}
        best = -np.inf
        for i in np.argsort(-scores, kind="stable")[: self.candidates].tolist():
            value = float(scores[i])
            if value < best - 2 * TIE * (1 + abs(best)):
                break
            if step + 1 < process.n_steps:
                after = belief if process.jump is None else heard[i]
                later = self._evaluate_later(step, said | int(sets[i]), after)
                value = min(value, float(discounts[i]) * later - float(prices[i]))
            found[give(int(sets[i]))] = value
            best = max(best, value)
        return found

    def _list_sets(self, messages: int) -> Sets:
        """Lists the subsets of the messages in a bitmask.

        Returns:
            [B] the B subsets, [B, S] the numbers that they add to the cells of the process, [B]
            their discounted prices, and [B] the discounts of the *explain* after them.
        """
        found = self.kept.get(messages)
        if found is None:
            if len(self.kept) == KEPT:
                self.kept.clear()
            sets = subsets(indices(messages))
            added = self.process.cells.of_sets(sets) - self.process.cells.base
            found = self.kept[messages] = sets, added, *set_prices(self.process, sets)
        return found

    def _evaluate_later(self, step: int, said: int, belief: NDArray[np.float64]) -> float:
        """Computes the value of *explain* if QMDP decides after the answers; inf if there are too
        many answers."""
        process, known = self.process, self.known
        following = outcomes(process, step, said, belief, NEGLIGIBLE, self.answers)
        if following is None:
            return np.inf
        weights, tail = following
        after = before_step(process, said)
        messages, states = indices(self.messages & ~after), np.arange(process.n_states)
        worth = weights @ known.after_giving(process, step + 1, after, messages, states).T
        worth *= process.message_discount
        worth -= weights.sum(axis=1)[:, None] * process.price[messages]
        explained = weights @ known.explained(step + 1, after)
        best = np.maximum(explained, worth.max(axis=1, initial=-np.inf))
        later = best.sum() + tail @ known.now(step + 1, after)
        cost = belief @ process.explain_cost[step].take(process.cells.at(said))
        return float(process.discount * later - cost)
