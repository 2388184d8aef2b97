"""Hidden types that are added to the found user types, for people with other beliefs or habits.

A hidden type is a set W of facts believed incorrectly, with a way of listening and answering. The
found types have most of the prior. The rest is for

- other sets of facts: none, all, each single fact, and the union of any two types. Each size of a
  set has the same share, so that the many large sets do not outweigh the few small ones;
- people who answer 1 although they think 0, and people who err in both directions;
- people who keep one incorrect belief until all messages are given;
- people whose answers give no information. They are one hidden type: its label probabilities are
  the mean over all other hidden types, and each answer is 0 or 1 with equal probability. So a
  policy plans for these people without learning from their answers.

Nothing else changes: the problem has more hidden types, and is the same POMDP.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.belief import Facts, Independent
from xplain.explanation.habits import Habits, habits_of
from xplain.explanation.label_table import DENSE, LabelTable, join_steps
from xplain.explanation.problem import Problem

ERROR, GUESS = 0.1, 0.4
"""P(the opposite answer) of people who err, and P(answer 1) of polite people who think 0."""
NUMBERS = 1 << 24
"""Maximum size of a label table; from a larger table the least likely hidden types are left out."""
NONE_OF_THESE = "none of these"


class _People(NamedTuple):
    """K hidden types: sets of facts believed incorrectly, with a way of answering.

    Attributes:
        p: [m + Q, 2^n, K] P(label is 1) of the trace's m transitions and then of the Q questions,
            for each set of the n messages.
        answered: P(answer is 1), in the same shape.
        prior: [K] prior probabilities; their sum may differ from 1.
        whose: [K] index of the user type to which each hidden type belongs.
        as_found: [K] True for a found type with the assumed habits.
    """

    p: NDArray[np.float64]
    answered: NDArray[np.float64]
    prior: NDArray[np.float64]
    whose: NDArray[np.int64]
    as_found: NDArray[np.bool_]

    def take(self, which: NDArray[np.int64]) -> _People:
        """Selects the hidden types with the indices in ``which``."""
        return _People._make(own[..., which] for own in self)


@dataclass(frozen=True)
class Open(Independent):
    """A belief about people who may have no found type, answer otherwise than they think, or miss
    messages.

    Labels are evidence as in :class:`~xplain.explanation.belief.Independent`. The shares of people
    by their way of answering are the assumed ones (WAYS), or learned from observers' answers. By
    default, people who err in both directions do so at the rate ERROR. If the attribute ``error``
    is not 0, the assumed or learned error rates determine their share and the rate instead.
    """

    open: ClassVar[bool] = True

    def habits(self, learned: Habits | None = None) -> Habits:
        """Returns the habits with the assumed rates, and with the learned ways of answering."""
        own = super().habits(learned)
        return own if learned is None else replace(own, ways=learned.ways)

    def people(self, problem: Problem, learned: Habits | None, facts: Facts | None) -> Problem:
        """Returns a problem with more hidden types: people with other beliefs or other habits of
        answering. All hidden types accept and forget messages as assumed.

        With more than DENSE messages, no hidden types are added.

        Args:
            problem: the problem of the found user types.
            learned: habits that were learned from observers' answers, if any.
            facts: facts that people may believe incorrectly, if known.
        """
        habits = self.habits(learned)
        if problem.n_messages > DENSE:
            return problem.with_habits(habits)
        rates, ways, error = habits.shares("error"), habits.ways, ERROR
        if (share := 1 - rates.pop(0.0, 0.0)) > 0:
            error = sum(rate * own for rate, own in rates.items()) / share
            exact, erring, polite, random, stuck = ways
            whole = exact + erring
            ways = np.array([(1 - share) * whole, share * whole, polite, random, stuck])
        opened = with_anybody(problem, facts, ways, error, habits.take_all_in)
        return opened.with_habits(habits_of(0.0, habits.shares("accept"), habits.shares("forget")))


def with_anybody(
    problem: Problem,
    facts: Facts | None,
    ways: NDArray[np.float64],
    error: float,
    messages_land: bool,
) -> Problem:
    """Returns a problem with more hidden types: people with other beliefs or other habits of
    answering. One further user type represents all people who have none of the found types.

    Args:
        problem: a problem of M user types, with at most DENSE messages.
        facts: the facts that people may believe incorrectly; None if unknown.
        ways: [5] shares of people by their way of answering, as in WAYS.
        error: P(the opposite answer) of people who err in both directions.
        messages_land: True if the assumed habits are that a message always corrects its fact, and
            that the fact is never forgotten. Then people who keep one incorrect belief are added.
            Otherwise these people listen; people without incorrect beliefs always listen.
    """
    n, count = problem.n_messages, problem.n_types
    every, sets = (1 << n) - 1, np.arange(1 << n)
    dense = [range(n)] * count
    found = join_steps([problem.table, problem.questions.table]).select_messages(dense)
    table, answered = found.p, found.answered
    wrong = tuple(sum(1 << j for j in row) for row in problem.table.effective())
    share, whose = problem.prior, np.arange(count)
    if facts is not None:
        others = _other_sets(facts.wrong, n)
        wrong, share = facts.wrong, (1 - facts.new * bool(others)) * share
        parts = [facts.everything] if facts.asked is None else [facts.everything, facts.asked]
        everything = join_steps(parts).select_messages([range(n)])
        table, answered = (
            np.concatenate([own, *(p[:, sets | every & ~one] for one in others)], axis=-1)
            for own, p in ((table, everything.p), (answered, everything.answered))
        )
        sizes = np.array([one.bit_count() for one in others])
        alike = (sizes[:, None] == sizes).sum(axis=1)
        share = np.append(share, facts.new / (len(np.unique(sizes)) * alike))
        wrong, whose = (*wrong, *others), np.append(whose, np.full(len(others), count))
    exact, erring, polite, random, stuck = ways
    plain = _People(table, answered, share * exact, whose, whose < count)
    parts_ = [
        plain,
        plain._replace(
            answered=answered * (1 - error) + (1 - answered) * error, prior=share * erring
        ),
        plain._replace(
            answered=answered + (1 - answered) * GUESS,
            prior=share * polite,
            as_found=np.zeros_like(plain.as_found),
        ),
    ]
    listening = parts_[0] if exact > 0 else parts_[1]
    kept = share * stuck * (messages_land & (np.array(wrong) > 0))
    listening.prior[:] += share * stuck - kept
    if kept.any():
        parts_ += [_make_stuck(listening, kept, wrong, every)]
    people = _concatenate(parts_)
    most = max(NUMBERS // table[..., 0].size, count)
    people = people.take(np.sort(np.argsort(-people.prior, kind="stable")[:most]))
    weight = people.prior / people.prior.sum()
    coin = (people.p @ weight)[..., None].clip(0, 1)
    half = np.full_like(coin, 0.5)
    one, no = np.full(1, count), np.zeros(1, np.bool_)
    people = _concatenate([people, _People(coin, half, np.full(1, random), one, no)])
    relevant = np.tile(np.arange(n), (len(people.prior), 1))
    whole = LabelTable(relevant, people.p, people.answered)
    steps = range(problem.n_steps)
    asked = range(problem.n_steps, len(table))
    return replace(
        problem,
        table=whole.of_steps(steps),
        questions=replace(problem.questions, table=whole.of_steps(asked)),
        prior=people.prior / people.prior.sum(),
        type_names=(*problem.type_names, NONE_OF_THESE),
        whose=people.whose,
        as_found=people.as_found,
    )


def _other_sets(found: tuple[int, ...], n: int) -> list[int]:
    """Lists sets of facts as bitmasks: the empty set, the set of all facts, each single fact, and
    the union of any two found sets. Found sets are left out.

    Args:
        found: bitmasks of the facts that each found type believes incorrectly.
        n: number of facts.
    """
    unions = [one | other for one, other in combinations(found, 2)]
    return sorted({0, (1 << n) - 1, *(1 << j for j in range(n)), *unions} - {*found})


def _concatenate(parts: list[_People]) -> _People:
    """Joins lists of hidden types into one list."""
    return _People._make(np.concatenate(own, axis=-1) for own in zip(*parts, strict=True))


def _make_stuck(
    people: _People, share: NDArray[np.float64], wrong: tuple[int, ...], every: int
) -> _People:
    """Makes people who keep one incorrect belief until all messages are given: a hidden type for
    each given hidden type, and each fact that it believes incorrectly.

    Args:
        people: the given hidden types.
        share: [K] total prior of the new hidden types that are made from each given hidden type.
        wrong: for each given hidden type, the bitmask of the facts that it believes incorrectly.
        every: bitmask of all messages.
    """
    which = [
        (k, j) for k, own in enumerate(wrong) for j in range(every.bit_length()) if own >> j & 1
    ]
    sets = np.arange(every + 1)
    p, answered = (
        np.stack(
            [one[:, np.where(sets == every, every, sets & ~(1 << j)), k] for k, j in which],
            axis=-1,
        )
        for one in (people.p, people.answered)
    )
    who = np.array([k for k, _ in which])
    prior = share[who] / np.bincount(who)[who]
    return _People(p, answered, prior, people.whose[who], np.zeros(len(who), np.bool_))
