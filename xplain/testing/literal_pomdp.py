"""The paper's POMDP, implemented literally. It is slow and only for tiny problems; tests compare
solvers with it.

States are ⟨k, L, E_given, E_next, t⟩, with three corrections (docs/choices.md, "Slips in the
paper's text"): given or pending messages are not actions; label probabilities use E_given ∪ E_next
and depend on τ_i; label 0 has the cost. Messages that change no label and no answer of any type are
not actions, either. If users make errors or miss messages, L are the users' answers, t is a hidden
type, and the state also has the known facts: those that the user has learned from messages and not
forgotten. The code does not use the reduction to (k, H, belief). Optimal values come from the
definition, by trying every action and every observation.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import compress, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.asking import bitmask
from xplain.explanation.problem import Problem

EXPLAIN = -1
"""The action *explain*. Messages are 0, 1, …; questions are −2, −3, …"""


class LiteralState(NamedTuple):
    """⟨k, L, E_given, E_next, t⟩, extended by known facts and asked questions.

    Attributes:
        step: k.
        labels: L, the labels or answers of the last *explain*.
        given: E_given, the messages given before the last *explain*.
        pending: E_next, the messages given since then.
        user_type: t.
        known: the facts that the user has learned from messages and not forgotten.
        asked: the questions that were asked.
    """

    step: int
    labels: tuple[int, ...]
    given: frozenset[int]
    pending: frozenset[int]
    user_type: int
    known: frozenset[int] = frozenset()
    asked: frozenset[int] = frozenset()


Observation = tuple[int, ...] | None
"""The labels of the prefix, or the answer to a question; None is l_φ, no observation."""


@dataclass(frozen=True)
class LiteralPOMDP:
    """The components of the paper's tuple, as functions."""

    problem: Problem

    def initial(self) -> dict[LiteralState, float]:
        """Returns the belief before anything is shown."""
        return {
            LiteralState(0, (), frozenset(), frozenset(), t): float(p)
            for t, p in enumerate(self.problem.prior)
            if p > 0
        }

    def actions(self, state: LiteralState) -> list[int]:
        """Returns the possible actions: *explain*; the messages with effect that are neither given
        nor pending (if messages may be missed or forgotten, all messages that are not pending); and
        questions if no message is pending. At the end of the trace there is no action."""
        if state.step == self.problem.n_steps:
            return []
        messages = self.problem.messages_with_effect
        used = state.given | state.pending
        if not self.problem.messages_land:
            messages = tuple(range(self.problem.n_messages))
            used = state.pending
        free = [EXPLAIN, *(j for j in messages if j not in used)]
        if not state.pending:
            free += [EXPLAIN - 1 - q for q in self._list_questions(state)]
        return free

    def _list_questions(self, state: LiteralState) -> list[int]:
        """Returns the questions that may be asked. Questions are equal if their label 1 is likelier
        than label 0 for the same types (for the same types and known facts, if users' knowledge is
        hidden). Of several equal questions, only the first that was not yet asked is returned."""
        questions, table = self.problem.questions, self.problem.questions.table
        labels, answers, given = table.p, table.answered, 0
        if self.problem.messages_land:
            count, given = len(questions), bitmask(state.given)
            labels = table.label_probabilities(count, given).T
            answers = table.answer_probabilities(count, given).T
        late = questions.limits.when == "first" and (state.step > 0 or given > 0)
        if late or len(state.asked) >= questions.limits.most:
            return []
        tells = np.ptp(answers, axis=tuple(range(1, answers.ndim))) > 0
        found: dict[bytes, int] = {}
        for q, column in enumerate(labels >= 0.5):
            if tells[q] and q not in state.asked:
                found.setdefault(column.tobytes(), q)
        return list(found.values())

    def outcomes(
        self, state: LiteralState, action: int
    ) -> Iterator[tuple[float, LiteralState, Observation, float]]:
        """Yields the possible outcomes: (probability, next state, observation, reward)."""
        problem = self.problem
        if action < EXPLAIN:
            yield from self._yield_answers(state, EXPLAIN - 1 - action)
            return
        if action != EXPLAIN:
            reward = -problem.trade_off * float(problem.message_cost[action])
            said = state._replace(pending=state.pending | {action})
            accept = problem.accept[state.user_type]
            yield float(accept), said._replace(known=state.known | {action}), None, reward
            if accept < 1:
                yield float(1 - accept), said, None, reward
            return
        given = state.given | state.pending
        mask = bitmask(state.known if not problem.messages_land else given)
        count = state.step + 1
        every = problem.table.answer_probabilities(count, mask)[state.user_type].tolist()
        thought = problem.table.label_probabilities(count, mask)[state.user_type]
        for labels in product((0, 1), repeat=count):
            probability = 1.0
            for p, label in zip(every, labels, strict=True):
                probability *= p if label == 1 else 1 - p
            if probability > 0:
                after = state._replace(
                    step=state.step + 1,
                    labels=labels,
                    given=given,
                    pending=frozenset(),
                )
                # If users make errors, the cost counts the expected labels 0, not the answers 0.
                errs = problem.table.answers.size
                zeros = float((1 - thought).sum()) if errs else labels.count(0)
                reward = -problem.inexplicability_cost * zeros
                for kept, known in self._forget_facts(state):
                    yield probability * kept, after._replace(known=known), labels, reward

    def _yield_answers(
        self, state: LiteralState, question: int
    ) -> Iterator[tuple[float, LiteralState, Observation, float]]:
        """Yields the possible outcomes of a question."""
        questions = self.problem.questions
        mask = bitmask(state.known if not self.problem.messages_land else state.given)
        yes = float(questions.table.answer_probabilities(question + 1, mask)[state.user_type, -1])
        after = state._replace(asked=state.asked | {question})
        for answer, probability in ((1, yes), (0, 1 - yes)):
            if probability > 0:
                yield probability, after, (answer,), -questions.limits.cost

    def _forget_facts(self, state: LiteralState) -> Iterator[tuple[float, frozenset[int]]]:
        """Yields each set of known facts that may remain after a step, as (its probability, the
        set)."""
        forget = float(self.problem.forget[state.user_type])
        if not forget:
            yield 1.0, state.known
            return
        facts = sorted(state.known)
        for kept in product((False, True), repeat=len(facts)):
            probability = (1 - forget) ** kept.count(True) * forget ** kept.count(False)
            yield probability, frozenset(compress(facts, kept))

    def discount(self, action: int) -> float:
        """Returns the discount factor of an action: γ_E for *explain*, 1 for a question. For a
        message, the factor is γ_E if every action discounts; it is 1 if only *explain* discounts,
        or if messages may be repeated."""
        if action == EXPLAIN:
            return self.problem.discount
        return 1.0 if action < EXPLAIN else self.problem.message_discount


def literal_optimal_value(problem: Problem) -> float:
    """Computes the optimal expected discounted return: tries every action at every belief over
    states.

    The cost is exponential in everything; use two or three steps, messages and types.
    """
    pomdp = LiteralPOMDP(problem)

    def value(belief: dict[LiteralState, float]) -> float:
        # Only the type is hidden: the states of a belief have the same actions.
        actions = pomdp.actions(next(iter(belief)))
        return max((action_value(belief, action) for action in actions), default=0.0)

    def action_value(belief: dict[LiteralState, float], action: int) -> float:
        expected_reward = 0.0
        joint: dict[Observation, dict[LiteralState, float]] = {}
        for state, weight in belief.items():
            for probability, after, observation, reward in pomdp.outcomes(state, action):
                expected_reward += weight * probability * reward
                posterior = joint.setdefault(observation, {})
                posterior[after] = posterior.get(after, 0.0) + weight * probability
        later = 0.0
        for posterior in joint.values():
            total = sum(posterior.values())
            later += total * value({state: p / total for state, p in posterior.items()})
        return expected_reward + pomdp.discount(action) * later

    return value(pomdp.initial())


def reduced_optimal_value(
    problem: Problem, step: int = 0, given: int = 0, belief: NDArray[np.float64] | None = None
) -> float:
    """Computes the same value from (k, H, belief [N]), a state that is sufficient by
    docs/method.md §5.

    This function, too, tries every message and every label vector. It merges no observations.
    """
    if belief is None:
        belief = problem.prior
    if step == problem.n_steps:
        return 0.0
    zeros = (1 - problem.table.label_probabilities(step + 1, given)).sum(axis=1)
    yes, later = problem.table.answer_probabilities(step + 1, given), 0.0
    for labels in product((0, 1), repeat=step + 1):
        joint = belief * np.where(labels, yes, 1 - yes).prod(axis=1)
        if (total := float(joint.sum())) > 0:
            later += total * reduced_optimal_value(problem, step + 1, given, joint / total)
    best = -problem.inexplicability_cost * float(belief @ zeros) + problem.discount * later
    for j in problem.messages_with_effect:
        if not given >> j & 1:
            after = reduced_optimal_value(problem, step, given | 1 << j, belief)
            price = problem.trade_off * float(problem.message_cost[j])
            best = max(best, -price + problem.message_discount * after)
    return best
