"""The one model that every solver plans with: the POMDP of one problem as arrays.

There are m steps, n messages and N hidden types. The list ``own[t]`` has the at most r messages
that the tables contain for type t. The hidden state is s ∈ {0 … S − 1}; the visible state before
step k is (k, v), where v is a bitmask of messages:

- *messages always correct the fact* (``jump`` is None): s is the hidden type t, so S = N; v has all
  messages given so far;
- *messages may be missed or forgotten*: s = K · N + t, where t is the hidden type and the bitmask K
  tells which messages of ``own[t]`` the user knows, so S = 2^r · N; v has the messages given in
  this step.

Tables are flat, [..., cells]. A table is read at x(v, s) = base[s] + Σ_{j ∈ v} stride[j, s]
(:class:`Cells`). If messages always correct the fact, the cell of (v, t) is K · N + t, where the
bitmask K tells which messages of ``own[t]`` are in v. If messages may be missed, the cell is s.

    give j      pays price[j], discounts by γ' = ``message_discount``; b' = ``give(process, b, j)``:
                the share accept[s] of b[s] moves to s + jump[j, s] (jump is 0 if nothing changes)
    explain     pays explain_cost[k, x(v, s)], discounts by γ = ``discount``; the likelihood of the
                answers y is Π_{i ≤ k} P(y_i | s) with P(y_i = 1 | s) = answered[i, x(v, s)]; then
                b' = ``forget(process, b)``: a known fact is forgotten with probability forget[t]
    ask q       pays questions.cost, never discounts; the probability of the answer 1 is
                questions.answered[q, x(v, s)], where x uses ``questions.cells``

A message is given at most once in a step; if messages always correct the fact, at most once in the
whole explanation. Messages discount (γ' = γ, the paper) only if they always correct the fact: each
repetition of a message would reduce later costs by delaying them. A message is not an action if it
is relevant to no s with positive belief.

*Explain* leads to k + 1 with the same v if messages always correct the fact, otherwise with v = 0
(:func:`before_step`).

If s is known, labels give no information, and the process is an MDP with states (k, v, s). It is
solved backwards in k (Bellman 1957), where α = accept[s], v⁺ is v after *explain*, and E is the
expectation over the state s' after forgetting:

    Q(k, v, s, explain) = γ E V(k + 1, v⁺, s') − explain_cost[k, x(v, s)],   V(m, ·) = 0
    Q(k, v, s, give j) = γ' [α V(k, v + j, s + jump[j, s]) + (1 − α) V(k, v + j, s)] − price[j]
    V(k, v, s) = max { Q(k, v, s, explain), max_{j ∉ v} Q(k, v, s, give j) }

If messages always correct the fact, the maximum over all sets of messages takes one pass over the
table for each message. The pass of the most expensive message comes first, so that the cheapest
message of a best set is given first. If messages may be missed, the values for a set v depend on
the values for v with one more message, so larger sets are solved first.
"""

from collections import Counter
from dataclasses import dataclass, field
from math import comb
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.errors import TooLargeError
from xplain.explanation.belief import after_forgetting
from xplain.explanation.label_table import MAX_RELEVANT, NONE, LabelTable
from xplain.explanation.message_sets import bits_of, indices
from xplain.explanation.problem import Problem

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
KEPT = 1 << 12
"""Maximum number of bitmasks whose cells are cached, because policies use the same bitmasks
repeatedly."""
MAX_MISSED = 10
"""Maximum number of messages whose sets are compared if messages may be missed. Each set then leads
to another belief."""
KEPT_ANSWERS, JOINED = 1 << 9, 1 << 6
"""Maximum number of cached results of :func:`answer_likelihoods`, and of rows in an array that
joins several groups of labels there."""
PATIENCE = 0.1
"""If messages may be missed, a message must gain this additional share of its price, times the
probability that the state is not the most likely state. A message gives no information about the
user, and after it the next answer gives less. The share was chosen among 0.05, 0.1, 0.15 and 0.2 on
seeds 9700 to 9745."""


@dataclass(frozen=True, eq=False)
class Cells:
    """The indices of a flat table.

    Attributes:
        base: [S] cell of s before any message.
        stride: [n, S] the number that message j adds.
        kept: cache of :meth:`at`, ``{bitmask of messages: cells}``, at most KEPT.
        answers: cached results of :func:`answer_likelihoods`, at most KEPT_ANSWERS.
    """

    base: IntArray
    stride: IntArray
    kept: dict[int, IntArray] = field(default_factory=dict)
    answers: dict[tuple[int, int, bytes], list[FloatArray]] = field(default_factory=dict)

    def at(self, said: int) -> IntArray:
        """Returns [S] the cells for a bitmask of messages."""
        cells = self.kept.get(said)  # several threads may use a policy
        if cells is None:
            if len(self.kept) == KEPT:
                self.kept.clear()
            self.kept[said] = cells = self.base + self.stride[indices(said)].sum(axis=0)
        return cells

    def of_sets(self, sets: IntArray) -> IntArray:
        """Returns [B, S] the cells for B bitmasks."""
        return self.base + bits_of(sets, len(self.stride)).astype(np.int64) @ self.stride


class QuestionTables(NamedTuple):
    """Q questions; Q may be 0.

    Attributes:
        answered: [Q, cells] P(answer 1).
        likelier: [Q, cells] True if label 1 is more likely than label 0. Questions with equal rows
            are called alike.
        cells: indices of ``answered`` and ``likelier``.
        relevant: [S] bitmask of the messages that change some answer of s.
        cost: κ.
        most: maximum number of questions, at most Q.
        first: True if questions are asked only before the first step.
    """

    answered: FloatArray
    likelier: NDArray[np.bool_]
    cells: Cells
    relevant: IntArray
    cost: float
    most: int
    first: bool


class Process(NamedTuple):
    """The model of a problem: m steps, n messages, S hidden states of N hidden types.

    Attributes:
        start: [S] belief before the first step.
        p: [m, cells] P(label 1).
        answered: [m, cells] P(answer 1); the same array as ``p`` if users do not err.
        explain_cost: [m, cells] C_inexp Σ_{i ≤ k} (1 − P), the expected cost of *explain* at k.
        cells: indices of ``p``, ``answered`` and ``explain_cost``.
        own: [N, r] the messages that the tables contain for each type, padded with NONE. Message
            ``own[t, i]`` is bit i of a bitmask K for type t. If messages always correct the fact,
            the messages of a type are sorted by ascending price.
        relevant: [S] bitmask of the messages that change some label of s, or the state s itself.
        jump: [n, S] number that an accepted message adds to s; None if messages always correct the
            fact.
        accept: [S] α, the probability that a message corrects the fact; None if messages always
            correct the fact.
        forget: [N] φ, the probability that a known fact is forgotten at the end of a step; None if
            nothing is ever forgotten.
        price: [n] λ C_e.
        discount, message_discount: γ and γ'.
        questions: the possible questions.
    """

    start: FloatArray
    p: FloatArray
    answered: FloatArray
    explain_cost: FloatArray
    cells: Cells
    own: IntArray
    relevant: IntArray
    jump: IntArray | None
    accept: FloatArray | None
    forget: FloatArray | None
    price: FloatArray
    discount: float
    message_discount: float
    questions: QuestionTables

    @property
    def n_steps(self) -> int:
        """m, the number of steps."""
        return len(self.p)

    @property
    def n_messages(self) -> int:
        """n, the number of messages."""
        return len(self.price)

    @property
    def n_states(self) -> int:
        """S, the number of hidden states."""
        return len(self.start)

    @property
    def n_types(self) -> int:
        """N, the number of hidden types."""
        return len(self.own)


def make_process(problem: Problem, dense: bool = False) -> Process:
    """Makes the process of a problem.

    Args:
        problem: a problem of any kind.
        dense: used only if messages always correct the fact. With True, the tables contain for
            each type all messages with an effect on some type. With False, they contain for each
            type only the messages with an effect on this type, if this makes them smaller.

    Raises:
        TooLargeError: a type has more than MAX_RELEVANT messages in the tables.
    """
    price = problem.trade_off * problem.message_cost
    limits, asked = problem.questions.limits, problem.questions.table
    if problem.messages_land:
        table = _sort_by_price(problem.table.select_messages(row_messages(problem, dense)), price)
        cells, question_cells = (_make_row_cells(t, len(price)) for t in (table, asked))
        relevant = np.array(
            [sum(1 << j for j in row) for row in problem.table.effective()], np.int64
        )
        jump = accept = forget = None
    else:
        table = problem.table
        jump = _compute_jumps(table, len(price))
        cells = question_cells = Cells(np.arange(jump.shape[1]), np.zeros_like(jump))
        relevant = ((jump != 0) << np.arange(len(price))[:, None]).sum(axis=0)
        accept = np.tile(problem.accept, len(table.p[0]))
        forget = problem.forget if problem.forget.any() else None
    steps, width = problem.n_steps, asked.p.shape[1] * asked.p.shape[2]
    return Process(
        problem.start,
        table.p.reshape(steps, -1),
        table.answered.reshape(steps, -1),
        problem.inexplicability_cost * np.cumsum(1 - table.p, axis=0).reshape(steps, -1),
        cells,
        table.relevant,
        relevant,
        jump,
        accept,
        forget,
        price,
        problem.discount,
        problem.message_discount,
        QuestionTables(
            asked.answered.reshape(len(asked.p), width),
            asked.p.reshape(len(asked.p), width) >= 0.5,
            question_cells,
            _find_answer_messages(asked, problem),
            float(limits.cost),
            min(limits.most, len(asked.p)),
            limits.when == "first",
        ),
    )


def row_messages(problem: Problem, dense: bool = False) -> list[tuple[int, ...]]:
    """Lists for each type the messages that the tables contain for it, by ascending index; see
    ``dense`` of :func:`make_process`. The result is valid only if messages always correct the
    fact."""
    own = problem.table.effective()
    union = problem.messages_with_effect
    together = tuple(sorted({j for row in own for j in row}))
    if dense:
        return [union] * len(own)
    return [together] * len(own) if len(together) <= max(map(len, own)) else own


def weighable(problem: Problem, what: str) -> tuple[int, ...]:
    """Lists the messages with an effect, ascending, for solvers that compare sets of messages.

    Raises:
        TooLargeError: too many messages.
    """
    messages = problem.messages_with_effect
    most = MAX_RELEVANT if problem.messages_land else MAX_MISSED
    if len(messages) > most:
        raise TooLargeError(
            f"{what} compares all sets of messages: {len(messages)} messages matter on this trace, "
            f"at most {most} are possible; solver=qmdp or pomcp chooses one after the other"
        )
    return messages


def _sort_by_price(table: LabelTable, price: FloatArray) -> LabelTable:
    """Returns the same label table with each type's messages sorted by ascending price: bit 0 is
    the cheapest message."""
    rows = [sorted(row, key=lambda j: float(price[j])) for row in table.rows]
    return table.select_messages(rows)


def _make_row_cells(table: LabelTable, messages: int) -> Cells:
    """Computes the indices into a flat label table [..., 2^r · N]: the index of each type without
    messages, and the number that each message adds. They are valid only if messages always correct
    the fact."""
    stride = np.zeros((messages, table.n_types), np.int64)
    whose, bit = np.nonzero(table.relevant != NONE)
    stride[table.relevant[whose, bit], whose] = table.n_types << bit
    return Cells(np.arange(table.n_types), stride)


def _compute_jumps(table: LabelTable, messages: int) -> IntArray:
    """Computes ``jump`` [n, S] if messages may be missed: the number that an accepted message adds
    to s if the user does not know its fact; 0 if the message changes nothing."""
    types, width = table.relevant.shape
    rows = np.arange(1 << width)
    jump = np.zeros((messages, len(rows), types), np.int64)
    whose, bit = np.nonzero(table.relevant != NONE)
    known = rows >> bit[:, None] & 1
    jump[table.relevant[whose, bit], :, whose] = (1 - known) * (types << bit)[:, None]
    return jump.reshape(messages, len(rows) * types)


def _find_answer_messages(table: LabelTable, problem: Problem) -> IntArray:
    """Computes [S] the bitmask of the messages that change some answer to a question."""
    of_type = np.array([sum(1 << j for j in row) for row in table.effective()], np.int64)
    return np.resize(of_type, problem.start.size)


def before_step(process: Process, given: int) -> int:
    """Returns v before the messages of a step, from the bitmask of all messages given so far."""
    return given if process.jump is None else 0


def matters(process: Process, belief: FloatArray) -> int:
    """Returns the bitmask of the messages that change a label of some state with positive
    belief."""
    return int(np.bitwise_or.reduce(process.relevant[belief > 0]))


def give(process: Process, belief: FloatArray, message: int) -> FloatArray:
    """Returns the beliefs [..., S] after ``message`` was given once."""
    if process.jump is None or process.accept is None:
        return belief
    jump = process.jump[message]
    moving = np.flatnonzero(jump)
    after = belief.copy()
    landed = process.accept[moving] * belief[..., moving]
    after[..., moving] -= landed
    after[..., moving + jump[moving]] += landed
    return after


def give_all(process: Process, belief: FloatArray, messages: int) -> FloatArray:
    """Returns the beliefs [..., S] after each message of a bitmask was given once."""
    for message in indices(messages):
        belief = give(process, belief, message)
    return belief


def forget(process: Process, belief: FloatArray) -> FloatArray:
    """Returns the beliefs [..., S] after the end of a step, at which each known fact may be
    forgotten."""
    return belief if process.forget is None else after_forgetting(belief, process.forget)


def expected_after_forgetting(process: Process, values: FloatArray) -> FloatArray:
    """Computes [..., S] E[v(s') | s] from values v [..., S], where s' is the state after the end of
    a step, at which each known fact may be forgotten."""
    if process.forget is None:
        return values
    after = np.array(values, order="C")
    for bit in range(process.own.shape[1]):
        pairs = after.reshape(-1, 2, 1 << bit, process.n_types)
        pairs[:, 1] += process.forget * (pairs[:, 0] - pairs[:, 1])
    return after


def answer_likelihoods(
    process: Process, step: int, said: int, possible: IntArray
) -> list[FloatArray]:
    """Computes the likelihoods of all answers to *explain* at (k, v).

    Labels with equal probabilities P(answer 1 | s) in all possible states are exchangeable. They
    form a group, and only the number of 1s in each group matters. Labels with the same P(answer 1)
    in all possible states give no information and are left out. The result is cached, because many
    beliefs use it.

    Args:
        process: the model.
        step, said: k and v.
        possible: [P] the possible states.

    Returns:
        Arrays [B, P]. Each array is about one group, or about several small groups, and has a row
        for each combination of their numbers of 1s: the probability of this combination given s.
        An answer takes one row of each array; its likelihood is the product of these rows.
    """
    kept, key = process.cells.answers, (step, said, possible.tobytes())
    factors = kept.get(key)  # several threads may use a policy
    if factors is None:
        if len(kept) == KEPT_ANSWERS:
            kept.clear()
        columns = process.answered[: step + 1, process.cells.at(said)[possible]]
        news = columns[(columns != columns[:, :1]).any(axis=1)]
        factors = []
        for column, size in Counter(row.tobytes() for row in news).items():
            yes = np.frombuffer(column)
            ones = np.arange(size + 1)[:, None]
            ways = np.array([[comb(size, c)] for c in range(size + 1)], float)
            likelihood = ways * yes**ones * (1 - yes) ** (size - ones)
            if factors and len(factors[-1]) * len(likelihood) <= JOINED:
                likelihood = (factors.pop()[:, None] * likelihood).reshape(-1, len(possible))
            factors.append(likelihood)
        kept[key] = factors
    return factors


def outcomes(
    process: Process,
    step: int,
    said: int,
    belief: FloatArray,
    negligible: float = 0.0,
    most: int | None = None,
) -> tuple[FloatArray, FloatArray] | None:
    """Lists the possible outcomes of *explain* at (k, v). Answers with the same information are
    merged.

    Transitions with equal columns P(answer 1 | s) are exchangeable, so the number of their 1s is
    enough; transitions that all states answer alike give no information.

    Args:
        process: the model.
        step, said: k and v.
        belief: [S] before the labels; need not sum to 1.
        negligible: answers with a probability up to this number are not listed.
        most: maximum number of listed answers; None is no limit.

    Returns:
        [B, S] joint probabilities of each listed answer and the state at the next step, and [S] the
        sum of these probabilities over all answers that are not listed. None if there are more than
        ``most`` answers.
    """
    possible = np.flatnonzero(belief > 0)
    weights, tail = belief[None, possible], np.zeros(len(belief))
    for likelihood in answer_likelihoods(process, step, said, possible):
        weights = (weights[:, None] * likelihood).reshape(-1, len(possible))
        likely = weights.sum(axis=1) > negligible
        tail[possible] += weights[~likely].sum(axis=0)
        weights = weights[likely]
        if most is not None and len(weights) > most:
            return None
    joint = np.zeros((len(weights), len(belief)))
    joint[:, possible] = weights
    return forget(process, joint), forget(process, tail)


def all_given(process: Process, belief: FloatArray, messages: list[int]) -> FloatArray:
    """Computes [2^J, S] the belief after each subset of J messages was given; the subsets are in
    the order of ``message_sets.subsets``."""
    after = belief[None]
    for message in messages:
        after = np.concatenate([after, give(process, after, message)])
    return after


def set_prices(process: Process, sets: IntArray) -> tuple[FloatArray, FloatArray]:
    """Computes the prices and discounts of B sets of messages. The cheapest message of a set is
    given first.

    Returns:
        [B] the discounted price of each set, and [B] the discount of the action after the set.
    """
    price, discount = np.zeros(len(sets)), np.ones(len(sets))
    for j in np.argsort(process.price, kind="stable"):
        has = sets >> j & 1 == 1
        price[has] += discount[has] * process.price[j]
        discount[has] *= process.message_discount
    return price, discount


def hear_answer(
    process: Process, belief: FloatArray, said: int, question: int, answer: int
) -> FloatArray:
    """Computes [S] joint probabilities of the state and this answer (0 or 1) to a question.

    Args:
        process: the model.
        belief: [S] before the answer.
        said: v.
        question: number of the question.
        answer: 0 or 1.
    """
    yes = process.questions.answered[question, process.questions.cells.at(said)]
    return belief * (yes if answer else 1 - yes)


class KnownValues(NamedTuple):
    """The values V and Q of known states. If messages may be missed, V has more cells than Q of
    *explain*, because only V depends on the messages v given in the step.

    Attributes:
        value: [m + 1, cells] V; its indices are ``value_cells``.
        explain: [m, cells] Q of *explain*; its indices are ``explain_cells``.
        value_cells, explain_cells: the indices of ``value`` and ``explain``.
    """

    value: FloatArray
    explain: FloatArray
    value_cells: Cells
    explain_cells: Cells

    def now(self, step: int, said: int) -> FloatArray:
        """Returns [S] V(k, v, s)."""
        return self.value[step, self.value_cells.at(said)]

    def explained(self, step: int, said: int) -> FloatArray:
        """Returns [S] Q(k, v, s, explain)."""
        return self.explain[step, self.explain_cells.at(said)]

    def after_giving(
        self, process: Process, step: int, said: int, messages: list[int], states: IntArray
    ) -> FloatArray:
        """Computes [J, S'] the expected V at S' states s after one of J messages was given once.

        Args:
            process: the model.
            step, said: k, and the messages v before the new message.
            messages: the J messages.
            states: [S'] indices of the states s.
        """
        which = np.ix_(np.array(messages, np.int64), states)
        cells = self.value_cells.at(said)[states] + self.value_cells.stride[which]
        missed = self.value[step].take(cells)
        if process.jump is None or process.accept is None:
            return missed
        landed = self.value[step].take(cells + process.jump[which])
        return missed + process.accept[states] * (landed - missed)


def known_values(process: Process, without_effect: bool = False) -> KnownValues:
    """Solves the MDP of known states.

    Args:
        process: the model.
        without_effect: True also allows messages that change nothing for the known type. A policy
            may give such messages because of other types. If messages discount, they delay later
            costs, and Σ b V is an upper bound of the optimum only if they are allowed.
    """
    prices = _find_bit_prices(process, without_effect)
    solve = _solve_certain_messages if process.jump is None else _solve_missed_messages
    return solve(process, prices)


def known_bytes(problem: Problem) -> int:
    """Returns the memory that :func:`make_process` and :func:`known_values` need, in bytes."""
    steps, rows, types = problem.table.p.shape
    if problem.messages_land:
        return 8 * 4 * (steps + 1) * types << max(map(len, row_messages(problem)))
    return 8 * (steps + 1) * rows * types * (rows + 3)


def _find_bit_prices(process: Process, without_effect: bool) -> FloatArray:
    """Computes [r, N] the price of the message of each bit and type. The price is inf if the bit
    has no message, or if the message changes nothing and ``without_effect`` is False."""
    own, types = process.own.T, np.arange(process.n_types)
    exists = own != NONE
    if not without_effect:
        exists &= (process.relevant[types] >> np.maximum(own, 0) & 1).astype(bool)
    prices = process.price[own] if process.n_messages else np.zeros(own.shape)
    return np.where(exists, prices, np.inf)


def _solve_certain_messages(process: Process, prices: FloatArray) -> KnownValues:
    value = np.zeros((process.n_steps + 1, process.p.shape[1]))
    explain = np.empty(process.p.shape)
    for k in reversed(range(process.n_steps)):
        np.multiply(value[k + 1], process.discount, out=explain[k])
        explain[k] -= process.explain_cost[k]
        value[k] = explain[k]
        for bit in reversed(range(len(prices))):
            pairs = value[k].reshape(-1, 2, 1 << bit, process.n_types)
            given = process.message_discount * pairs[:, 1] - prices[bit]
            np.maximum(pairs[:, 0], given, out=pairs[:, 0])
    return KnownValues(value, explain, process.cells, process.cells)


def _solve_missed_messages(process: Process, prices: FloatArray) -> KnownValues:
    """Solves the MDP of known states if messages may be missed. The cell of V for (v, s) is
    K · S + s, where the bitmask K tells which messages of the type's list ``own[t]`` are in v.

    A type with r messages has 2^r sets v and K. Types with equally many messages are solved
    together; the other cells, which no state has, stay 0."""
    states, types, steps = process.n_states, process.n_types, process.n_steps
    assert process.jump is not None
    assert process.accept is not None
    widths, rows = (process.own != NONE).sum(axis=1), states // types
    value, explain = np.zeros((steps + 1, rows, rows, types)), np.zeros((steps, rows, types))
    for width in np.unique(widths).tolist():
        who, sets = np.flatnonzero(widths == width), np.arange(1 << width)
        without = sets >> np.arange(width)[:, None] & 1 == 0
        moves = [  # larger sets first
            (sets[without[bit] & (without.sum(axis=0) == left)], bit)
            for left in range(1, width + 1)
            for bit in range(width)
        ]
        forget = None if process.forget is None else process.forget[who]
        alike = process._replace(own=process.own[who, :width], forget=forget)
        solved = np.zeros((steps + 1, len(sets), len(sets), len(who)))
        for k in reversed(range(steps)):
            later = expected_after_forgetting(alike, solved[k + 1, 0])
            cost = process.explain_cost[k].reshape(rows, types)[: len(sets), who]
            solved[k] = process.discount * later - cost
            explain[k][: len(sets), who] = solved[k, 0]
            for given, bit in moves:
                # A message about a known fact changes nothing, so only unknown facts are looked at.
                shape = len(given), -1, 2, 1 << bit, len(who)
                own, more = (solved[k, one].reshape(shape) for one in (given, given | 1 << bit))
                landed = process.accept[who] * (more[:, :, 1] - more[:, :, 0])
                np.maximum(
                    own[:, :, 0], more[:, :, 0] + landed - prices[bit, who], out=own[:, :, 0]
                )
                solved[k, given] = own.reshape(len(given), len(sets), len(who))
        value[:, : len(sets), : len(sets), who] = solved
    jump = process.jump.reshape(process.n_messages, rows, types).max(axis=1)
    return KnownValues(
        value.reshape(steps + 1, rows * states),
        explain.reshape(steps, states),
        Cells(np.arange(states), np.tile(jump, rows) * rows),
        process.cells,
    )
