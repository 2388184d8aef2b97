"""The second half of the method: each solver explains each trace to a user of each true type.

Case ── Problem ── Policy ── Episode ── Record
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, Range, checks, number, one_of
from xplain.experiment.pipeline import Case, PreparedData
from xplain.experiment.progress import SILENT, Progress
from xplain.explanation.actions import VisibleState
from xplain.explanation.anybody import ERROR, GUESS, Open
from xplain.explanation.asking import Limits
from xplain.explanation.belief import BeliefUpdate, Facts, fact_sets
from xplain.explanation.habits import PAPER
from xplain.explanation.label_table import LabelTable, join_steps
from xplain.explanation.problem import DiscountPer, Problem
from xplain.interaction.episode import explain
from xplain.interaction.explainees import Exact, Explainee, Slips
from xplain.interaction.metrics import Record
from xplain.interaction.statistics import Estimate, clustered_mean
from xplain.randomness import derive_seed
from xplain.solvers.base import CachedPolicy, Solver
from xplain.solvers.greedy import QMDP, Conformant
from xplain.solvers.simple import SayAll

LACKING = {
    "everyone": "another solver: the labeler for all users tests too many messages on one trace",
    "type": "another solver: this one needs observers of every type, whose true types are known",
}
"""Allowed values if there is no table of the labels that a solver knows."""

COMPARED: dict[str, Solver] = {
    "these types": QMDP(),
    "one explanation for all types (solver=conformant)": Conformant(),
    "all messages (solver=say_all)": SayAll(),
}
"""The explainers whose costs are estimated before any user is met."""
WAYS: tuple[Explainee, ...] = (
    Exact(),
    Slips(ERROR, repeats=False),
    Slips(0.0, repeats=False, polite=GUESS),
    Slips(0.5, repeats=False),
)
"""People by their way of answering, in the order of :data:`xplain.explanation.habits.WAYS`."""


@checks()
@dataclass(frozen=True)
class Costs:
    """The costs of messages and of inexplicable labels, and the discount of plans (docs/method.md,
    section 5).

    Attributes:
        trade_off: λ.
        message_cost: C_e, one number for all messages, or a number for each message by its name.
        inexplicability_cost: cost of each label 0.
        discount, discount_per: discount of each action, or of each step (:class:`Problem`).
        prior: ``uniform``, or ``observers`` for each type's share of the observers.
        asking: cost and maximum number of questions.
    """

    trade_off: float
    message_cost: float | Mapping[str, float]
    inexplicability_cost: float
    discount: float
    discount_per: DiscountPer
    prior: Literal["uniform", "observers"]
    asking: Limits = field(default_factory=Limits)

    def __post_init__(self) -> None:
        """Raises the errors of :class:`Problem` for these costs, so that they occur before any work
        is done."""
        names = tuple(self.message_cost) if isinstance(self.message_cost, Mapping) else ()
        table = LabelTable.by_type(np.empty((1, 0), np.int64), np.full((1, 1, 1), 0.5))
        self.problem(table, names, ("type",), np.ones(1))

    def message_costs(self, names: tuple[str, ...]) -> NDArray[np.float64]:
        """Returns [n], the cost C_e of each message.

        Raises:
            InputError: a number is negative; or, by name, a message has no number or does not
                exist.
        """
        costs = self.message_cost
        if not isinstance(costs, Mapping):
            return np.full(len(names), number("message_cost", costs, Range(0)))
        for name in costs:
            one_of("message_cost", name, names, "message")
        if missing := [name for name in names if name not in costs]:
            wanted = f"a cost of each message; {', '.join(missing)} missing"
            raise InputError("message_cost", dict(costs), wanted)
        return np.array([number(f"message_cost.{n}", costs[n], Range(0)) for n in names])

    def problem(
        self,
        table: LabelTable,
        message_names: tuple[str, ...],
        type_names: tuple[str, ...],
        shares: NDArray[np.float64],
    ) -> Problem:
        """Makes the problem of one trace.

        Args:
            table: P(label is 1) for N types.
            message_names: names of the messages.
            type_names: names of the N types.
            shares: [N] share of each type among the observers, which is the prior if ``prior`` is
                ``observers``.
        """
        return Problem(
            table,
            message_cost=self.message_costs(message_names),
            inexplicability_cost=self.inexplicability_cost,
            trade_off=self.trade_off,
            discount=self.discount,
            prior=shares if self.prior == "observers" else np.full(len(shares), 1 / len(shares)),
            discount_per=self.discount_per,
            message_names=message_names,
            type_names=type_names,
        )


def problem_of_types(
    prepared: PreparedData, case: Case, costs: Costs, belief_update: BeliefUpdate
) -> Problem:
    """Makes the problem of a trace under the learned types, for a solver that must infer the type.
    Users listen and answer as the belief update assumes."""
    names, shares = prepared.learned_types, prepared.type_shares
    problem = costs.problem(case.learned, prepared.messages, names, shares)
    problem = replace(problem, copies=copies(case.transitions))
    if (asked := case.questions) is not None:
        problem = replace(problem, questions=asked.to_questions(costs.asking, case.transitions))
    facts = None
    if prepared.wrong is not None and case.everything is not None:
        about_facts = None if asked is None else asked.everything
        facts = Facts(case.everything, fact_sets(prepared.wrong), about_facts, prepared.new)
    return belief_update.people(problem, prepared.habits, facts)


def problem_for(
    prepared: PreparedData,
    case: Case,
    costs: Costs,
    solver: Solver,
    belief_update: BeliefUpdate,
    user: int,
    thoughts: LabelTable | None = None,
) -> Problem:
    """Makes the problem that a solver plans for, on one trace and for one user. It contains only
    what the solver knows (``solver.knows``). Users listen and answer as the belief update assumes.

    Args:
        prepared: has the names of types and messages.
        case: the trace.
        costs: λ and the other costs.
        solver: the solver.
        belief_update: decides how labels change the belief.
        user: number of the user's true type.
        thoughts: labels of this user, for the clairvoyant; None: the true labels of the type.

    Raises:
        InputError: the solver needs the observers' true types, and they are unknown; or the labeler
            for all users tests too many messages on this trace.
    """
    if solver.knows == "types":
        return problem_of_types(prepared, case, costs, belief_update)
    name = prepared.types[user]
    match solver.knows:
        case "everyone":
            name, table = "everyone", case.everyone
        case "labels":
            table = case.labels.of_types([user]) if thoughts is None else thoughts
        case _:
            table = case.perfect and case.perfect.of_types([user])
    if table is None:
        raise InputError("solver", type(solver).__name__, LACKING[solver.knows])
    return costs.problem(table, prepared.messages, (name,), np.ones(1))


def evaluate(
    prepared: PreparedData,
    costs: Costs,
    solvers: dict[str, Solver],
    belief_update: BeliefUpdate,
    explainee: Explainee,
    seed: int,
    progress: Progress = SILENT,
    what: str = "explaining",
) -> list[Record]:
    """Lets each solver explain each trace to a user of each true type.

    Args:
        prepared: result of :func:`prepare`.
        costs: λ and the other costs.
        solvers: by the name in the records.
        belief_update: decides how labels change the belief.
        explainee: how the users listen, think and answer.
        seed: the policies' streams depend on the seed and the trace, not on the solver's name; the
            users' streams depend on the seed, the trace and the user's type.
        progress: receives the progress.
        what: the activity in progress lines.
    """
    records = []
    for index, case in progress.track(enumerate(prepared.cases), what, len(prepared.cases)):
        truth, same = true_thoughts(case)
        steps = range(len(case.labels.p))
        for name, solver in solvers.items():
            shared = solver.knows in ("types", "everyone")
            # The clairvoyant also sees which messages were accepted and forgotten.
            habits = explainee.habits if solver.knows == "labels" else PAPER
            policy = problem = None
            for user in range(len(prepared.types)):
                labels = truth.of_types([user])
                own = derive_seed(seed, "explainee", index, user)
                # The user's type changes only the plan of a solver that knows it.
                if policy is None or problem is None or not shared:
                    thoughts = None
                    if solver.knows == "labels":
                        thoughts = explainee.thoughts(labels, same, own).of_steps(steps)
                    problem = problem_for(
                        prepared, case, costs, solver, belief_update, user, thoughts
                    )
                    if not habits.take_all_in:
                        problem = problem.with_habits(habits)
                    planned = solver.plan(problem, trace_seed(seed, index))
                    if index == 0:  # kernels load at the first decision, whose time is not counted
                        planned.decide(VisibleState(), problem.start)
                    policy = CachedPolicy(planned)
                person = explainee.meet(labels, same, own)
                episode = explain(problem, policy, person, belief_update, solver.knows == "labels")
                right = np.ones(problem.n_user_types, dtype=bool)
                if solver.knows == "types":  # no true type is "none of the learned types"
                    matched = prepared.matched_true_type == prepared.distinct[user]
                    right = np.pad(matched, (0, len(right) - len(matched)))
                records.append(Record(name, index, user, right, episode))
    return records


def estimate_costs(prepared: PreparedData, costs: Costs) -> dict[str, Estimate]:
    """Estimates the costs of explanations with doubtful types (``prepared.doubted``), as in
    :func:`simulate_costs`."""
    cases = [replace(case, questions=None) for case in prepared.cases]
    problems = [problem_of_types(prepared, case, costs, Open()) for case in cases]
    return simulate_costs(problems, [case.everything for case in cases], prepared.doubted)


def simulate_costs(
    problems: Sequence[Problem],
    everything: Sequence[LabelTable | None],
    observers: NDArray[np.int64] | None,
) -> dict[str, Estimate]:
    """Estimates the costs of explanations by simulated users who are like the observers.

    Args:
        problems: the problem of each trace, with the belief Open and without questions.
        everything: P(label is 1) of each trace for a person who believes every fact incorrectly.
        observers: [K, 3] facts and ways of observers, as in
            :func:`xplain.learning.mixture.partition.learn_ways`.

    Returns:
        The mean cost of an explanation with its interval over people, for each explainer of
        COMPARED; empty without traces or observers.
    """
    found: dict[str, list[tuple[float, int]]] = {}
    people = [] if observers is None else observers.tolist()
    for index, (problem, table) in enumerate(zip(problems, everything, strict=True)):
        n = problem.n_messages
        every, sets = (1 << n) - 1, np.arange(1 << n)
        assert table is not None, "types are doubtful only if facts are known"
        labels = table.select_messages([range(n)]).p[..., 0] >= 0.5
        for name, solver in COMPARED.items():
            policy = CachedPolicy(solver.plan(problem))
            for who, (wrong, kept, way) in enumerate(people):
                known = np.where(sets == every, every, sets & ~kept)
                own = LabelTable.dense(labels[None, :, known | every & ~wrong].astype(float))
                person = WAYS[way].meet(own, problem.copies, derive_seed(0, "people", index, who))
                cost = explain(problem, policy, person, Open()).cost
                found.setdefault(name, []).append((cost, who))
    return {name: clustered_mean(*zip(*own, strict=True)) for name, own in found.items()}


def describe_costs(costs: Mapping[str, Estimate]) -> str:
    """Describes the result of :func:`simulate_costs` in one sentence."""
    if not costs:
        return "the costs of explanations cannot be estimated, because no trace is known"
    each = [f"{own.mean:.2f} ± {own.high - own.mean:.2f} with {n}" for n, own in costs.items()]
    best = min(costs, key=lambda name: costs[name].mean)
    return f"expected costs for people like the observers: {', '.join(each)}; cheapest: {best}"


def with_true_labels(prepared: PreparedData) -> PreparedData:
    """Returns the same traces and users, with the true types and their labels instead of the
    learned types and labelers. A solver with this knowledge shows how much better labelers and
    clusters could help. The types are equally likely, because each type has the same number of
    users."""
    count, wrong = len(prepared.types), np.zeros((len(prepared.types), len(prepared.messages)))
    for case in prepared.cases:
        for own, facts in zip(wrong, case.labels.effective(), strict=True):
            own[list(facts)] = 1
    return replace(
        prepared,
        wrong=wrong,
        learned_types=prepared.types,
        matched_true_type=prepared.distinct,
        type_shares=np.full(count, 1 / count),
        cases=tuple(
            replace(
                case,
                learned=case.labels,
                questions=case.questions and replace(case.questions, learned=case.questions.labels),
            )
            for case in prepared.cases
        ),
    )


def without_tables(
    prepared: PreparedData, belief_update: BeliefUpdate, oracle: bool
) -> PreparedData:
    """Removes the results of learning, which solvers with true labels do not use. What remains is
    the same for all learners, except for an open belief.

    Args:
        prepared: result of :func:`with_true_labels`.
        belief_update: an open belief uses the learned labels of people without a found type, so
            these labels are kept for it.
        oracle: True keeps the oracle's labels, because the oracle is one of the explainers.
    """
    return replace(
        prepared,
        learning={},
        curve=np.zeros(0),
        rule="",
        cases=tuple(
            replace(
                case,
                everyone=None,
                perfect=case.perfect if oracle else None,
                everything=case.everything if belief_update.open else None,
            )
            for case in prepared.cases
        ),
    )


def same_problems(one: PreparedData, other: PreparedData) -> bool:
    """True if solvers plan the same problems for ``one`` and ``other``.

    The learned types, the true types that match them, their shares of the observers and their
    labels must be equal. Questions are not compared: the result is False if a trace of ``one`` has
    questions.
    """

    def tables(prepared: PreparedData) -> list[bytes]:
        learned = [case.learned for case in prepared.cases]
        return [a.tobytes() for t in learned for a in (t.relevant, t.p, t.answers)]

    return (
        one.learned_types == other.learned_types
        and np.array_equal(one.matched_true_type, other.matched_true_type)
        and np.array_equal(one.type_shares, other.type_shares)
        and tables(one) == tables(other)
        and all(case.questions is None for case in one.cases)
    )


def true_thoughts(case: Case) -> tuple[LabelTable, NDArray[np.int64]]:
    """Returns what all true types think of a trace's transitions, followed by its questions, if
    any.

    Returns:
        The true labels of these items; and for each item, the index of the first equal item,
        because a person makes the same errors about equal items.
    """
    if case.questions is None:
        return case.labels, copies(case.transitions)
    asked = case.questions
    about = np.where(asked.facts[:, None] < 0, asked.transitions, -1 - asked.facts[:, None])
    same = copies(np.concatenate([case.transitions, about]))
    return join_steps([case.labels, asked.labels]), same


def copies(transitions: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns [m] for each transition of a trace [m, 3], the index of the first transition that is
    equal to it."""
    _, first, which = np.unique(transitions, axis=0, return_index=True, return_inverse=True)
    same: NDArray[np.int64] = first[which]
    return same


def trace_seed(seed: int, index: int) -> int:
    """Derives the seed of every policy for the trace with this index."""
    return derive_seed(seed, "solver", index)
