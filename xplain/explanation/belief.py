"""Beliefs over user types (docs/method.md §5, paper's belief update).

A belief is an array [N] that sums to 1. Where messages may be missed or forgotten, a message said
is no fact known: hidden are the type t, with its habits, and K, the facts that the user knows right
now. Of these only the facts relevant to t matter, and a row of a label table is such a K. So a
belief is an array [rows · N], and what happens to it is linear: a message moves a part α of the
rows without the fact to those with it, and forgetting moves a part φ back.

A *belief update* is a function of what the user was shown and answered; which labels count as
evidence is the choice made here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.habits import Assumed, Habits, check_assumed, habits_of
from xplain.explanation.label_table import LabelTable
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem

Evidence = slice | NDArray[np.bool_]
"""Which labels of an answer are evidence: [k + 1] by place."""


OPEN = 0.1
"""Share of people whose set of facts is none that was found, where nobody counted."""


class Facts(NamedTuple):
    """What is known of sets of facts that people may believe incorrectly.

    Attributes:
        everything: P(label is 1) of a trace's transitions, of one type: who believes every fact
            incorrectly. Told all but W, they are as somebody who believes W incorrectly.
        asked: the same of the questions; None where there are none.
        wrong: the facts that each user type believes incorrectly, bitmasks.
        new: P(the next person is of no user type found).
    """

    everything: LabelTable
    wrong: tuple[int, ...]
    asked: LabelTable | None = None
    new: float = OPEN


NO_FIT = 0.5
"""No found type fits somebody of whom the fit (:meth:`Problem.fit`) is below this."""


def fact_sets(wrong: NDArray[np.float64]) -> tuple[int, ...]:
    """The facts that each type more likely believes incorrectly than not, as bitmasks, of
    probabilities [N, n]."""
    return tuple(sum(1 << j for j in np.flatnonzero(own >= 0.5).tolist()) for own in wrong)


class BeliefUpdate(Protocol):
    """How labels change the belief.

    Attributes:
        fresh_labels: whether each label of each step is drawn independently and is evidence, as in
            the POMDP that solvers and certificates are about; else people repeat themselves, and
            :func:`xplain.interaction.dialogue.advance` leaves out what is no news.
        open: whether people may be of no type that was found.
    """

    fresh_labels: ClassVar[bool]
    open: ClassVar[bool] = False

    def habits(self, learned: Habits | None) -> Habits:
        """How users are taken to listen and to answer.

        Args:
            learned: what observers' answers tell of it, if anything.
        """

    def people(self, problem: Problem, learned: Habits | None, facts: Facts | None) -> Problem:
        """The problem of user types who listen and answer so.

        Args:
            problem: of the user types that were found.
            learned: as :meth:`habits` has it.
            facts: that people may believe incorrectly, where they are known.
        """
        ...


@dataclass(frozen=True)
class Assuming:
    """What a belief takes users to be like; the defaults are the paper's.

    Attributes:
        error: how often an answer is the opposite of what it would have been.
        accept: how often a message is taken in when it is said.
        forget: how often a corrected fact is lost, a step.
    """

    open: ClassVar[bool] = False

    error: Assumed = 0.0
    accept: Assumed = 1.0
    forget: Assumed = 0.0

    def __post_init__(self) -> None:
        """Raises InputError for a setting out of its range."""
        for key in ("error", "accept", "forget"):
            check_assumed(key, getattr(self, key))

    def habits(self, learned: Habits | None = None) -> Habits:
        """See :class:`BeliefUpdate`."""
        return habits_of(self.error, self.accept, self.forget, learned)

    def people(self, problem: Problem, learned: Habits | None, facts: Facts | None) -> Problem:
        """See :class:`BeliefUpdate`."""
        return problem.with_habits(self.habits(learned))


@dataclass(frozen=True)
class Independent(Assuming):
    """The paper: the labels of the prefix are drawn anew at every step, and all are evidence."""

    fresh_labels: ClassVar[bool] = True


@dataclass(frozen=True)
class Persistent(Assuming):
    """A label of (transition, message set) given before is no new evidence, of a copy of the
    transition neither: people who learned nothing new repeat themselves. Messages only accumulate,
    so only the newest transition's label is news unless something was said. After that people err
    independently of what they said before."""

    fresh_labels: ClassVar[bool] = False


def update(
    problem: Problem,
    belief: NDArray[np.float64],
    message_set: int,
    labels: NDArray[np.uint8],
    evidence: Evidence = slice(None),
) -> NDArray[np.float64]:
    """b'(t) ∝ b(t) · Π_i P(l_i | τ_i, H, t) over the answers that are evidence; then facts that
    users knew may be forgotten.

    Args:
        problem: of N hidden types.
        belief: [N], or [rows · N] where users may miss or forget messages.
        message_set: H, all messages given so far.
        labels: [k + 1] the user's labels of the prefix, 0 or 1; 2 where they cannot tell, which is
            no evidence.
        evidence: which of them count.

    Returns:
        As the belief. Labels that no type with positive belief can give (only with probabilities of
        exactly 0 or 1) tell nothing about the type: the belief stays as it was.
    """
    posterior = _after(problem, problem.table, belief, message_set, labels, evidence)
    return posterior if problem.messages_land else after_forgetting(posterior, problem.forget)


def answered(
    problem: Problem, belief: NDArray[np.float64], message_set: int, question: int, answer: int
) -> NDArray[np.float64]:
    """The belief, as in :func:`update`, after the answer 0 or 1 to one of the problem's questions.

    Nothing is forgotten meanwhile.
    """
    table = problem.questions.table.of_steps([question])
    labels = np.array([answer], np.uint8)
    return _after(problem, table, belief, message_set, labels, slice(None))


def _after(
    problem: Problem,
    table: LabelTable,
    belief: NDArray[np.float64],
    message_set: int,
    labels: NDArray[np.uint8],
    evidence: Evidence,
) -> NDArray[np.float64]:
    """The belief after answers about the first so many transitions of a table."""
    if not problem.messages_land:
        p = table.answered[: len(labels)].reshape(len(labels), -1).T[:, evidence]
    else:
        p = table.answer_probabilities(len(labels), message_set)[:, evidence]
    given = labels[evidence]
    likelihood = np.where(given == 1, p, np.where(given == 0, 1 - p, 1.0))
    with np.errstate(divide="ignore"):
        log_posterior = np.log(belief) + np.log(likelihood).sum(axis=1)
    top = log_posterior.max()
    if top == -np.inf or not given.size:
        return belief.copy()
    posterior = np.exp(log_posterior - top)
    normalised: NDArray[np.float64] = posterior / posterior.sum()
    return normalised


def told(problem: Problem, belief: NDArray[np.float64], new: int) -> NDArray[np.float64]:
    """The belief after these messages were said: the same, unless users may miss some."""
    if problem.messages_land:
        return belief
    for message in indices(new):
        belief = after_message(belief, problem.table.relevant, message, problem.accept)
    return belief


def after_message(
    belief: NDArray[np.float64],
    relevant: NDArray[np.int64],
    message: int,
    accept: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The belief [rows · N] after a message was said once, whose bits in a row are ``relevant``
    [N, r], and which is taken in with α, ``accept`` [N]."""
    after, landing = belief.copy(), np.where(relevant == message, accept[:, None], 0.0)
    for bit in np.flatnonzero(landing.any(axis=0)).tolist():
        pairs = after.reshape(-1, 2, 1 << bit, len(accept))
        landed = landing[:, bit] * pairs[:, 0]
        pairs[:, 0] -= landed
        pairs[:, 1] += landed
    return after


def after_forgetting(belief: NDArray[np.float64], lose: NDArray[np.float64]) -> NDArray[np.float64]:
    """The beliefs [..., rows · N] after a step, at whose end each fact known is lost with φ,
    ``lose`` [N]."""
    after, width = np.array(belief, order="C"), len(lose)
    while width < after.shape[-1]:
        pairs = after.reshape(-1, 2, width // len(lose), len(lose))
        lost = lose * pairs[:, 1]
        pairs[:, 0] += lost
        pairs[:, 1] -= lost
        width *= 2
    return after


def rounded(belief: NDArray[np.float64]) -> NDArray[np.float64]:
    """The belief to 12 decimals, its zeros without a sign: the same evidence in another order gives
    the same bytes."""
    return np.round(belief, 12) + 0.0
