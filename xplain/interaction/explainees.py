"""Simulated users of an explanation: as the paper assumes them, and as people are.

An *explainee* is one kind of user. It makes a *person* for each trace and true type; the person
hears messages, thinks of each transition shown that it makes sense or not, and answers. Costs are
by what they think. What they do by chance comes from a stream of their own, by transition, message
and step, so that every solver meets the same person.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, Probability, Range, Slip, checks
from xplain.explanation.habits import PAPER, Habits, habits_of
from xplain.explanation.label_table import LabelTable
from xplain.explanation.message_sets import indices
from xplain.randomness import stream


class Reaction(NamedTuple):
    """To the first k + 1 transitions: 1 is explicable.

    Attributes:
        thoughts: [k + 1] the labels that the person truly holds.
        answers: [k + 1] the labels that the person gives.
    """

    thoughts: NDArray[np.uint8]
    answers: NDArray[np.uint8]


class Person(Protocol):
    """Whoever a trace is explained to, once. A subclass of it has what it does not define."""

    @property
    def knows(self) -> int | None:
        """Bitmask of the facts set right that they have right now; None for all that was said."""
        return None

    def hear(self, new: int) -> None:
        """Messages (a bitmask) are said, for the first time or again."""
        ...

    def react(self, given: int, count: int) -> Reaction:
        """To the first ``count`` transitions, with the messages ``given`` so far. Asked once a
        step, in order."""
        ...

    def answer(self, row: int, given: int) -> int:
        """The answer 0 or 1 to a question, with the messages ``given`` so far.

        Args:
            row: of the person's labels, after those of the trace.
            given: bitmask of the messages.

        Raises:
            InputError: such people answer no questions.
        """
        raise InputError("explainee", type(self).__name__, "one who answers questions; ask=never")


class Explainee(Protocol):
    """A kind of user. A subclass of it has what it does not define."""

    @property
    def habits(self) -> Habits:
        """How they listen and answer, as far as the clairvoyant may know it."""
        return PAPER

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """Somebody new.

        Args:
            labels: of one type, of zeros and ones: what the person thinks of m transitions, and
                then of what they may be asked.
            same: the first of all these that each is a copy of: a person thinks and errs alike
                about copies.
            seed: the person's.
        """
        ...


@dataclass(frozen=True)
class SimulatedUser(Person):
    """Believes each message at once and for ever, and answers by the true labels of one user type.

    Attributes:
        table: of this type alone.
    """

    table: LabelTable

    @classmethod
    def of(cls, labels: ArrayLike) -> SimulatedUser:
        """Who labels as [m, 2^n] says."""
        return cls(LabelTable.dense(np.asarray(labels)[None]))

    def labels(self, count: int, message_set: int) -> NDArray[np.uint8]:
        """The type's true labels [count] of the prefix, all of ``message_set`` known."""
        truth = self.table.label_probabilities(count, message_set)[0]
        labels: NDArray[np.uint8] = truth.astype(np.uint8)
        return labels

    def hear(self, new: int) -> None:
        """Nothing more than what ``given`` says."""

    def react(self, given: int, count: int) -> Reaction:
        """As :class:`Person` has it."""
        labels = self.labels(count, given)
        return Reaction(labels, labels)

    def answer(self, row: int, given: int) -> int:
        """As :class:`Person` has it."""
        return int(self.table.of_steps([row]).label_probabilities(1, given)[0, 0])


@dataclass(frozen=True)
class Exact(Explainee):
    """The paper's users."""

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """As :class:`Explainee` has it."""
        return SimulatedUser(labels)


@checks("explainee")
@dataclass(frozen=True)
class Slips(Explainee):
    """Users who mean one thing and answer the other.

    Args:
        rate: probability that an answer is the opposite of what the person thinks.
        repeats: a person makes the same mistake whenever asked about a transition with the same
            messages given; else each answer is drawn for itself.
    """

    rate: Probability = 0.1
    repeats: bool = True

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """As :class:`Explainee` has it."""
        return _Slipping(SimulatedUser(labels), self, same, seed)


@dataclass(frozen=True)
class _Slipping(Person):
    user: SimulatedUser
    how: Slips
    same: NDArray[np.int64]
    seed: int

    def hear(self, new: int) -> None:
        """Nothing more than what ``given`` says."""

    def react(self, given: int, count: int) -> Reaction:
        thoughts = self.user.labels(count, given)
        when = () if self.how.repeats else (count,)
        drawn = stream(self.seed, "slips", given, *when).random(len(self.same))
        mistaken = drawn[self.same[:count]] < self.how.rate
        return Reaction(thoughts, thoughts ^ mistaken.astype(np.uint8))

    def answer(self, row: int, given: int) -> int:
        when = () if self.how.repeats else ("asked", row)
        drawn = stream(self.seed, "slips", given, *when).random(len(self.same))
        return self.user.answer(row, given) ^ int(drawn[self.same[row]] < self.how.rate)


@checks("explainee")
@dataclass(frozen=True)
class Heedless(Explainee):
    """Users who do not take every message in, or do not keep it.

    Args:
        accept: probability that a message is taken in when it is given, > 0.
        forget: probability, < 1, that a fact set right is lost, at each step, after its labels.
    """

    accept: Annotated[float, Range(0, 1, "(]")] = 0.8
    forget: Slip = 0.0

    @property
    def habits(self) -> Habits:
        """As :class:`Explainee` has it."""
        return habits_of(0.0, self.accept, self.forget)

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """As :class:`Explainee` has it."""
        return _Heedless(SimulatedUser(labels), self, seed)


@dataclass
class _Heedless(Person):
    """``told`` counts how often each message was said."""

    user: SimulatedUser
    how: Heedless
    seed: int
    knows: int = 0
    told: Counter[int] = field(default_factory=Counter)

    def hear(self, new: int) -> None:
        for j in indices(new):
            self.told[j] += 1
            if self._by_chance("accept", j, self.told[j], self.how.accept):
                self.knows |= 1 << j

    def react(self, given: int, count: int) -> Reaction:
        reaction = self.user.react(self.knows, count)
        for j in indices(self.knows):
            if self._by_chance("forget", j, count, self.how.forget):
                self.knows &= ~(1 << j)
        return reaction

    def answer(self, row: int, given: int) -> int:
        return self.user.answer(row, self.knows)

    def _by_chance(self, what: str, message: int, time: int, chance: float) -> bool:
        return bool(stream(self.seed, what, message, time).random() < chance)


class Stranger(Exact):
    """Users as in the paper, but of types that were not among the observers: their facts behave
    unlike those of every observed type. Who they are, the experiment draws
    (:mod:`xplain.experiment.strangers`)."""
