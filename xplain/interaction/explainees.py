"""Simulated users of an explanation: the paper's, and more realistic ones.

An *explainee* is one kind of user. It makes a *person* for each trace and true type. The person
receives messages, judges whether each shown transition makes sense, and answers. Costs count what
the person thinks. Each random choice of a person is drawn from the person's seed, the messages, the
transition and, for some kinds, the step, independent of all other choices. So every solver meets
the same person.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.domains.base import Domain
from xplain.domains.users.setting import UserType
from xplain.domains.users.types import user_type
from xplain.errors import Count, Probability, Range, Slip, checks
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


class Explainee:
    """A kind of user. All methods have defaults, which subclasses may replace.

    Attributes:
        as_observed: True if these users have the observers' types, False if they have the types of
            :meth:`others`.
    """

    as_observed: ClassVar[bool] = True

    @property
    def habits(self) -> Habits:
        """The habits of these users, which the clairvoyant may know."""
        return PAPER

    def others(
        self, domain: Domain, observed: tuple[UserType, ...], rng: np.random.Generator
    ) -> tuple[UserType, ...]:
        """Returns types of these users. The experiment uses the types that behave unlike the
        observers' types.

        Args:
            domain: the task.
            observed: the observers' types.
            rng: for random types.
        """
        return ()

    def thoughts(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> LabelTable:
        """Returns the labels that a new person thinks, by default the labels of the person's type.
        The clairvoyant knows these labels.

        Args:
            labels, same, seed: see :meth:`meet`.
        """
        return labels

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> SimulatedUser:
        """Makes a new person of this kind.

        Args:
            labels: labels 0 and 1 of one type, for m transitions and then for the possible
                questions.
            same: for each row of ``labels``, the index of the first equal row. A person gives equal
                labels and errors to equal rows.
            seed: the person's seed.
        """
        return SimulatedUser(self.thoughts(labels, same, seed), self, same, seed)

    def hear(self, user: SimulatedUser, new: int) -> None:
        """Changes what a user knows, or remembers, after messages (a bitmask)."""

    def find_known(self, user: SimulatedUser, given: int) -> int:
        """Returns the bitmask of the facts that a user knows after the messages ``given``."""
        return given

    def say(
        self,
        user: SimulatedUser,
        thoughts: NDArray[np.uint8],
        rows: NDArray[np.int64],
        given: int,
        *when: int | str,
    ) -> NDArray[np.uint8]:
        """Returns a user's answers about some rows of the user's label table.

        Args:
            user: the user.
            thoughts: the labels of these rows that the user truly thinks.
            rows: indices of the rows; a row is a transition or a question.
            given: bitmask of the messages.
            when: the step, or the question; random draws may depend on it.
        """
        return thoughts

    def end_step(self, user: SimulatedUser, known: int, thoughts: NDArray[np.uint8]) -> None:
        """Changes what a user knows, or remembers, after a step's answers.

        Args:
            user: the user.
            known: bitmask of the facts that the user knew at this step.
            thoughts: the labels that the user thought.
        """


@dataclass(frozen=True)
class Exact(Explainee):
    """The paper's users: they know all given messages, and answer what they think."""


@dataclass
class SimulatedUser:
    """A person in one explanation. By default the person accepts every message, never forgets, and
    answers by the true labels of one user type.

    Attributes:
        table: label table of this type alone; its first rows are the trace's transitions, the other
            rows are questions.
        kind: decides what the person knows and answers.
        same, seed: see :meth:`Explainee.meet`.
        step: number of transitions shown so far.
        knows: bitmask of the facts that the person knows, if the kind stores it.
        memory: for some messages, a number that the kind stores for the person.
    """

    table: LabelTable
    kind: Explainee = Exact()
    same: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    seed: int = 0
    step: int = field(default=0, init=False)
    knows: int = field(default=0, init=False)
    memory: Counter[int] = field(default_factory=Counter, init=False)

    @classmethod
    def of(cls, labels: ArrayLike) -> SimulatedUser:
        """Makes a user with labels from an array [m, 2^n]."""
        return cls(LabelTable.dense(np.asarray(labels)[None]))

    def labels(self, count: int, message_set: int) -> NDArray[np.uint8]:
        """Returns [count] the type's true labels of the prefix if all facts of ``message_set`` are
        known."""
        labels = self.table.label_probabilities(count, message_set)[0]
        return labels.astype(np.uint8)

    def hear(self, new: int) -> None:
        """Receives messages (a bitmask), new or repeated."""
        self.kind.hear(self, new)

    def react(self, given: int, count: int) -> Reaction:
        """Reacts to the first ``count`` transitions, given the messages ``given`` so far (a
        bitmask). The method is called once for each step, in order."""
        self.step = count
        known = self.kind.find_known(self, given)
        thoughts = self.labels(count, known)
        answers = self.kind.say(self, thoughts, np.arange(count), given, count)
        self.kind.end_step(self, known, thoughts)
        return Reaction(thoughts, answers)

    def answer(self, row: int, given: int) -> int:
        """Answers a question with 0 or 1, given the messages ``given`` so far. ``row`` is the
        question's row in the table."""
        thought = self.labels(row + 1, self.kind.find_known(self, given))[row:]
        return int(self.kind.say(self, thought, np.array([row]), given, "asked", row)[0])


@checks("explainee")
@dataclass(frozen=True)
class Slips(Explainee):
    """Users whose answers may differ from what they think.

    Args:
        rate: probability that an answer is flipped.
        repeats: True repeats an error whenever the transition and the messages are the same; False
            draws each answer independently.
        polite: probability of answer 1 if the person thinks 0; used if it is larger than ``rate``.
        tires: number that is added to ``rate`` at each step, up to a rate of one half.
    """

    rate: Probability = 0.1
    repeats: bool = True
    polite: Probability = 0.0
    tires: Probability = 0.0

    def say(
        self,
        user: SimulatedUser,
        thoughts: NDArray[np.uint8],
        rows: NDArray[np.int64],
        given: int,
        *when: int | str,
    ) -> NDArray[np.uint8]:
        """Returns the labels that the user thinks, of which random ones are flipped."""
        times = () if self.repeats else when
        rate = max(self.rate, min(self.rate + self.tires * user.step, 0.5))
        drawn = stream(user.seed, "slips", given, *times).random(len(user.same))[user.same[rows]]
        return thoughts ^ (drawn < np.where(thoughts == 0, max(rate, self.polite), rate))


@checks("explainee")
@dataclass(frozen=True)
class Sticky(Explainee):
    """Users who sometimes repeat their last answer without thinking.

    Args:
        rate: probability that an answer repeats the answer about the previous transition.
    """

    rate: Probability = 0.4

    def say(
        self,
        user: SimulatedUser,
        thoughts: NDArray[np.uint8],
        rows: NDArray[np.int64],
        given: int,
        *when: int | str,
    ) -> NDArray[np.uint8]:
        """Returns the user's answers. Each answer after the first repeats, with probability
        ``rate``, the answer about the previous row. All other answers are what the user thinks."""
        answers = thoughts.copy()
        repeated = stream(user.seed, "sticky", given, *when).random(len(rows)) < self.rate
        for i in np.flatnonzero(repeated[1:]) + 1:
            answers[i] = answers[i - 1]
        return answers


class Expert(Explainee):
    """Users who believe nothing incorrectly."""

    def thoughts(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> LabelTable:
        """Returns label 1 for all transitions and questions."""
        return replace(labels, p=np.ones_like(labels.p))


class Between(Explainee):
    """Users who believe one fact of their type correctly at half of the transitions, and
    incorrectly at the other half."""

    def thoughts(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> LabelTable:
        """Returns the type's labels, except that at a random half of the transitions one random
        fact is believed correctly."""
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
    """Users who always confuse some messages: each confused message has the effect of another.

    Args:
        messages: number of confused messages. At least one of them matters to the user, if any
            message does.
    """

    messages: Annotated[int, Range(2)] = 2

    def thoughts(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> LabelTable:
        """Returns a table in which each confused message has the effect that another message has on
        the type's labels."""
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
    """Users who discover a fact by themselves, some steps after the fact first mattered.

    Args:
        after: number of steps until the discovery.
    """

    after: Count = 2

    def find_known(self, user: SimulatedUser, given: int) -> int:
        """Returns the bitmask of the facts that were given or discovered. A fact is discovered
        ``after`` steps after the step that :meth:`end_step` stored for it."""
        found = (j for j, step in user.memory.items() if user.step >= step + self.after)
        return given | sum(1 << j for j in found)

    def end_step(self, user: SimulatedUser, known: int, thoughts: NDArray[np.uint8]) -> None:
        """Stores the current step for each message that would change a label at this step, if no
        earlier step is stored for the message."""
        for j in indices(sum(1 << j for j in user.table.rows[0]) & ~known):
            if (user.labels(user.step, known | 1 << j) != thoughts).any():
                user.memory.setdefault(j, user.step)


@checks("explainee")
@dataclass(frozen=True)
class Heedless(Explainee):
    """Users who may miss a message, or forget it.

    Args:
        accept: probability > 0 that a given message is accepted.
        forget: probability < 1 that a corrected fact is forgotten at a step, after its labels.
    """

    accept: Annotated[float, Range(0, 1, "(]")] = 0.8
    forget: Slip = 0.0

    @property
    def habits(self) -> Habits:
        """The rates of acceptance and forgetting."""
        return habits_of(0.0, self.accept, self.forget)

    def hear(self, user: SimulatedUser, new: int) -> None:
        """Draws which messages the user accepts. The user remembers how often each message was
        given."""
        for j in indices(new):
            user.memory[j] += 1
            if stream(user.seed, "accept", j, user.memory[j]).random() < self.accept:
                user.knows |= 1 << j

    def find_known(self, user: SimulatedUser, given: int) -> int:
        """Returns the bitmask of the accepted facts that were not forgotten."""
        return user.knows

    def end_step(self, user: SimulatedUser, known: int, thoughts: NDArray[np.uint8]) -> None:
        """Draws which known facts the user forgets."""
        forgotten = [
            j
            for j in indices(known)
            if stream(user.seed, "forget", j, user.step).random() < self.forget
        ]
        user.knows = known & ~sum(1 << j for j in forgotten)


class _Others(Exact):
    as_observed = False


class AllWrong(_Others):
    """Users who believe every fact incorrectly."""

    def others(
        self, domain: Domain, observed: tuple[UserType, ...], rng: np.random.Generator
    ) -> tuple[UserType, ...]:
        """Returns the type that believes every fact incorrectly."""
        return (user_type(domain, "all wrong", [one.name for one in domain.parameters]),)


class Union(_Others):
    """Users who have the incorrect beliefs of two types together."""

    def others(
        self, domain: Domain, observed: tuple[UserType, ...], rng: np.random.Generator
    ) -> tuple[UserType, ...]:
        """Returns a type for each pair of observed types, in random order."""
        pairs = list(combinations(observed, 2))
        drawn = [pairs[i] for i in rng.permutation(len(pairs))]
        return tuple(
            UserType(f"{a.name} and {b.name}", {**a.inaccurate, **b.inaccurate}) for a, b in drawn
        )


TRIES = 40
"""Number of random sets of facts that are drawn."""


class Unseen(_Others):
    """Users with a set of incorrect beliefs that no observer has."""

    def others(
        self, domain: Domain, observed: tuple[UserType, ...], rng: np.random.Generator
    ) -> tuple[UserType, ...]:
        """Returns types with random sets of facts. A set has at most one fact more than the largest
        set of an observed type."""
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
        """Returns copies of the observed types that react to messages in this way."""
        return tuple(replace(one, name=f"{one.name}, backlash", backlash=True) for one in observed)
