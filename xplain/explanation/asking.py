"""Questions to the user, as actions of the explanation POMDP (docs/method.md, section 5).

A question has the answer 1 or 0, costs κ for either answer, and changes only the belief. It never
discounts, because a discounting action would gain by delaying later costs. It is asked before the
messages of a step, at most once. There are two kinds:

- a *clip*, (τ, H): "does this step make sense to you?", about a transition τ, which need not be on
  the trace, with the messages H given so far. The answer is the label of τ under H;
- a *belief*: "which do you think?", about the two sentences of a fact. The answer is 1 if the user
  believes the fact correctly.

Two clips are alike if their more likely labels are equal in every hidden state. Among alike clips
only the nearest to the trace may be asked. After its answer the next nearest may be asked, because
users may err. A question is left out if all hidden types answer it alike.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Count, InputError, Range, checks, one_of
from xplain.explanation.label_table import LabelTable

When = Literal["anytime", "first"]
Kind = Literal["clips", "beliefs"]
SENSE = "Does this step make sense to you?"
"""The question that is shown with a clip."""
WHICH = "Which do you think?"
"""The question that is shown with the two sentences of a fact."""


@checks("ask")
@dataclass(frozen=True)
class Limits:
    """Limits of questions.

    Args:
        cost: κ ≥ 0, the cost of each question, in the unit of all costs.
        most: maximum number of questions in one explanation.
        when: ``anytime``, before the messages of any step; or ``first``, before the first step.
    """

    cost: Annotated[float, Range(0)] = 0.1
    most: Count = 10
    when: When = "anytime"


@checks("ask")
@dataclass(frozen=True)
class Pool:
    """The questions that an explanation may choose from.

    Args:
        kinds: ``clips``, ``beliefs``, or both.
        clips: maximum number of clips for a trace. :func:`alike_first` selects them.
    """

    kinds: tuple[Kind, ...] = ("clips",)
    clips: Count = 150

    def __post_init__(self) -> None:
        """Raises InputError for an unknown kind, or for no kinds."""
        object.__setattr__(self, "kinds", tuple(self.kinds))
        for kind in self.kinds or ("none",):
            one_of("ask.kinds", kind, ("clips", "beliefs"), "kind")


@dataclass(frozen=True)
class Question:
    """A question in words.

    Attributes:
        number: index among the trace's questions.
        text: the question that is read to the user.
        about: text of the transition that a clip shows; "" if the question is about a fact.
        replies: the possible replies in the order of display, each with its answer, 0 or 1.
    """

    number: int
    text: str
    about: str
    replies: tuple[tuple[str, int], tuple[str, int]]

    def __str__(self) -> str:
        return self.about or f"{self.text} {' / '.join(words for words, _ in self.replies)}"


@dataclass(frozen=True)
class Questions:
    """Q questions that the explanation of one trace may ask, the nearest to the trace first; none
    by default. A question is either a clip, which shows one transition, or two sentences about one
    fact, of which one is true.

    Attributes:
        table: P(label is 1), and P(answer is 1) if users err. A row is a question instead of a
            transition.
        limits: cost, number and time.
        shows: [Q, m] True if the question is a clip of this transition of the trace.
        texts: Q texts, or none. The text of a clip names its transition. The text of a question
            about a fact has the two sentences on two lines, in the order of display.
        right: [Q] for a question about a fact, index of the true sentence, 0 or 1; −1 for a clip.
            By default −1 for all questions.
    """

    table: LabelTable = field(
        default_factory=lambda: LabelTable(np.empty((0, 0), np.int64), np.empty((0, 1, 0)))
    )
    limits: Limits = field(default_factory=Limits)
    shows: NDArray[np.bool_] = field(default_factory=lambda: np.empty((0, 0), np.bool_))
    texts: tuple[str, ...] = ()
    right: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))

    def __post_init__(self) -> None:
        """Raises InputError if an attribute does not have one entry for each question, or a
        question about a fact does not have two sentences."""
        count = len(self.table.p)
        if not self.right.size:
            object.__setattr__(self, "right", np.full(count, -1))
        if not self.shows.size:
            object.__setattr__(self, "shows", np.zeros((count, self.shows.shape[-1]), np.bool_))
        for own in (self.shows, self.right, self.texts or self.shows):
            if len(own) != count:
                raise InputError("questions", len(own), f"{count}, as the table has")
        for text, right in zip(self.texts or [""] * count, self.right.tolist(), strict=True):
            one_of("questions.right", right, (-1, 0, 1))
            if right >= 0 and text.count("\n") != 1:
                raise InputError("questions.texts", text, "two sentences on two lines")

    def __len__(self) -> int:
        return len(self.table.p)

    def question(self, number: int) -> Question:
        """Returns the question with this number in words."""
        text = self.texts[number] if self.texts else f"question {number + 1}"
        return make_question(number, text, int(self.right[number]))


def make_question(number: int, text: str, right: int) -> Question:
    """Makes a question in words from its index, its text, and its entry in
    :attr:`Questions.right`."""
    if right < 0:
        return Question(number, SENSE, text, (("yes", 1), ("no", 0)))
    first, second = text.split("\n")
    return Question(number, WHICH, "", ((first, int(right == 0)), (second, int(right == 1))))


def alike_first(table: LabelTable, most: int) -> NDArray[np.int64]:
    """Selects questions whose labels differ, from questions sorted by their distance to the trace.

    A question is left out if all types answer it with the same probability, under every message
    set. Two questions are *alike* if each type has the same more likely label for both, under every
    message set. The nearest question of each group of alike questions is selected first, then the
    second nearest of each group, then the third nearest, and so on. Among the nearest questions of
    all groups, a question is selected earlier if no nearer question has the same more likely labels
    before any message.

    Args:
        table: label table of the questions, the nearest to the trace first.
        most: maximum number of selected questions.

    Returns:
        Indices of the selected questions in ``table``, ascending.
    """
    yes = table.p >= 0.5
    same = (table.answered == table.answered[:, :, :1]).all(axis=(1, 2))
    if (table.relevant != table.relevant[0]).any():  # then a row has another message set by type
        for q in np.flatnonzero(same).tolist():
            same[q] = len({*table.of_steps([q]).effective()}) == 1
    turn: dict[bytes, int] = {}
    silent: dict[bytes, int] = {}
    order: list[tuple[int, int, int]] = []
    for q in np.flatnonzero(~same).tolist():
        key, first = yes[q].tobytes(), yes[q, 0].tobytes()
        round_, new = turn.get(key, 0), first not in silent
        turn[key], silent[first] = round_ + 1, 1
        order.append((round_, not new, q))
    return np.sort(np.array([q for *_, q in sorted(order)[:most]], np.int64))


def nearest_first(
    features: NDArray[np.float64], of_trace: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Sorts transitions by their distance to a trace, the nearest first.

    The distance is the smallest number of features in which the transition differs from a
    transition of the trace. If two distances are equal, the smallest sum of scaled differences of
    features from a transition of the trace decides.

    Args:
        features: [Q, F] features of the transitions to sort.
        of_trace: [m, F] features of the trace's transitions.

    Returns:
        [Q] indices of the sorted transitions.
    """
    if not len(features):
        return np.empty(0, np.int64)
    scale = np.ptp(np.concatenate([features, of_trace]), axis=0)
    scale[scale == 0] = 1
    differ = np.empty((len(features), len(of_trace)))
    sizes = np.empty_like(differ)
    for i, row in enumerate(of_trace):
        apart = np.abs(features - row) / scale
        differ[:, i], sizes[:, i] = (apart > 0).sum(axis=1), apart.sum(axis=1)
    nearest = np.lexsort((sizes.min(axis=1), differ.min(axis=1)))
    return nearest.astype(np.int64)


def bitmask(asked: Iterable[int]) -> int:
    """Returns the bitmask in which bit q is 1 for each number q of ``asked``."""
    return sum(1 << q for q in set(asked))
