"""Optimal values of known types by direct recursion, the reference for tables and bounds."""

from functools import cache

from xplain.explanation.problem import Problem


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
