"""Query designs that use hypotheses of incorrect beliefs: one list for everybody that separates all
candidates, or a questionnaire for each person (docs/what-to-ask.md).

A question separates two candidates if they give it different labels. Candidates that no question
separates form a class. The list is a greedy cover: its questions separate each pair of classes at
least ``redundancy`` times, so that the list tolerates errors. Greedy covers are near-optimal,
because the number of covered pairs is submodular.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from xplain.domains.base import transition_features
from xplain.domains.users.hypotheses import Hypotheses, hypotheses_of
from xplain.domains.users.setting import Setting
from xplain.errors import Count, InputError, Range, TooLargeError, checks, whole_number
from xplain.explanation.message_sets import indices, subsets
from xplain.learning.data.dataset import places
from xplain.learning.data.queries import Answer, QueryAnswers, ask_in_order, count_expected_visits
from xplain.learning.mixture.likelihood import grow
from xplain.questions.questionnaire import MAX_CLIP, NONE_ERROR, Questionnaire
from xplain.randomness import derive_seed, stream

MAX_CELLS = 1 << 26
"""Maximum number of distinct questions × classes of candidates for a list."""
QuestionList = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Transitions [Q] and message sets [Q]."""


def battery(hypotheses: Hypotheses, redundancy: int, seed: int, at_least: int = 0) -> QuestionList:
    """Chooses one list of questions for everybody. Questions that separate most pairs of candidates
    come first. Among questions that separate the same pairs, questions about new transitions with
    few messages come first.

    Args:
        hypotheses: the candidates.
        redundancy: minimum number of questions that separate each pair. A question may occur twice
            if no other question separates the pair.
        seed: breaks ties between questions.
        at_least: minimum number of questions. If the list is shorter, ``redundancy`` is raised
            until the list is long enough.

    Returns:
        The transition of each question, and its message set.

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
    """Groups the questions that separate the same candidates. Candidates that behave alike form a
    class, and a question gives each class one label.

    Returns:
        D groups of questions: for each group an array [·, 2] with the transition and the message
        set of each question. The sets have only messages that matter for the transition.
        [D, classes] True for each class to which the questions of the group give another label than
        to class 0.

    Raises:
        TooLargeError: questions × classes > MAX_CELLS.
    """
    _, first = np.unique(hypotheses.classes, return_index=True)
    matters = hypotheses.matters
    count = sum(1 << int(one).bit_count() for one in matters.tolist() if one)
    if count * len(first) > MAX_CELLS:
        raise TooLargeError(
            f"queries: {count} questions and {len(first)} classes of candidates are too many "
            "for one list; choose questions for each person (queries=adaptive)"
        )
    every = [(t, told) for t in np.flatnonzero(matters).tolist()
             for told in subsets(indices(int(matters[t]))).tolist()]  # fmt: skip
    asked = np.array(every, dtype=np.int64).reshape(-1, 2)
    held = hypotheses.facts[first] & ~asked[:, 1:]
    labels = hypotheses.labels[hypotheses.row(held), asked[:, :1]].astype(bool)
    labels ^= labels[:, :1]  # exchanging 0 and 1 separates the same classes
    partition, which = np.unique(labels, axis=0, return_inverse=True)
    groups = [asked[which.ravel() == d] for d in range(len(partition))]
    tells = [d for d in range(len(partition)) if partition[d].any()]
    return [groups[d] for d in tells], partition[tells]


LONGEST = 40
"""Maximum number of steps of a trace whose transitions are checked."""
RARE = 1e-3
"""Minimum number of visits of a transition for each trace."""
AGAIN = 0.25
"""Factor on the weight of a transition that was already checked with any person."""
KEPT = 0.01
"""Minimum posterior of a person's candidate that is kept for the next person."""
Share = Annotated[float, Range(0, 1, "[)")]
Posterior = tuple[NDArray[np.int64], NDArray[np.float64]]
"""Candidates (bitmasks), and the probability of each."""


def transitions_of(hypotheses: Hypotheses, setting: Setting) -> NDArray[np.int64]:
    """Returns [T, 3] the state, action and next state of each transition of the hypotheses.

    Raises:
        InputError: the hypotheses are about another task.
    """
    reachable = setting.reachable
    if hypotheses.messages != setting.message_names:
        given, known = (", ".join(own) for own in (hypotheses.messages, setting.message_names))
        raise InputError("hypotheses.messages", given, f"must be {known}")
    if hypotheses.features is None:
        if hypotheses.n_transitions != len(reachable):
            raise InputError(
                "hypotheses.labels",
                hypotheses.labels.shape,
                f"features, or the {len(reachable)} transitions that the robot can make",
            )
        return reachable
    features = transition_features(setting.domain, reachable)
    if features.shape == hypotheses.features.shape and (features == hypotheses.features).all():
        return reachable
    rows = places(hypotheses.features, features)
    if (rows < 0).any():
        raise InputError(
            "hypotheses.features",
            hypotheses.features[rows.argmin()],
            f"transitions that the robot can make in {setting.domain.name}",
        )
    return reachable[rows]


@checks("queries")
@dataclass(frozen=True)
class Battery:
    """One list of questions for everybody, chosen by :func:`xplain.questions.designs.battery`.

    Attributes:
        redundancy: minimum number of questions that separate each pair of candidates.
        hypotheses: path of an ``.npz`` file with the hypotheses; None takes the hypotheses of the
            domain.
    """

    redundancy: Count = 2
    hypotheses: str | None = None

    def ask(
        self, setting: Setting, sizes: NDArray[np.int64], answer: Answer, seed: int
    ) -> list[QueryAnswers]:
        """Asks each observer o the first ``sizes[o]`` questions of one list, which has at least
        ``max(sizes)`` questions."""
        known = hypotheses_of(setting.domain, self.hypotheses).drop_indistinguishable()
        chosen, told = battery(
            known, self.redundancy, derive_seed(seed, "queries"), int(sizes.max())
        )
        return ask_in_order(transitions_of(known, setting)[chosen], told, sizes, answer)


@checks("queries")
@dataclass(frozen=True)
class Adaptive:
    """A questionnaire for each observer. A part of an observer's prior comes from other observers.

    Each observer gives a fixed number of labels. Once the observer's incorrect beliefs are known,
    the remaining questions still have maximum information: they confirm the result and find errors
    of the hypotheses.

    Attributes:
        error: expected share of wrong answers; above 0, because people make errors.
        clip: number of consecutive transitions (a clip) in a question.
        misread: share of clips that are misunderstood as a whole.
        none: probability that no hypothesis fits an observer.
        from_others: weight of the other observers' answers in an observer's prior.
        check: share of check questions, once an observer's incorrect beliefs are known. A check
            question gives the messages about all facts of the hypotheses and asks about a frequent
            transition of the robot. The answer 0 means that there are further incorrect beliefs.
        in_turn: True asks one question of each observer in turn, as if all answered at the same
            time; each prior comes from all other observers so far. False asks one observer after
            the other.
        hypotheses: path of an ``.npz`` file with the hypotheses; None takes the hypotheses of the
            domain.
    """

    error: Annotated[float, Range(1e-3, NONE_ERROR, "[)")] = 0.05
    clip: Annotated[int, Range(1, MAX_CLIP)] = 1
    misread: Share = 0.0
    none: Share = 0.01
    from_others: Share = 0.5
    check: Share = 0.5
    in_turn: Literal[False, True] = False
    hypotheses: str | None = None

    def ask(
        self, setting: Setting, sizes: NDArray[np.int64], answer: Answer, seed: int
    ) -> list[QueryAnswers]:
        """Asks each observer o for exactly ``sizes[o]`` labels; the last clip of an observer is
        shortened if necessary."""
        known = hypotheses_of(setting.domain, self.hypotheses).drop_indistinguishable()
        transitions = transitions_of(known, setting)
        checks = _Checks.of(known, transitions, setting, stream(seed, "queries", "checks"))
        blank = Questionnaire(
            *(known, self.error, None, self.clip), none=self.none, misread=self.misread
        )
        asked: dict[int, Questionnaire] = {}
        found: dict[int, Posterior] = {}
        with threadpool_limits(1):  # for small products, threads cost more than they save
            for o, now in self._plan_turns(sizes.tolist()):
                others = [one for other, one in found.items() if other != o]
                before = asked.get(o) or blank.restart(None, derive_seed(seed, "queries", o))
                questions = self._update_prior(before, others)
                left = now
                while left:
                    check = questions.done and checks.rng.random() < self.check
                    which, told = checks.next() if check else questions.next()
                    clip = np.atleast_1d(which)[:left]
                    labels = answer(o, transitions[clip], np.full(len(clip), told))
                    questions.answer(labels, (clip.tolist(), told))
                    left -= len(clip)
                    questions = self._add_candidates(questions, others)
                asked[o], found[o] = questions, _find_likely(questions)
        return [_collect_answers(asked[o], transitions, found[o][0]) for o in range(len(sizes))]

    def _plan_turns(self, sizes: list[int]) -> list[tuple[int, int]]:
        """Returns the turns in order, as pairs (observer, number of labels). ``sizes`` has the
        total number of labels of each observer."""
        if not self.in_turn:
            return list(enumerate(sizes))
        return [
            (o, min(self.clip, size - first))
            for first in range(0, max(sizes), self.clip)
            for o, size in enumerate(sizes)
            if first < size
        ]

    def _update_prior(self, before: Questionnaire, others: list[Posterior]) -> Questionnaire:
        """Returns an observer's questionnaire ``before``, with a prior from the posteriors of
        the other observers so far."""
        listed = before.hypotheses
        if others:
            listed = listed.with_sets(np.concatenate([facts for facts, _ in others]))
        return before.replace_hypotheses(listed, self._compute_prior(listed, others))

    def _compute_prior(self, known: Hypotheses, others: list[Posterior]) -> NDArray[np.float64]:
        """Computes [C] the prior of the candidates before an observer's first question. It is
        the prior of the hypotheses, mixed with the posteriors of the other observers."""
        share = self.from_others if others else 0.0
        asked = np.zeros(len(known.facts))
        for facts, posterior in others:
            asked[known.row(facts)] += posterior
        return (1 - share) * known.prior + share * asked / max(len(others), 1)

    def _add_candidates(self, questions: Questionnaire, others: list[Posterior]) -> Questionnaire:
        """Returns the questionnaire with further candidates, which the answers made likely."""

        def replace_candidates(known: Hypotheses) -> Questionnaire:
            if known is questions.hypotheses:
                return questions
            return questions.replace_hypotheses(known, self._compute_prior(known, others))

        def posterior(known: Hypotheses) -> NDArray[np.float64]:
            found = replace_candidates(known).posterior
            return np.asarray(found / found.sum())

        return replace_candidates(grow(questions.hypotheses, posterior))


@dataclass(frozen=True)
class _Checks:
    """Check questions. With the messages about all facts of the hypotheses, all candidates predict
    the same label of a transition.

    Attributes:
        told: message set about all facts of the hypotheses.
        weight: [T] expected visits of each transition; 0 if the transition is inexplicable with
            these messages. Each check of a transition reduces its weight.
        rng: random generator.
    """

    told: int
    weight: NDArray[np.float64]
    rng: np.random.Generator

    @classmethod
    def of(
        cls,
        known: Hypotheses,
        transitions: NDArray[np.int64],
        setting: Setting,
        rng: np.random.Generator,
    ) -> _Checks:
        model, starts = setting.models[0], setting.domain.starts
        visits = RARE + count_expected_visits(model, starts, setting.reachable, LONGEST)
        weight = visits[places(transitions, setting.reachable)] * known.tables[0, 0]
        return cls(int(np.bitwise_or.reduce(known.facts)), weight, rng)

    def next(self) -> tuple[int, int]:
        """Draws a transition with a probability proportional to its weight. Returns the transition
        and the message set."""
        chosen = int(self.rng.choice(len(self.weight), p=self.weight / self.weight.sum()))
        self.weight[chosen] *= AGAIN
        return chosen, self.told


def _find_likely(questions: Questionnaire) -> Posterior:
    """Returns the candidates with their probabilities, after all answers of an observer. If
    further candidates can be added to the hypotheses, unlikely candidates are left out."""
    known, posterior = questions.hypotheses, questions.posterior / questions.posterior.sum()
    kept = (posterior >= KEPT) | (known.further is None)
    return known.facts[kept], posterior[kept] / posterior[kept].sum()


def _collect_answers(
    questions: Questionnaire, transitions: NDArray[np.int64], likely: NDArray[np.int64]
) -> QueryAnswers:
    """Collects all questions of a questionnaire with their answers, one row for each label."""
    which, told, labels = questions.answers
    found = None if questions.hypotheses.further is None else likely
    return QueryAnswers(transitions[which], told, labels, found)
