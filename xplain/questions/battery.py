"""One list of questions for everybody, which tells all candidates apart.

A question separates two candidates when they label it differently. The list is a greedy cover of
all pairs of candidates that behave differently, each ``redundancy`` times, so that errors are
borne; greedy covers are near-optimal, as the number of pairs covered is submodular.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xplain.domains.users.hypotheses import Hypotheses
from xplain.errors import TooLargeError, whole_number
from xplain.explanation.message_sets import indices, subsets
from xplain.randomness import stream

MAX_CELLS = 1 << 26
"""Different questions × classes of candidates that a list is chosen for."""
Battery = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Transitions [Q] and message sets [Q]."""


def battery(
    hypotheses: Hypotheses, redundancy: int = 1, seed: int = 0, at_least: int = 0
) -> Battery:
    """The list, those questions first that separate most; of questions that separate the same,
    one about a transition not asked about before, with few messages to read.

    Args:
        hypotheses: the candidates.
        redundancy: questions, at least, that separate each pair. Two that do may be the same,
            where no other does.
        seed: decides between questions that are as good.
        at_least: questions in the list; beyond those needed, it goes on as for a larger
            redundancy.

    Raises:
        InputError: redundancy < 1.
        TooLargeError: too many candidates and questions.
    """
    whole_number("queries.redundancy", redundancy, 1)
    rng = stream(seed, "battery")
    questions, partition = distinct_questions(hypotheses)
    split = partition.astype(np.float32)
    count = split.shape[1]
    lacking = np.full((count, count), redundancy) * ~np.eye(count, dtype=bool)
    seen = np.zeros(hypotheses.n_transitions, dtype=np.int64)
    chosen: list[tuple[int, int]] = []
    while True:
        if not (lacking > 0).any():
            if len(chosen) >= at_least:
                break
            lacking += ~np.eye(count, dtype=bool)
        gain = ((split @ (lacking > 0).astype(np.float32)) * (1 - split)).sum(axis=1)
        best = int(rng.choice(np.flatnonzero(gain == gain.max())))
        among = questions[best]
        new = among[seen[among[:, 0]] == seen[among[:, 0]].min()]
        words = np.array([int(told).bit_count() for told in new[:, 1]])
        transition, told = (int(x) for x in rng.choice(new[words == words.min()]))
        chosen.append((transition, told))
        seen[transition] += 1
        lacking -= partition[best][:, None] != partition[best]
    list_ = np.array(chosen, dtype=np.int64).reshape(-1, 2)
    return list_[:, 0], list_[:, 1]


def distinct_questions(
    hypotheses: Hypotheses,
) -> tuple[list[NDArray[np.int64]], NDArray[np.bool_]]:
    """The questions by which classes of candidates they separate from which.

    Returns:
        For each of D partitions its questions, [·, 2] transition and message set (no more messages
        than matter); and [D, classes] who labels them unlike the first class.

    Raises:
        TooLargeError: questions × classes > MAX_CELLS.
    """
    _, first = np.unique(hypotheses.classes, return_index=True)
    matters = hypotheses.matters
    count = sum(1 << int(one).bit_count() for one in matters.tolist() if one)
    if count * len(first) > MAX_CELLS:
        raise TooLargeError(
            f"queries: {count} questions and {len(first)} classes of candidates are too many "
            "for one list; ask each person their own (queries=adaptive)"
        )
    every = [(t, told) for t in np.flatnonzero(matters).tolist()
             for told in subsets(indices(int(matters[t]))).tolist()]  # fmt: skip
    asked = np.array(every, dtype=np.int64).reshape(-1, 2)
    held = hypotheses.facts[first] & ~asked[:, 1:]
    labels = hypotheses.labels[hypotheses.row(held), asked[:, :1]].astype(bool)
    labels ^= labels[:, :1]  # 0 and 1 exchanged separate the same
    partition, which = np.unique(labels, axis=0, return_inverse=True)
    groups = [asked[which.ravel() == d] for d in range(len(partition))]
    tells = [d for d in range(len(partition)) if partition[d].any()]
    return [groups[d] for d in tells], partition[tells]
