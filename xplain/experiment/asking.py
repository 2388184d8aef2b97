"""The questions that may be asked while a trace is explained: clips of the task, and beliefs about
its facts.

Setting ── beliefs, clips ── CaseQuestions (one for each trace)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import transition_features
from xplain.domains.users.setting import Setting
from xplain.errors import InputError
from xplain.explanation.asking import Limits, Pool, Questions, alike_first, nearest_first
from xplain.explanation.label_table import LabelTable, join_steps
from xplain.explanation.message_sets import subsets
from xplain.learning.types import TablesOf
from xplain.randomness import stream

TOLD = 0.01
"""Messages about facts below this probability of an incorrect belief are not modelled as
corrections."""
MOST_TOLD = 12
"""Maximum number of facts of a type whose messages are modelled as corrections: the facts with the
most likely incorrect beliefs."""


@dataclass(frozen=True)
class CaseQuestions:
    """Q questions that may be asked while a trace is explained: questions about beliefs, and then
    clips, the nearest to the trace first.

    Attributes:
        transitions: [Q, 3] the transition of each clip; −1 for questions about a belief.
        facts: [Q] the fact of each question about a belief; −1 for clips.
        learned: table of P(label is 1) for each question and each of the N learned types. The label
            of a question about a belief is 1 if the user believes the fact correctly.
        labels: table of the true labels for each question and each of M true types.
        texts: Q texts (:class:`~xplain.explanation.asking.Questions`).
        right: [Q] index of the true sentence of a question about a belief, 0 or 1; −1 for clips.
        everything: table of P(label is 1) for each question, for a type that believes every fact
            incorrectly; None if unknown.
    """

    transitions: NDArray[np.int64]
    facts: NDArray[np.int64]
    learned: LabelTable
    labels: LabelTable
    texts: tuple[str, ...]
    right: NDArray[np.int64]
    everything: LabelTable | None = None

    def take(self, order: NDArray[np.int64]) -> CaseQuestions:
        """Returns the questions with the indices in ``order``, in the order of the indices
        there."""
        return CaseQuestions(
            self.transitions[order],
            self.facts[order],
            self.learned.of_steps(order.tolist()),
            self.labels.of_steps(order.tolist()),
            tuple(self.texts[q] for q in order),
            self.right[order],
            self.everything and self.everything.of_steps(order.tolist()),
        )

    def of_users(self, setting: Setting, types: Sequence[int]) -> CaseQuestions:
        """Returns the same questions with other true labels.

        Args:
            setting: has the types.
            types: numbers of the types whose labels become the true labels.
        """
        beliefs = self.facts[self.facts >= 0].tolist()
        labels = [
            _make_belief_table(setting.wrong, beliefs),
            setting.true_labels(self.transitions[len(beliefs) :]),
        ]
        return replace(self, labels=join_steps(labels).of_types(types))

    def to_questions(self, limits: Limits, trace: NDArray[np.int64]) -> Questions:
        """Makes the questions of an explanation problem for the learned types.

        Args:
            limits: cost, number and time of questions.
            trace: [m, 3] the transitions of the trace.
        """
        shows = (self.transitions[:, None] == trace).all(axis=-1)
        return Questions(self.learned, limits, shows, self.texts, self.right)


QuestionsOf = Callable[[NDArray[np.float64]], CaseQuestions]
"""Selects the questions of a trace from the features [m, F] of its transitions."""


def prepare_questions(
    setting: Setting,
    tables: TablesOf,
    pool: Pool,
    wrong: NDArray[np.float64] | None,
    seed: int,
) -> QuestionsOf:
    """Returns the function that selects the questions of a trace from all questions about beliefs
    and all clips (:func:`~xplain.explanation.asking.alike_first`).

    Args:
        setting, wrong, seed: as in :func:`belief_questions`.
        tables: computes the labels of clips by all labelers; called once for all transitions.
        pool: the kinds of questions, and the maximum number for a trace.
    """
    makers: dict[str, Callable[[], CaseQuestions]] = {
        "beliefs": lambda: belief_questions(setting, wrong, seed),
        "clips": lambda: clip_questions(setting, tables),
    }
    every = reduce(_join, [make() for kind, make in makers.items() if kind in pool.kinds])
    count = int((every.facts >= 0).sum())
    features = transition_features(setting.domain, every.transitions[count:])

    def select(of_trace: NDArray[np.float64]) -> CaseQuestions:
        order = np.concatenate([np.arange(count), count + nearest_first(features, of_trace)])
        alike = alike_first(every.learned.of_steps(order.tolist()), pool.clips)
        return every.take(order[alike])

    return select


def _join(one: CaseQuestions, other: CaseQuestions) -> CaseQuestions:
    return CaseQuestions(
        np.concatenate([one.transitions, other.transitions]),
        np.concatenate([one.facts, other.facts]),
        join_steps([one.learned, other.learned]),
        join_steps([one.labels, other.labels]),
        one.texts + other.texts,
        np.concatenate([one.right, other.right]),
        one.everything and other.everything and join_steps([one.everything, other.everything]),
    )


def clip_questions(setting: Setting, tables: TablesOf) -> CaseQuestions:
    """Makes a question about each transition that the robot can make."""
    transitions, none = setting.reachable, np.full(len(setting.reachable), -1)
    asked = tables(transition_features(setting.domain, transitions), transitions)
    return CaseQuestions(
        transitions=transitions,
        facts=none,
        learned=asked.learned,
        labels=setting.true_labels(transitions),
        texts=tuple(setting.domain.describe(one) for one in transitions),
        right=none,
        everything=asked.everything,
    )


def belief_questions(
    setting: Setting, wrong: NDArray[np.float64] | None, seed: int
) -> CaseQuestions:
    """Makes a question about each fact that has two sentences: which of the two does the user
    believe?

    Answer 1 is the true sentence.

    Args:
        setting: has the true types.
        wrong: [N, n] P(a user of a learned type believes a fact incorrectly).
        seed: seed of the run; it decides which sentence comes first.

    Raises:
        InputError: the types' incorrect beliefs are unknown, or no fact has two sentences.
    """
    if wrong is None:
        wanted = "clips; or types with fact sets, as labeler=truth and labeler=hypotheses give"
        raise InputError("ask", "beliefs", wanted)
    parameters = setting.domain.parameters
    facts = [j for j, one in enumerate(parameters) if one.message and one.belief]
    if not facts:
        raise InputError("ask", "beliefs", "clips: no fact of the domain has two sentences")
    right = stream(seed, "ask", "order of sentences").integers(0, 2, len(facts))
    pairs = [(parameters[j].message, parameters[j].belief) for j in facts]
    order = [pair[::-1] if last else pair for pair, last in zip(pairs, right, strict=True)]
    return CaseQuestions(
        transitions=np.full((len(facts), 3), -1),
        facts=np.array(facts),
        learned=_make_belief_table(wrong, facts),
        labels=_make_belief_table(setting.wrong, facts),
        texts=tuple(map("\n".join, order)),
        right=right,
        everything=_make_belief_table(np.ones((1, setting.n_messages)), facts),
    )


def _make_belief_table(wrong: NDArray[np.float64], facts: Sequence[int]) -> LabelTable:
    """Makes the table P(a user believes fact j correctly | type, message set H). Each row of the
    table is one fact. The probability is 1 if H contains the message about j; for each type, only
    MOST_TOLD facts have this effect, those with the highest probability of an incorrect belief (at
    least TOLD).

    Args:
        wrong: [N, n] P(a user of a type believes a fact incorrectly).
        facts: indices j of the facts.
    """
    rows, tables = [], []
    for own in wrong:
        likely = [j for j in np.argsort(-own, kind="stable").tolist() if own[j] >= TOLD]
        relevant = sorted(set(likely[:MOST_TOLD]) & set(facts))
        told = subsets(relevant)
        table = np.repeat(1 - own[list(facts), None], len(told), axis=1)
        for q, j in enumerate(facts):
            if j in relevant:
                table[q, told >> j & 1 == 1] = 1
        rows.append(relevant)
        tables.append(table)
    return LabelTable.join_types(rows, tables)
