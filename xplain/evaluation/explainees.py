"""Simulated users of an explanation: as the paper assumes them, and as people are.

An *explainee* is one kind of user. It makes a *person* for each trace and true type; the person
hears messages, thinks of each transition shown that it makes sense or not, and answers. Costs are
by what they think. What they do by chance comes from a stream of their own, by transition, message
and step, so that every solver meets the same person.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, number
from xplain.explanation.label_table import LabelTable
from xplain.message_sets import indices
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
    """Whoever a trace is explained to, once."""

    def react(self, given: int, new: int, count: int) -> Reaction:
        """To messages and then the first ``count`` transitions. Asked once a step, in order.

        Args:
            given: bitmask of all messages given so far, the new ones among them.
            new: of those given at this step.
            count: k + 1.
        """
        ...


class Explainee(Protocol):
    """A kind of user."""

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """Somebody new.

        Args:
            labels: of one type, of zeros and ones: what the person thinks of m transitions.
            same: [m] the first transition that each is a copy of: a person thinks and errs alike
                about copies.
            seed: the person's.
        """
        ...


@dataclass(frozen=True)
class SimulatedUser:
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

    def react(self, given: int, new: int, count: int) -> Reaction:
        """As :class:`Person` has it."""
        labels = self.labels(count, given)
        return Reaction(labels, labels)


@dataclass(frozen=True)
class Exact:
    """The paper's users."""

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """As :class:`Explainee` has it."""
        return SimulatedUser(labels)


@dataclass(frozen=True)
class Slips:
    """Users who mean one thing and answer the other.

    Args:
        rate: probability that an answer is the opposite of what the person thinks.
        repeats: a person makes the same mistake whenever asked about a transition with the same
            messages given; else each answer is drawn for itself.
    """

    rate: float = 0.1
    repeats: bool = True

    def __post_init__(self) -> None:
        """Raises InputError for a rate out of its range."""
        _check_probability("rate", self.rate)

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """As :class:`Explainee` has it."""
        return _Slipping(SimulatedUser(labels), self, same, seed)


@dataclass(frozen=True)
class _Slipping:
    user: SimulatedUser
    how: Slips
    same: NDArray[np.int64]
    seed: int

    def react(self, given: int, new: int, count: int) -> Reaction:
        thoughts = self.user.labels(count, given)
        when = () if self.how.repeats else (count,)
        drawn = stream(self.seed, "slips", given, *when).random(len(self.same))
        mistaken = drawn[self.same[:count]] < self.how.rate
        return Reaction(thoughts, thoughts ^ mistaken.astype(np.uint8))


@dataclass(frozen=True)
class Heedless:
    """Users who do not take every message in, or do not keep it.

    Args:
        accept: probability that a message is taken in when it is given.
        forget: probability that a fact set right is lost, at each step, after its labels.
    """

    accept: float = 0.8
    forget: float = 0.0

    def __post_init__(self) -> None:
        """Raises InputError for a probability out of its range."""
        for key in ("accept", "forget"):
            _check_probability(key, getattr(self, key))

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """As :class:`Explainee` has it."""
        return _Heedless(SimulatedUser(labels), self, seed)


@dataclass
class _Heedless:
    """``knows`` is the bitmask of the facts set right that the person has right now."""

    user: SimulatedUser
    how: Heedless
    seed: int
    knows: int = 0

    def react(self, given: int, new: int, count: int) -> Reaction:
        self.knows &= ~self._some("forget", self.knows, count, self.how.forget)
        self.knows |= self._some("accept", new, count, self.how.accept)
        return self.user.react(self.knows, new, count)

    def _some(self, what: str, messages: int, count: int, chance: float) -> int:
        """Those of the messages that chance picks at this step."""
        picked = (
            1 << j for j in indices(messages) if stream(self.seed, what, count, j).random() < chance
        )
        return sum(picked)


@dataclass(frozen=True)
class Stranger:
    """Users as in the paper, but of types that were not among the observers: their facts behave
    unlike those of every observed type. Who they are, the experiment draws
    (:mod:`xplain.experiment.strangers`)."""

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """As :class:`Explainee` has it."""
        return SimulatedUser(labels)


def _check_probability(key: str, value: float) -> None:
    if not 0 <= number(f"explainee.{key}", value) <= 1:
        raise InputError(f"explainee.{key}", value, "a probability in [0, 1]")
