"""Simulated users of an explanation: the paper's, and more realistic ones.

An *explainee* is one kind of user. It makes a *person* for each trace and true type. The person
receives messages, judges whether each shown transition makes sense, and answers. Costs count what
they think. Their random choices come from a separate stream, by transition, message and step, so
that every solver meets the same person.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Annotated, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.domains.base import Domain
from xplain.domains.users.setting import UserType
from xplain.domains.users.types import user_type
from xplain.errors import Count, InputError, Probability, Range, Slip, checks
from xplain.explanation.habits import PAPER, Habits, habits_of
from xplain.explanation.label_table import LabelTable
from xplain.explanation.message_sets import indices
from xplain.randomness import stream


class Reaction(NamedTuple):
    """The reaction to the first k + 1 transitions: 1 is explicable.

    Attributes:
        thoughts: [k + 1] labels that the person thinks.
        answers: [k + 1] labels that the person gives.
    """

    thoughts: NDArray[np.uint8]
    answers: NDArray[np.uint8]


class Person(Protocol):
    """A person in one explanation. Subclasses inherit what they do not define."""

    @property
    def knows(self) -> int | None:
        """Bitmask of the corrected facts that they currently know; None for all given messages."""
        return None

    def hear(self, new: int) -> None:
        """Receives messages (a bitmask), new or repeated."""

    def react(self, given: int, count: int) -> Reaction:
        """Reacts to the first ``count`` transitions, given the messages ``given`` so far. It is
        called once for each step, in order."""

    def answer(self, row: int, given: int) -> int:
        """Answers a question with 0 or 1, given the messages ``given`` so far.

        Args:
            row: index among the person's labels, after those of the trace.
            given: bitmask of the messages.

        Raises:
            InputError: such people answer no questions.
        """
        raise InputError("explainee", type(self).__name__, "one who answers questions; ask=never")


class Explainee(Protocol):
    """A kind of user. Subclasses inherit what they do not define.

    Attributes:
        as_observed: True if they have the observers' types, False for those of :meth:`others`.
    """

    as_observed: ClassVar[bool] = True

    @property
    def habits(self) -> Habits:
        """The habits of these users, which the clairvoyant may know."""
        return PAPER

    def others(
        self, domain: Domain, observed: tuple[UserType, ...], rng: np.random.Generator
    ) -> tuple[UserType, ...]:
        """Returns types of these users. The experiment uses those that behave unlike the observers'
        types.

        Args:
            domain: the task.
            observed: the observers' types.
            rng: for random types.
        """
        return ()

    def thoughts(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> LabelTable:
        """Returns the labels that a new person thinks, by default those of their type. The
        clairvoyant knows them.

        Args:
            labels, same, seed: see :meth:`meet`.
        """
        return labels

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """Makes a new person, by default one who says what they think.

        Args:
            labels: labels 0 and 1 of one type, for m transitions and then for the possible
                questions.
            same: for each of them, the index of the first one that equals it. A person gives equal
                labels and errors to equal ones.
            seed: the person's seed.
        """
        return SimulatedUser(self.thoughts(labels, same, seed))


@dataclass
class SimulatedUser(Person):
    """Accepts each message at once and for ever, and answers by the true labels of one user type.

    Subclasses for other people override what they know (:meth:`find_known`) or what they say
    (:meth:`say`).

    Attributes:
        table: label table of this type alone.
        step: number of transitions shown so far.
    """

    table: LabelTable
    step: int = field(default=0, init=False)

    @classmethod
    def of(cls, labels: ArrayLike) -> SimulatedUser:
        """A user with labels from an array [m, 2^n]."""
        return cls(LabelTable.dense(np.asarray(labels)[None]))

    def labels(self, count: int, message_set: int) -> NDArray[np.uint8]:
        """[count] the type's true labels of the prefix if all of ``message_set`` is known."""
        labels = self.table.label_probabilities(count, message_set)[0]
        return labels.astype(np.uint8)

    def find_known(self, given: int) -> int:
        """Bitmask of the facts that the user knows after the messages ``given``."""
        return given

    def say(
        self, thoughts: NDArray[np.uint8], rows: NDArray[np.int64], given: int, *when: int | str
    ) -> NDArray[np.uint8]:
        """Returns the user's answers about some rows of the table, given their thoughts about
        these.

        Args:
            thoughts: the labels that the user truly thinks.
            rows: rows of the table: transitions, or questions.
            given: bitmask of the messages.
            when: the step, or the question.
        """
        return thoughts

    def hear(self, new: int) -> None:
        """Does nothing, because ``given`` says what the user knows."""

    def react(self, given: int, count: int) -> Reaction:
        """See :class:`Person`."""
        self.step = count
        thoughts = self.labels(count, self.find_known(given))
        return Reaction(thoughts, self.say(thoughts, np.arange(count), given, count))

    def answer(self, row: int, given: int) -> int:
        """See :class:`Person`."""
        thought = self.labels(row + 1, self.find_known(given))[row:]
        return int(self.say(thought, np.array([row]), given, "asked", row)[0])


@dataclass(frozen=True)
class Exact(Explainee):
    """The paper's users."""


@checks("explainee")
@dataclass(frozen=True)
class Slips(Explainee):
    """Users whose answers may differ from what they think.

    Args:
        rate: probability that an answer is flipped.
        repeats: True repeats an error whenever the transition and the messages are the same; False
            draws each answer independently.
        polite: probability of answer 1 if the person thinks 0, if larger than ``rate``.
        tires: added to ``rate`` at each step, up to one half.
    """

    rate: Probability = 0.1
    repeats: bool = True
    polite: Probability = 0.0
    tires: Probability = 0.0

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """See :class:`Explainee`."""
        return _Slipping(labels, self, same, seed)


@dataclass
class _Slipping(SimulatedUser):
    how: Slips
    same: NDArray[np.int64]
    seed: int

    def say(
        self, thoughts: NDArray[np.uint8], rows: NDArray[np.int64], given: int, *when: int | str
    ) -> NDArray[np.uint8]:
        rate, times = self.how.rate, () if self.how.repeats else when
        if self.how.tires:
            rate = max(rate, min(rate + self.how.tires * self.step, 0.5))
        drawn = stream(self.seed, "slips", given, *times).random(len(self.same))[self.same[rows]]
        return thoughts ^ (drawn < np.where(thoughts == 0, max(rate, self.how.polite), rate))


@checks("explainee")
@dataclass(frozen=True)
class Sticky(Explainee):
    """Users who sometimes repeat their last answer without thinking.

    Args:
        rate: probability that an answer repeats the answer about the previous transition.
    """

    rate: Probability = 0.4

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """See :class:`Explainee`."""
        return _Sticky(labels, self.rate, seed)


@dataclass
class _Sticky(SimulatedUser):
    rate: float
    seed: int

    def say(
        self, thoughts: NDArray[np.uint8], rows: NDArray[np.int64], given: int, *when: int | str
    ) -> NDArray[np.uint8]:
        answers = thoughts.copy()
        repeated = stream(self.seed, "sticky", given, *when).random(len(rows)) < self.rate
        for i in np.flatnonzero(repeated[1:]) + 1:
            answers[i] = answers[i - 1]
        return answers


class Expert(Explainee):
    """Users who believe nothing incorrectly."""

    def thoughts(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> LabelTable:
        """See :class:`Explainee`."""
        return replace(labels, p=np.ones_like(labels.p))


class Between(Explainee):
    """Users who believe one fact of their type incorrectly, but only at half of the transitions."""

    def thoughts(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> LabelTable:
        """See :class:`Explainee`."""
        rng, p = stream(seed, "between"), labels.p.copy()
        effective = labels.effective()[0]
        if effective:
            bit = labels.rows[0].index(int(rng.choice(effective)))
            right = rng.random(len(p))[same] < 0.5
            p[right] = p[right][:, np.arange(p.shape[1]) | 1 << bit]
        return replace(labels, p=p)


@checks("explainee")
@dataclass(frozen=True)
class Misreads(Explainee):
    """Users who always confuse some messages: each of these has the effect of another one.

    Args:
        messages: number of confused messages. One of them matters to the user, if any does.
    """

    messages: Annotated[int, Range(2)] = 2

    def thoughts(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> LabelTable:
        """See :class:`Explainee`."""
        rng, rows = stream(seed, "misreads"), labels.rows[0]
        effective = labels.effective()[0]
        if not effective or len(rows) < 2:
            return labels
        first = int(rng.choice(effective))
        others = rng.permutation([j for j in rows if j != first])[: self.messages - 1]
        mixed = [rows.index(int(j)) for j in (first, *others)]
        sets = np.arange(labels.p.shape[1])
        understood = sets & ~sum(1 << bit for bit in mixed)
        for bit, other in zip(mixed, mixed[1:] + mixed[:1], strict=True):
            understood |= (sets >> bit & 1) << other
        return replace(labels, p=labels.p[:, understood])


@checks("explainee")
@dataclass(frozen=True)
class LearnsUntold(Explainee):
    """Users who discover a fact by themselves after it mattered.

    Args:
        after: number of steps.
    """

    after: Count = 2

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """See :class:`Explainee`."""
        return _LearningUntold(labels, self.after)


@dataclass
class _LearningUntold(SimulatedUser):
    """A person of :class:`LearnsUntold`; ``mattered`` has the first step at which each message
    would have changed a label."""

    after: int
    mattered: dict[int, int] = field(default_factory=dict)

    def find_known(self, given: int) -> int:
        found = (j for j, step in self.mattered.items() if self.step >= step + self.after)
        return given | sum(1 << j for j in found)

    def react(self, given: int, count: int) -> Reaction:
        reaction, known = super().react(given, count), self.find_known(given)
        for j in indices(sum(1 << j for j in self.table.rows[0]) & ~known):
            if (self.labels(count, known | 1 << j) != reaction.thoughts).any():
                self.mattered.setdefault(j, count)
        return reaction


@checks("explainee")
@dataclass(frozen=True)
class Heedless(Explainee):
    """Users who may miss a message, or forget it.

    Args:
        accept: probability > 0 that a given message is accepted.
        forget: probability < 1 that a corrected fact is forgotten, at each step, after its labels.
    """

    accept: Annotated[float, Range(0, 1, "(]")] = 0.8
    forget: Slip = 0.0

    @property
    def habits(self) -> Habits:
        """See :class:`Explainee`."""
        return habits_of(0.0, self.accept, self.forget)

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """See :class:`Explainee`."""
        return _Heedless(labels, self, seed)


@dataclass
class _Heedless(SimulatedUser):
    """A person of :class:`Heedless`; ``told`` counts how often each message was given."""

    how: Heedless
    seed: int
    knows: int = 0
    told: Counter[int] = field(default_factory=Counter)

    def hear(self, new: int) -> None:
        for j in indices(new):
            self.told[j] += 1
            if self._by_chance("accept", j, self.told[j], self.how.accept):
                self.knows |= 1 << j

    def find_known(self, given: int) -> int:
        return self.knows

    def react(self, given: int, count: int) -> Reaction:
        reaction = super().react(given, count)
        for j in indices(self.knows):
            if self._by_chance("forget", j, count, self.how.forget):
                self.knows &= ~(1 << j)
        return reaction

    def _by_chance(self, what: str, message: int, time: int, chance: float) -> bool:
        return bool(stream(self.seed, what, message, time).random() < chance)


class _Others(Exact):
    as_observed = False


class AllWrong(_Others):
    """Users who believe every fact incorrectly."""

    def others(
        self, domain: Domain, observed: tuple[UserType, ...], rng: np.random.Generator
    ) -> tuple[UserType, ...]:
        """See :class:`Explainee`."""
        return (user_type(domain, "all wrong", [one.name for one in domain.parameters]),)


class Union(_Others):
    """Users who believe incorrectly all facts of two types."""

    def others(
        self, domain: Domain, observed: tuple[UserType, ...], rng: np.random.Generator
    ) -> tuple[UserType, ...]:
        """See :class:`Explainee`."""
        pairs = list(combinations(observed, 2))
        drawn = [pairs[i] for i in rng.permutation(len(pairs))]
        return tuple(
            UserType(f"{a.name} and {b.name}", {**a.inaccurate, **b.inaccurate}) for a, b in drawn
        )


TRIES = 40
"""Number of random sets of facts."""


class Unseen(_Others):
    """Users with a set of incorrect beliefs that no observer has."""

    def others(
        self, domain: Domain, observed: tuple[UserType, ...], rng: np.random.Generator
    ) -> tuple[UserType, ...]:
        """See :class:`Explainee`: random sets with at most one fact more than a type's."""
        names = [parameter.name for parameter in domain.parameters]
        most = min(max(len(one.inaccurate) for one in observed) + 1, len(names))
        found: dict[tuple[str, ...], UserType] = {}
        for _ in range(TRIES):
            size = int(rng.integers(1, most + 1))
            facts = tuple(names[j] for j in sorted(rng.choice(len(names), size, replace=False)))
            found[facts] = user_type(domain, f"unseen {'+'.join(facts)}", facts)
        return tuple(found.values())


class Backlash(_Others):
    """Users who believe a fact incorrectly after its message, if they believed it correctly
    before."""

    def others(
        self, domain: Domain, observed: tuple[UserType, ...], rng: np.random.Generator
    ) -> tuple[UserType, ...]:
        """See :class:`Explainee`."""
        return tuple(replace(one, name=f"{one.name}, backlash", backlash=True) for one in observed)
