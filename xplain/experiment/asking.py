"""What may be asked while a trace is explained: clips of the task, and beliefs about its facts.

Setting ── Clips, beliefs ── CaseQuestions (one a trace)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import transition_features
from xplain.domains.users.setting import Setting
from xplain.errors import InputError
from xplain.explanation.asking import Limits, Pool, Questions, alike_first, nearest_first
from xplain.explanation.label_table import LabelTable, joined
from xplain.explanation.message_sets import subsets
from xplain.learning.types import TablesOf
from xplain.randomness import stream

TOLD = 0.01
"""A fact less likely believed incorrectly than this is taken to be as it was after its message."""
MOST_TOLD = 12
"""Facts of a type whose messages are taken to set them right, the likeliest."""


@dataclass(frozen=True)
class CaseQuestions:
    """Q questions that may be asked while a trace of m transitions is explained, nearest first.

    Attributes:
        transitions: [Q, 3] of clips; −1 where a question is about a belief.
        facts: [Q] the fact that a belief is about; −1 of clips.
        learned: P(label is 1) by the N types that were found.
        labels: the true labels of each of M true types.
        shows: [Q, m] whether a clip is of this transition of the trace.
        texts, right: as :class:`~xplain.explanation.asking.Questions` has them.
        everything: P(label is 1) of one type, who believes every fact incorrectly, where known.
    """

    transitions: NDArray[np.int64]
    facts: NDArray[np.int64]
    learned: LabelTable
    labels: LabelTable
    shows: NDArray[np.bool_]
    texts: tuple[str, ...]
    right: NDArray[np.int64]
    everything: LabelTable | None = None

    def take(self, order: NDArray[np.int64]) -> CaseQuestions:
        """Some of them, in this order."""
        return CaseQuestions(
            self.transitions[order],
            self.facts[order],
            self.learned.of_steps(order.tolist()),
            self.labels.of_steps(order.tolist()),
            self.shows[order],
            tuple(self.texts[q] for q in order),
            self.right[order],
            self.everything and self.everything.of_steps(order.tolist()),
        )

    def of_users(self, setting: Setting, types: Sequence[int]) -> CaseQuestions:
        """The same, answered by users of these types of a setting."""
        clips, beliefs = np.flatnonzero(self.facts < 0), np.flatnonzero(self.facts >= 0)
        parts = [setting.true_labels(self.transitions[clips])] if len(clips) else []
        parts += [_right(setting.wrong, self.facts[beliefs].tolist())] if len(beliefs) else []
        whole = joined(parts) if parts else self.labels
        back = np.argsort(np.concatenate([clips, beliefs]), kind="stable")
        return replace(self, labels=whole.of_steps(back.tolist()).of_types(types))

    def asked(self, table: LabelTable, limits: Limits) -> Questions:
        """As an explanation problem has them, by one of the tables."""
        return Questions(table, limits, self.shows, self.texts, self.right)


@dataclass(frozen=True)
class Clips:
    """Every transition that the robot can make, as what may be asked about.

    Attributes:
        most: how many to keep for a trace.
        every: a question about each, which knows of no trace.
        features: [T, F] of them.
    """

    most: int
    every: CaseQuestions
    features: NDArray[np.float64]

    @classmethod
    def of(cls, setting: Setting, tables: TablesOf, pool: Pool) -> Clips:
        """Makes the clips, and asks the labelers about each transition once."""
        transitions, none = setting.reachable, np.full(len(setting.reachable), -1)
        features = transition_features(setting.domain, transitions)
        asked = tables(features, transitions)
        every = CaseQuestions(
            transitions=transitions,
            facts=none,
            learned=asked.learned,
            labels=setting.true_labels(transitions),
            shows=np.zeros((len(transitions), 0), np.bool_),
            texts=tuple(setting.domain.describe(one) for one in transitions),
            right=none,
            everything=asked.everything,
        )
        return cls(pool.clips, every, features)

    def near(self, features: NDArray[np.float64], transitions: NDArray[np.int64]) -> CaseQuestions:
        """Those to choose from while a trace [m, 3] with these features [m, F] is explained."""
        order = nearest_first(self.features, features)
        alike = alike_first(self.every.learned.of_steps(order.tolist()), self.most)
        chosen = self.every.take(order[alike])
        return replace(chosen, shows=(chosen.transitions[:, None] == transitions).all(axis=-1))


def belief_questions(
    setting: Setting, wrong: NDArray[np.float64] | None, seed: int
) -> CaseQuestions:
    """Questions about each fact that has two sentences: which of the two does the user think is
    true?

    Answer 1 is the right sentence. The questions are about no trace: ``shows`` is [Q, 0].

    Args:
        setting: of the true types.
        wrong: [N, n] P(a user of a learned type believes a fact incorrectly).
        seed: of the run; it decides which sentence is shown first.

    Raises:
        InputError: it is unknown what types believe incorrectly, or no fact has two sentences.
    """
    if wrong is None:
        wanted = "clips; or types with fact sets, as labeler=truth and labeler=hypotheses give"
        raise InputError("ask", "beliefs", wanted)
    parameters = setting.domain.parameters
    facts = [j for j, one in enumerate(parameters) if one.message and one.belief]
    if not facts:
        raise InputError("ask", "beliefs", "clips: no fact of the domain has two sentences")
    right = stream(seed, "ask", "order of sentences").integers(0, 2, len(facts))
    texts = []
    for j, first in zip(facts, right.tolist(), strict=True):
        pair = (parameters[j].message, parameters[j].belief)
        texts.append("\n".join(pair[::-1] if first else pair))
    return CaseQuestions(
        transitions=np.full((len(facts), 3), -1),
        facts=np.array(facts),
        learned=_right(wrong, facts),
        labels=_right(setting.wrong, facts),
        shows=np.zeros((len(facts), 0), np.bool_),
        texts=tuple(texts),
        right=right,
        everything=_right(np.ones((1, setting.n_messages)), facts),
    )


def _right(wrong: NDArray[np.float64], facts: Sequence[int]) -> LabelTable:
    """P(has fact j right | type, H) of these facts: 1 where j is in H."""
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
    return LabelTable.joined_types(rows, tables)


def merged(parts: Sequence[CaseQuestions], most: int) -> CaseQuestions | None:
    """All of these, the nearest of each kind first and at most so many; None of none."""
    if not parts:
        return None
    whole = parts[0]
    for part in parts[1:]:
        whole = CaseQuestions(
            np.concatenate([whole.transitions, part.transitions]),
            np.concatenate([whole.facts, part.facts]),
            joined([whole.learned, part.learned]),
            joined([whole.labels, part.labels]),
            np.concatenate([whole.shows, part.shows]),
            whole.texts + part.texts,
            np.concatenate([whole.right, part.right]),
            whole.everything and part.everything and joined([whole.everything, part.everything]),
        )
    return whole.take(alike_first(whole.learned, most))
