"""Decisions and values of policies as numbers (sets of messages are bitmasks, question q is ~q),
the values of policies by enumeration, and those of known types by direct recursion."""

from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.actions import AskQuestion, VisibleState
from xplain.explanation.belief import update, update_by_answer, update_by_messages
from xplain.explanation.label_table import LabelTable
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem
from xplain.solvers.base import Policy, messages_of


def messages_given(
    policy: Policy, step: int, given: int, belief: np.ndarray, asked: int = 0
) -> int:
    """Returns the messages that a policy gives; the policy must not ask a question."""
    action = policy.decide(VisibleState(step, given, asked), belief)
    assert not isinstance(action, AskQuestion)
    return messages_of(action)


def question_asked(
    policy: Policy, step: int, given: int, belief: np.ndarray, asked: int = 0
) -> int | None:
    """Returns the question that a policy asks; None without a question."""
    action = policy.decide(VisibleState(step, given, asked), belief)
    return action.question if isinstance(action, AskQuestion) else None


def worths(
    policy: Policy, step: int, given: int, belief: np.ndarray, asked: int = 0
) -> dict[int, float]:
    """Returns the values behind a decision."""
    found = policy.values(VisibleState(step, given, asked), belief).items()
    return {
        ~action.question if isinstance(action, AskQuestion) else messages_of(action): value
        for action, value in found
    }


def worth_by_enumeration(
    problem: Problem,
    policy: Policy,
    visible: VisibleState | None = None,
    belief: NDArray[np.float64] | None = None,
) -> tuple[float, float]:
    """Returns the discounted return and the undiscounted cost over every vector of answers, without
    merging."""
    visible = visible or VisibleState()
    step, given, asked = visible
    if step == problem.n_steps:
        return 0.0, 0.0
    belief = problem.start if belief is None else belief
    action = policy.decide(visible, belief)
    if isinstance(action, AskQuestion):
        q, cost = action.question, problem.questions.limits.cost
        yes = float(belief @ _columns(problem, problem.questions.table, q + 1, given)[1][:, q])
        value = -cost
        for answer, chance in ((1, yes), (0, 1 - yes)):
            if chance > 1e-12:
                after = update_by_answer(problem, belief, given, q, answer)
                later = visible._replace(asked=asked | 1 << q)
                returned, paid = worth_by_enumeration(problem, policy, later, after)
                value, cost = value + chance * returned, cost + chance * paid
        return value, cost
    new = messages_of(action)
    value, cost, factor = 0.0, 0.0, 1.0
    for price in sorted(problem.prices[indices(new)].tolist()):
        value, cost = value - factor * price, cost + price
        factor *= problem.message_discount
    belief, given = update_by_messages(problem, belief, new), given | new
    thought, p = _columns(problem, problem.table, step + 1, given)
    zeros = problem.inexplicability_cost * float(belief @ (1 - thought).sum(axis=1))
    value, cost = value - factor * zeros, cost + zeros
    for labels in product((0, 1), repeat=step + 1):
        heard = np.array(labels, dtype=np.uint8)
        chance = float(belief @ np.where(heard == 1, p, 1 - p).prod(axis=1))
        if chance > 0:
            after = update(problem, belief, given, heard)
            later = VisibleState(step + 1, given, asked)
            returned, paid = worth_by_enumeration(problem, policy, later, after)
            value += factor * chance * problem.discount * returned
            cost += chance * paid
    return value, cost


def _columns(problem: Problem, table: LabelTable, count: int, given: int) -> list[np.ndarray]:
    """Returns [S, count] P(label is 1) and P(answer is 1)."""
    if problem.messages_land:
        return [
            table.label_probabilities(count, given),
            table.answer_probabilities(count, given),
        ]
    return [p[:count].reshape(count, -1).T for p in (table.p, table.answered)]


def plain_optimal_value(
    problem: Problem,
    t: int,
    step: int = 0,
    given: int = 0,
    messages: tuple[int, ...] | None = None,
) -> float:
    """Computes the Bellman recursion over single actions (docs/method.md, section 5), with these
    messages, or those with an effect on type t."""
    actions = messages if messages is not None else problem.table.effective()[t]
    per_message = problem.discount if problem.discount_per == "action" else 1.0

    @cache
    def value(k: int, shown: int) -> float:
        if k == problem.n_steps:
            return 0.0
        zeros = sum(1 - problem.p_explicable[t, i, shown] for i in range(k + 1))
        best = -problem.inexplicability_cost * zeros + problem.discount * value(k + 1, shown)
        for j in actions:
            if not shown >> j & 1:
                price = problem.trade_off * problem.message_cost[j]
                best = max(best, -price + per_message * value(k, shown | 1 << j))
        return float(best)

    return value(step, given)
