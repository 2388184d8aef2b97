"""Beliefs over user types (docs/method.md §5, paper's belief update).

A belief is an array [N] that sums to 1. If messages may be missed or forgotten, a given message is
not always a known fact. Then the type t, with its habits, and the set K of facts that the user
currently believes correctly are hidden. Only facts relevant to t matter, so each K is a row of a
label table. A belief is then an array [rows · N] with linear updates: a message moves a share α of
each row without the fact to the row with the fact, and forgetting moves a share φ back.

A *belief update* chooses which of the user's labels count as evidence.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.habits import Assumed, Habits, habits_of
from xplain.explanation.label_table import LabelTable
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem

Evidence = slice | NDArray[np.bool_] | NDArray[np.int64]
"""The positions of the prefix whose labels are evidence: a slice, indices, or [k + 1] True or
False."""


OPEN = 0.1
"""Assumed share of people with none of the found fact sets, if no estimate is given."""


class Facts(NamedTuple):
    """Tables and estimates for people who believe other facts incorrectly than the found types.

    Attributes:
        everything: P(label is 1) of a trace's transitions for a type that believes every fact
            incorrectly. After the messages about all facts except a set W, this type has the same
            labels as people who believe exactly the facts W incorrectly.
        asked: P(label is 1) of the questions for the same type; None without questions.
        wrong: bitmasks of the facts that each user type believes incorrectly.
        new: P(the next person has none of the found types).
    """

    everything: LabelTable
    wrong: tuple[int, ...]
    asked: LabelTable | None = None
    new: float = OPEN


NO_FIT = 0.5
"""No found type fits a person whose fit (:meth:`Problem.fit`) is smaller than this."""


def fact_sets(wrong: NDArray[np.float64]) -> tuple[int, ...]:
    """Returns a bitmask for each type: the facts that the type believes incorrectly with a
    probability of at least ½.

    Args:
        wrong: [N, n] P(a person of the type believes the fact incorrectly).
    """
    return tuple(sum(1 << j for j in np.flatnonzero(own >= 0.5).tolist()) for own in wrong)


class BeliefUpdate(Protocol):
    """Decides how labels change the belief.

    Attributes:
        fresh_labels: True if each label of each step is drawn independently and is evidence, as in
            the POMDP of solvers and certificates. Otherwise people repeat themselves, and
            :func:`xplain.interaction.dialogue.advance` leaves out labels without new information.
        open: True if a person may have none of the found types.
    """

    fresh_labels: ClassVar[bool]
    open: ClassVar[bool] = False

    def habits(self, learned: Habits | None) -> Habits:
        """Returns the habits of listening and answering that the belief assumes.

        Args:
            learned: habits that were learned from observers' answers, if any.
        """

    def people(self, problem: Problem, learned: Habits | None, facts: Facts | None) -> Problem:
        """Returns the problem of the found user types, extended by the assumed habits.

        Args:
            problem: the problem of the found user types.
            learned: habits that were learned from observers' answers, if any.
            facts: facts that people may believe incorrectly, if known.
        """
        ...


@dataclass(frozen=True)
class HabitsBelief:
    """Base class of belief updates that assume rates of errors, acceptance and forgetting; the
    defaults are the paper's.

    Attributes:
        error: probability that an answer is flipped.
        accept: probability that a given message is accepted.
        forget: probability that a corrected fact is forgotten at a step.
    """

    open: ClassVar[bool] = False

    error: Assumed = 0.0
    accept: Assumed = 1.0
    forget: Assumed = 0.0

    def __post_init__(self) -> None:
        """Raises InputError for a setting out of its range."""
        self.habits()

    def habits(self, learned: Habits | None = None) -> Habits:
        """Returns the habits with the assumed rates. A rate whose setting is ``"learned"`` is taken
        from ``learned``."""
        return habits_of(self.error, self.accept, self.forget, learned)

    def people(self, problem: Problem, learned: Habits | None, facts: Facts | None) -> Problem:
        """Returns the problem with the assumed habits as a part of the hidden state."""
        return problem.with_habits(self.habits(learned))


@dataclass(frozen=True)
class Independent(HabitsBelief):
    """The paper's update: the labels of the prefix are drawn again at every step, and all are
    evidence."""

    fresh_labels: ClassVar[bool] = True


@dataclass(frozen=True)
class Persistent(HabitsBelief):
    """The update for people who repeat themselves: only new labels are evidence.

    A label is not new if the person has labelled the same transition, or a copy of it, with the
    same message set before. Message sets only grow. So only the label of the newest transition is
    new, unless a message was given. After a message people err independently of their earlier
    labels.
    """

    fresh_labels: ClassVar[bool] = False


def update(
    problem: Problem,
    belief: NDArray[np.float64],
    message_set: int,
    labels: NDArray[np.uint8],
    evidence: Evidence = slice(None),
) -> NDArray[np.float64]:
    """Updates the belief: b'(t) ∝ b(t) · Π_i P(l_i | τ_i, H, t) over the labels l_i that are
    evidence. Then known facts may be forgotten.

    Args:
        problem: a problem of N hidden types.
        belief: [N], or [rows · N] if users may miss or forget messages.
        message_set: H, all messages given so far.
        labels: [k + 1] the user's labels of the prefix, 0 or 1; 2 is "cannot tell", which is no
            evidence.
        evidence: the labels that are evidence.

    Returns:
        The new belief, in the same form. Labels that are impossible for all types with positive
        belief (only with probabilities of exactly 0 or 1) leave the belief unchanged.
    """
    posterior = _update_by_labels(problem, problem.table, belief, message_set, labels, evidence)
    return posterior if problem.messages_land else after_forgetting(posterior, problem.forget)


def update_by_answer(
    problem: Problem, belief: NDArray[np.float64], message_set: int, question: int, answer: int
) -> NDArray[np.float64]:
    """Updates the belief, as :func:`update` does, by the answer 0 or 1 to one of the problem's
    questions. Nothing is forgotten at a question."""
    table = problem.questions.table.of_steps([question])
    labels = np.array([answer], np.uint8)
    return _update_by_labels(problem, table, belief, message_set, labels, slice(None))


def _update_by_labels(
    problem: Problem,
    table: LabelTable,
    belief: NDArray[np.float64],
    message_set: int,
    labels: NDArray[np.uint8],
    evidence: Evidence,
) -> NDArray[np.float64]:
    """Updates the belief by answers about the first transitions of a table."""
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


def update_by_messages(
    problem: Problem, belief: NDArray[np.float64], new: int
) -> NDArray[np.float64]:
    """Updates the belief by new messages. A belief changes only if messages may be missed or
    forgotten."""
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
    """Returns the belief after a message was given once.

    Args:
        belief: [rows · N] before the message. Row and type give the known facts: bit j of the row
            is 1 if a person of type t knows the fact ``relevant[t, j]``.
        relevant: [N, r] messages relevant to each type.
        message: index of the message.
        accept: [N] α, the probability that a person of the type accepts the message.
    """
    after, landing = belief.copy(), np.where(relevant == message, accept[:, None], 0.0)
    for bit in np.flatnonzero(landing.any(axis=0)).tolist():
        pairs = after.reshape(-1, 2, 1 << bit, len(accept))
        landed = landing[:, bit] * pairs[:, 0]
        pairs[:, 0] -= landed
        pairs[:, 1] += landed
    return after


def after_forgetting(belief: NDArray[np.float64], lose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the beliefs after the end of a step, at which people may forget known facts.

    Args:
        belief: [..., rows · N] beliefs before the end of the step.
        lose: [N] φ, the probability that a person of the type forgets a known fact.
    """
    after, width = np.array(belief, order="C"), len(lose)
    while width < after.shape[-1]:
        pairs = after.reshape(-1, 2, width // len(lose), len(lose))
        lost = lose * pairs[:, 1]
        pairs[:, 0] += lost
        pairs[:, 1] -= lost
        width *= 2
    return after


def round_belief(belief: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rounds a belief to 12 decimals, without negative zeros. The same evidence in another order
    then gives the same bytes."""
    return np.round(belief, 12) + 0.0
