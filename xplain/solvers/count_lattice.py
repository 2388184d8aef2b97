"""The count lattice: what labels can teach, with all that teaches the same merged.

After *explain* with k + 1 transitions shown and message set H, the user answers k + 1 labels.
Labels that every type predicts alike carry no news; transitions with the same column P[:, i, H]
are exchangeable, so the number of their 1s is enough. 2^(k+1) answers become Π (n_g + 1) counts.

A belief is what its log-likelihoods are. They are summed as integers (multiples of 2^-40), so
equal evidence in any order gives equal integers, and these are an exact key of the belief.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.numba_kernels import inlined, shared_kernel
from xplain.solvers.rows import row

SCALE = float(1 << 40)
IMPOSSIBLE = -(1 << 62)
"""The log-likelihood of a type that could not have answered so, or only with e^-1024 of the
likeliest type's probability."""
FAINT = -(1 << 50)


class Branches(NamedTuple):
    """What :func:`branch` finds, for m steps and N types, and room for it to work in.

    Attributes:
        weight: [capacity, N] joint probability of the past, each type, and the answer.
        evidence: [capacity, N + words] log-likelihoods after it, 0 for the likeliest type; and the
            words that go with them.
        tail: [N] the joint weight of all that was not listed.
        column: [m, N] P(answer 1) of the transitions shown.
        groups: [4, m + 1] first transition, size, first row and count of a group.
        likelihood, news: [2 m, N] probability and evidence of a group's counts.
        weights, logs: [m + 1, N] joint probability and evidence of a prefix of counts.
    """

    weight: NDArray[np.float64]
    evidence: NDArray[np.int64]
    tail: NDArray[np.float64]
    column: NDArray[np.float64]
    groups: NDArray[np.int64]
    likelihood: NDArray[np.float64]
    news: NDArray[np.int64]
    weights: NDArray[np.float64]
    logs: NDArray[np.int64]


def make_answers(capacity: int, steps: int, types: int, words: int = 0) -> Branches:
    """Room for so many answers, each with ``words`` integers that answers do not change."""
    return Branches(
        np.empty((capacity, types)),
        np.empty((capacity, types + words), np.int64),
        np.empty(types),
        np.empty((steps, types)),
        np.empty((4, steps + 1), np.int64),
        np.empty((2 * steps, types)),
        np.empty((2 * steps, types), np.int64),
        np.empty((steps + 1, types)),
        np.empty((steps + 1, types), np.int64),
    )


@shared_kernel
def branch(model, step, given, weight, evidence, negligible, answers):  # type: ignore[no-untyped-def]
    """The distinguishable answers to *explain*.

    Args:
        model: the problem's.
        step: k; k + 1 transitions are shown.
        given: H.
        weight: [N] joint probability of the past and each type; needs not sum to 1.
        evidence: [N + words] int64 log-likelihoods of the past, 0 for the likeliest type.
        negligible: answers (and whole families of them) with less joint probability than this
            are not listed.
        answers: is filled.

    Returns:
        The number of answers listed; −1 where they are more than the capacity.
    """
    groups = _group(model, step, given, weight, answers)
    return _list_counts(groups, weight, evidence, negligible, answers)


@inlined
def _group(model, step, given, weight, answers):  # type: ignore[no-untyped-def]
    """Finds the groups of exchangeable transitions that carry news, and fills in what each count
    of 1s in a group says. Returns their number."""
    first, size, start = answers.groups[0], answers.groups[1], answers.groups[2]
    column = answers.column
    for t in range(len(weight)):
        at = row(model.rows.part, given, t)
        for i in range(step + 1):
            column[i, t] = model.answered[i, at, t]
    groups = 0
    for i in range(step + 1):
        if not _informative(column[i], weight):
            continue
        for g in range(groups + 1):
            if g == groups:
                first[g], size[g] = i, 0
                groups += 1
            if _same_column(column[first[g]], column[i], weight):
                size[g] += 1
                break
    start[0] = 0
    for g in range(groups):
        start[g + 1] = start[g] + size[g] + 1
        for t in range(len(weight)):
            yes = column[first[g], t] if weight[t] > 0.0 else -1.0
            _binomial(yes, size[g], start[g], t, answers.likelihood, answers.news)
    return groups


@inlined
def _list_counts(groups, weight, evidence, negligible, answers):  # type: ignore[no-untyped-def]
    """Lists all counts, depth first through the groups. A prefix's weight is the sum over its
    completions, so a negligible prefix is a negligible family."""
    types = len(weight)
    size, start, count = answers.groups[1], answers.groups[2], answers.groups[3]
    weights, logs, tail = answers.weights, answers.logs, answers.tail
    for g in range(groups):
        count[g] = 0
    for t in range(types):
        weights[0, t] = weight[t]
        logs[0, t] = evidence[t]
        tail[t] = 0.0
    found = 0
    level = 0
    while level >= 0:
        if level == groups:
            if found == len(answers.weight):
                return -1
            copy(weights[level], answers.weight[found])
            copy(evidence, answers.evidence[found])
            normalise(weights[level], logs[level], answers.evidence[found])
            found += 1
            level -= 1
        elif count[level] > size[level]:
            count[level] = 0
            level -= 1
        else:
            row = start[level] + count[level]
            count[level] += 1
            total = 0.0
            for t in range(types):
                w = weights[level, t] * answers.likelihood[row, t]
                weights[level + 1, t] = w
                log = logs[level, t] + answers.news[row, t]
                logs[level + 1, t] = log if w > 0.0 else IMPOSSIBLE
                total += w
            if total > negligible:
                level += 1
            else:
                for t in range(types):
                    tail[t] += weights[level + 1, t]
    return found


@inlined
def _informative(column, weight):  # type: ignore[no-untyped-def]
    first = -1
    for t in range(len(weight)):
        if weight[t] > 0.0:
            if first < 0:
                first = t
            elif column[t] != column[first]:
                return True
    return False


@inlined
def _same_column(column, other, weight):  # type: ignore[no-untyped-def]
    different = False
    for t in range(len(weight)):
        different |= weight[t] > 0.0 and column[t] != other[t]
    return not different


@inlined
def _binomial(yes, size, start, t, likelihood, news):  # type: ignore[no-untyped-def]
    """Of ``size`` labels, each 1 with probability ``yes``: P(c ones), and their evidence; 0 where
    the type cannot be, ``yes`` < 0."""
    log_yes = round(np.log(yes) * SCALE) if yes > 0.0 else 0
    log_no = round(np.log1p(-yes) * SCALE) if 0.0 <= yes < 1.0 else 0
    choose = 1.0 if yes >= 0.0 else 0.0
    yes = max(yes, 0.0)  # a power of −1 would make 0 a −0, which has other bytes
    for ones in range(size + 1):
        probability = choose * yes**ones * (1.0 - yes) ** (size - ones)
        likelihood[start + ones, t] = probability
        news[start + ones, t] = ones * log_yes + (size - ones) * log_no
        choose *= (size - ones) / (ones + 1)


@inlined
def normalise(weight, logs, out):  # type: ignore[no-untyped-def]
    """Fills in the evidence [N] of log-likelihoods: 0 for the likeliest type."""
    top = IMPOSSIBLE
    for t in range(len(weight)):
        if weight[t] > 0.0 and logs[t] > top:
            top = logs[t]
    for t in range(len(weight)):
        out[t] = logs[t] - top if weight[t] > 0.0 and logs[t] - top > FAINT else IMPOSSIBLE


@inlined
def hash_key(step, given, evidence):  # type: ignore[no-untyped-def]
    """A 64-bit hash of (k, H, evidence)."""
    h = np.uint64(step) * np.uint64(0x9E3779B97F4A7C15) ^ np.uint64(given)
    for t in range(len(evidence)):
        h = (h ^ (h >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
        h ^= np.uint64(evidence[t])
    h = (h ^ (h >> np.uint64(32))) * np.uint64(0x94D049BB133111EB)
    return h ^ (h >> np.uint64(29))


@inlined
def copy(source, target):  # type: ignore[no-untyped-def]
    """Fills an array [N] from another. (``target[:] = source`` would allocate, and compiles a
    message for shapes that do not fit.)"""
    for t in range(len(target)):
        target[t] = source[t]


@inlined
def same(a, b):  # type: ignore[no-untyped-def]
    """Whether two arrays [N] are equal."""
    different = 0
    for t in range(len(a)):
        different += a[t] != b[t]
    return different == 0
