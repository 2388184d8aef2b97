"""How the people of a collection listened and answered, from its log (``collect habits``).

On most pages messages hold for that page alone. At the end (``rules.listening``) they hold from
then on: a step that made no sense is shown with the message that explains it, some pages later with
nothing said, and then with the message said again. A label of 0 at first was a message missed, a
label that falls back one forgotten, unless the person erred: an exact filter over (facts held
wrong, habits, messages known now) weighs it, as in an explanation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xplain.domains.users.hypotheses import Hypotheses
from xplain.errors import InputError
from xplain.explanation.belief import after_forgetting, after_message
from xplain.explanation.habits import Habits
from xplain.explanation.message_sets import indices, subsets
from xplain.people.collect.asking import ATTENTION, HEEDED, AskedClip, CollectState, prior
from xplain.people.collect.plan import CollectPlan
from xplain.people.collect.tables import why_left_out
from xplain.people.export import rows_of

FACT_SETS = 64
"""The likeliest of a person, by their answers to all questions; others are left out."""


@dataclass(frozen=True)
class Asked:
    """The pages of one person.

    Attributes:
        known: labels of people who hold some facts wrong.
        held: [N] fact sets that may be the person's, as bitmasks.
        prior: [N] how likely each is before any answer.
        clips: all pages but the obvious step, in order, with their labels.
    """

    known: Hypotheses
    held: NDArray[np.int64]
    prior: NDArray[np.float64]
    clips: Sequence[AskedClip]

    def posterior(self, habits: Habits) -> NDArray[np.float64]:
        """[F] how likely each habit is to be the person's."""
        weight = np.outer(self.prior, habits.prior).ravel()
        lasting = [clip for clip in self.clips if clip.purpose in HEEDED]
        for clip in self.clips:
            if clip.purpose not in HEEDED:
                weight = self._through([clip], weight, habits)
                weight /= weight.sum()
        found = self._through(lasting, weight, habits).reshape(-1, len(habits)).sum(axis=0)
        return np.asarray(found / found.sum())

    def _through(
        self, clips: Sequence[AskedClip], weight: NDArray[np.float64], habits: Habits
    ) -> NDArray[np.float64]:
        """The weights [N F] of (fact set, habit), times what pages tell on which what is said holds
        from page to page; nothing is known before."""
        told = sorted({j for clip in clips for j in indices(clip.told)})
        relevant = np.tile(np.array(told, np.int64), (len(weight), 1))
        accept, lose = (np.tile(rate, len(self.held)) for rate in (habits.accept, habits.forget))
        table = self.known.row(self.held & ~subsets(told)[:, None])
        belief = np.zeros((len(table), len(weight)))
        belief[0] = weight
        for clip in clips:
            for j in indices(clip.told):
                belief = after_message(belief, relevant, j, accept)
            judged = clip.judged
            for transition, label in zip(judged.transitions, judged.labels, strict=True):
                one = habits.answered(self.known.labels[table, transition].astype(float))
                belief = belief * (one if label else 1 - one)
            belief = after_forgetting(belief.ravel(), lose).reshape(belief.shape)
        return np.asarray(belief.sum(axis=0))


def listeners_in(database: Path, stream: str = "person") -> list[Asked]:
    """The people of a stream whose labels count, but for those whom no hypothesis fits.

    Args:
        database: of a collection that no server has open, or a snapshot.
        stream: "person", "pilot" or "bot"; never mixed.

    Raises:
        InputError: it is no collection's database, there is no such stream, or nothing was told
            that holds from page to page.
    """
    query = "SELECT state FROM seen WHERE stream = ? AND NOT erased ORDER BY number"
    plan, rows = rows_of(database, stream, CollectPlan, query)
    states = [CollectState.from_text(text) for (text,) in rows]
    if not plan.rules.listening:
        wanted = "1 or more at the start of the collection: nothing was asked again"
        raise InputError("rules.listening", 0, wanted)
    kept = [state for state in states if not why_left_out(state) and state.belief["none"] < 0.5]
    if not kept:
        raise InputError("database", str(database), f"one with answers (stream {stream})")
    return [asked_of(plan, state) for state in kept]


def asked_of(plan: CollectPlan, state: CollectState) -> Asked:
    """The pages of somebody who came to the end of them."""
    known = plan.hypotheses
    before = np.bincount(known.classes, prior(plan, state.others))
    shares = {int(facts): share for facts, share in state.belief.items() if facts != "none"}
    held = np.array(sorted(shares, key=lambda facts: -shares[facts])[:FACT_SETS])
    own = before[known.classes[known.row(held)]]
    clips = tuple(clip for clip in state.answered if clip.purpose != ATTENTION)
    return Asked(known, held, own / own.sum(), clips)
