"""Chooses questions for one person, and computes what the answers show about them.

    Hypotheses ── Questionnaire ── next() / answer(label) ── … ── done, posterior

Three things about the person are unknown: the facts that the person believes incorrectly; the
inaccurate values that the person believes instead (a variant of the hypotheses); and whether any
hypothesis fits. Each question has the largest expected information about all three. This
information is the mutual information under the current posterior (Lindley 1956; adaptive design
optimisation; computerised adaptive tests). The variant is included, because labels depend on it and
explanations depend on the labels: docs/what-to-ask.md.
"""

from __future__ import annotations

import copy
import json
import zlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.domains.users.hypotheses import Hypotheses, prior_over
from xplain.errors import InputError, Range, number, whole_number
from xplain.questions.matrix import Posterior, QuestionMatrix
from xplain.randomness import stream

NONE_ERROR = 1 / 3
"""A person whom no hypothesis fits is assumed to give the answer of the best hypothesis in two of
three cases. This represents people who disagree with all hypotheses more often than errors
explain."""
MAX_CLIP = 10
NEAR = 256
"""Number of questions whose P(label 1) is nearest to ½; slips and guesses decide which of these is
asked."""
STARTS = 16
"""Number of most informative questions from which clips grow."""
CHOSEN = ("error", "prior", "clip", "seed", "stop", "none", "misread", "slip", "guess", "told",
          "repeats")  # fmt: skip
"""Options of a questionnaire in its JSON, besides its questions and answers."""

Question = tuple[int, int] | tuple[list[int], int]
"""Transition (for clips: consecutive transitions) and message set (bitmask)."""


@dataclass(frozen=True)
class AnsweredQuestion:
    """A question with its answer: ``transitions`` with one message set, and one label for each
    transition."""

    transitions: tuple[int, ...]
    message_set: int
    labels: tuple[int, ...]


class Questionnaire:
    r"""A questionnaire that finds out what one person believes incorrectly.

    The model of the answers: a person who believes the facts R incorrectly and receives the
    messages H still believes R \ H incorrectly. The person labels a transition as the hypotheses
    predict for R \ H. Each answer is flipped with probability ``error``, independently. With
    probability ``misread``, all labels of a clip (a question about several transitions) are random
    instead. :data:`NONE_ERROR` describes a person whom no hypothesis fits.

    Args:
        hypotheses: the candidates R; or a table [2^n, T] of their labels 0 and 1.
        error: probability of a wrong label, in [0, ⅓).
        prior: [C] prior of the candidates; None: the prior of the hypotheses, or a uniform prior
            for a table.
        clip: number of transitions in a question. If the hypotheses have start and end states of
            transitions, the transitions of a clip follow each other; otherwise they are arbitrary.
        seed: breaks ties between questions.
        stop: the questionnaire is done if one class of candidates that behave alike has a posterior
            above this number.
        none: prior probability that no hypothesis fits.
        misread: probability that a clip is misread.
        slip, guess: [T] or one number, known P(0 | label 1) and P(1 | label 0) of each transition;
            ``error`` is then the person's own additional error. None: no slips or guesses. If slips
            or guesses are given, each question is about one transition.
        told: True if messages may be given before a question; False asks about transitions without
            messages, as items of an adaptive test.
        repeats: maximum number of times that a question without messages is asked.

    Raises:
        InputError: a value is not allowed, or no question separates any candidates.
        TooLargeError: too many candidates.
    """

    def __init__(
        self,
        hypotheses: Hypotheses | ArrayLike,
        error: float = 0.05,
        prior: ArrayLike | None = None,
        clip: int = 1,
        seed: int = 0,
        stop: float = 0.95,
        *,
        none: float = 0.01,
        misread: float = 0.0,
        slip: ArrayLike | None = None,
        guess: ArrayLike | None = None,
        told: bool = True,
        repeats: int = 1,
    ) -> None:
        known = hypotheses if isinstance(hypotheses, Hypotheses) else Hypotheses.of(hypotheses)
        self.hypotheses = known
        self.error = number("error", error, Range(0, NONE_ERROR, "[)"))
        self.none_prior = number("none", none, Range(0, 1, "[)"))
        self.misread = number("misread", misread, Range(0, 1, "[)"))
        self.stop = number("stop", stop, Range(0, 1, "[)"))
        self.seed = whole_number("seed", seed, 0)
        self.clip = whole_number("clip", clip, 1, MAX_CLIP)
        self.rates = _read_rates(slip, guess, known.n_transitions)
        self.told, self.repeats = bool(told), whole_number("repeats", repeats, 1)
        if self.clip > 1 and (self.rates is not None or not self.told):
            raise InputError("clip", clip, "1, if slips or guesses are given or told is False")
        self._reset(prior)

    def restart(self, prior: ArrayLike | None, seed: int) -> Questionnaire:
        """Returns a questionnaire without answers for another person, with the same hypotheses and
        errors. Both questionnaires share all computations on the hypotheses.

        Args:
            prior, seed: see the class.

        Raises:
            InputError: a value is not allowed.
        """
        # This computes the questions once, for all copies.
        assert len(self._questions.facts), "some question separates candidates"
        made = copy.copy(self)
        made.seed = whole_number("seed", seed, 0)
        made._reset(prior)
        return made

    def replace_hypotheses(self, hypotheses: Hypotheses, prior: ArrayLike | None) -> Questionnaire:
        """Returns a questionnaire with the same questions and answers, but with other candidates or
        another prior.

        Args:
            hypotheses: the other candidates, with the same transitions and messages.
            prior: [C] prior of the candidates; None: the prior of ``hypotheses``.
        """
        made = copy.copy(self)
        if hypotheses is not self.hypotheses:
            made.hypotheses = hypotheses
            made.__dict__.pop("_questions", None)  # belongs to the old candidates
        made._reset(prior)
        for one in self.asked:
            made._add_answer(one)
        return made

    def _reset(self, prior: ArrayLike | None) -> None:
        """Resets to the state before the first question."""
        known = self.hypotheses
        self.given_prior = prior
        start = known.prior if prior is None else prior_over(prior, len(known.facts), "prior")
        self.asked: list[AnsweredQuestion] = []
        self._pending: Question | None = None
        # log P(answers, layer, R): [2 + V, C]; the layers are the variants, and "none fits".
        share = np.append((1 - self.none_prior) * known.variant_prior, self.none_prior)
        self._error = np.append(np.full(len(share) - 1, self.error), NONE_ERROR)
        with np.errstate(divide="ignore"):
            self._log_joint = np.log(share)[:, None] + np.log(start)
        self._update_weights()

    def next(self) -> Question:
        """Returns the most informative question, as (transition, message set); with ``clip`` > 1,
        as (list of transitions, message set). The question stays the same until it is answered."""
        if self._pending is None:
            if not self.told:
                self._pending = self._posterior.best_of(
                    self._list_open_questions(), self._make_rng()
                )
            elif self.rates is not None:
                self._pending = self._posterior.best_near_even(
                    self._questions, NEAR, self._make_rng()
                )
            elif self.clip == 1:
                self._pending = self.alternatives(1)[0]
            else:
                rng = stream(self.seed, "questionnaire", "clip", len(self.asked))
                self._pending = self._posterior.best_clip(self.alternatives(STARTS), self.clip, rng)
        return self._pending

    def alternatives(self, count: int) -> list[tuple[int, int]]:
        """Returns the ``count`` most informative questions about one transition, best first."""
        return self._posterior.best_questions(self._questions, count, self._seen, self._make_rng())

    def _list_open_questions(self) -> list[tuple[int, int]]:
        """Returns the questions without messages that were asked less than ``repeats`` times.

        Raises:
            InputError: there is no such question.
        """
        times = np.bincount(self._seen, minlength=self.hypotheses.n_transitions)
        left = np.flatnonzero(times < self.repeats)
        if not len(left):
            raise InputError("repeats", self.repeats, "more: every question was asked")
        return [(t, 0) for t in left.tolist()]

    @property
    def _seen(self) -> list[int]:
        return [transition for one in self.asked for transition in one.transitions]

    def _make_rng(self) -> np.random.Generator:
        return stream(self.seed, "questionnaire", len(self.asked))

    def answer(self, label: ArrayLike, question: Question | None = None) -> None:
        """Adds the answer to the last question, or to a question of your own.

        Args:
            label: 0 or 1; for a clip a list, one for each transition.
            question: (transition or transitions, message set); None: the last question of
                :meth:`next`.

        Raises:
            InputError: no question was asked, a wrong number of labels, a label other than 0 and 1,
                an unknown transition or message set.
        """
        about = question if question is not None else self._pending
        if about is None:
            raise InputError("answer", label, "an answer to a question: call next() before")
        transitions, told = self._check_question(about)
        labels = np.atleast_1d(np.asarray(label, dtype=object))
        if labels.shape != transitions.shape:
            raise InputError("answer", label, f"{len(transitions)} labels, one a transition")
        for one in labels.tolist():
            if isinstance(one, float) or one not in (0, 1):
                raise InputError("answer", one, "a label, 0 or 1")
        self._add_answer(
            AnsweredQuestion(tuple(transitions.tolist()), told, tuple(int(one) for one in labels))
        )
        self._pending = None

    @property
    def posterior(self) -> NDArray[np.float64]:
        """[C] P(candidate | answers). The sum of all C values and of :attr:`none` is 1."""
        return np.asarray(self._weight[:-1].sum(axis=0))

    @property
    def none(self) -> float:
        """P(no hypothesis fits | answers)."""
        return float(self._weight[-1].sum())

    @property
    def answers(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8]]:
        """[P] transitions, [P] message sets and [P] labels of all answers so far; a clip counts
        as several answers."""
        told = [one.message_set for one in self.asked for _ in one.transitions]
        labels = [label for one in self.asked for label in one.labels]
        return np.array(self._seen, np.int64), np.array(told, np.int64), np.array(labels, np.uint8)

    @property
    def classes(self) -> NDArray[np.float64]:
        """[classes] posterior of each class of candidates that behave alike, in the order of
        ``hypotheses.classes``."""
        return np.asarray(np.bincount(self.hypotheses.classes, self.posterior), np.float64)

    @property
    def best(self) -> int:
        """Bitmask of the facts that the most likely class of candidates believes incorrectly,
        without facts that no question reveals."""
        return int(self.hypotheses.essential[self.hypotheses.classes == self.classes.argmax()][0])

    @property
    def done(self) -> bool:
        """True if one class of candidates has a posterior above ``stop``."""
        return bool(self.classes.max() > self.stop)

    def to_json(self) -> str:
        """Writes the questionnaire as a text in JSON, without the table of the hypotheses."""
        prior = None if self.given_prior is None else np.asarray(self.given_prior).tolist()
        return json.dumps(
            {
                "hypotheses": _compute_digest(self.hypotheses),
                "error": self.error,
                "prior": prior,
                "clip": self.clip,
                "seed": self.seed,
                "stop": self.stop,
                "none": self.none_prior,
                "misread": self.misread,
                "slip": None if self.rates is None else self.rates[0].tolist(),
                "guess": None if self.rates is None else self.rates[1].tolist(),
                "told": self.told,
                "repeats": self.repeats,
                "asked": [[one.transitions, one.message_set, one.labels] for one in self.asked],
            }
        )

    @classmethod
    def from_json(cls, text: str, hypotheses: Hypotheses | ArrayLike) -> Questionnaire:
        """Restores a questionnaire from the text of :meth:`to_json`; its next questions are the
        same.

        Raises:
            InputError: an invalid text, other hypotheses, or invalid answers.
        """
        try:
            state = json.loads(text)
            digest, chosen = state["hypotheses"], {key: state[key] for key in CHOSEN}
            asked = [(list(t), int(told), list(labels)) for t, told, labels in state["asked"]]
        except (ValueError, KeyError, TypeError, IndexError) as error:
            raise InputError(
                "questionnaire", text, f"JSON of Questionnaire.to_json ({error!r})"
            ) from None
        made = cls(hypotheses, **chosen)
        if digest != _compute_digest(made.hypotheses):
            raise InputError("questionnaire.hypotheses", digest, "asked with other hypotheses")
        for transitions, told, labels in asked:
            made.answer(labels, (transitions, told))
        return made

    def information(self, question: Question) -> float:
        """Computes the mutual information, in bits, between the answer and three unknowns: the
        variant, the candidate, and whether any hypothesis fits. :meth:`next` maximises this
        information. For a clip it is the sum over the single transitions."""
        return float(self._posterior.gains(*self._check_question(question)).sum())

    def _add_answer(self, one: AnsweredQuestion) -> None:
        likelihood = self._posterior.likelihood(one.transitions, one.message_set, one.labels)
        with np.errstate(divide="ignore"):
            answer = np.log(likelihood)
        # New arrays, because copies share the old ones.
        self._log_joint = self._log_joint + answer
        self.asked = [*self.asked, one]
        self._update_weights()

    def _update_weights(self) -> None:
        top = self._log_joint.max()
        if top == -np.inf:
            raise InputError(
                "answer", self.asked[-1].labels, "possible under some hypothesis: set error > 0"
            )
        weight = np.exp(self._log_joint - top)
        self._weight = weight / weight.sum()

    @property
    def _posterior(self) -> Posterior:
        return Posterior(self.hypotheses, self._weight, self._error, self.misread, self.rates)

    @cached_property
    def _questions(self) -> QuestionMatrix:
        return QuestionMatrix.of(self.hypotheses)

    def _check_question(self, question: Any) -> tuple[NDArray[np.int64], int]:
        known = self.hypotheses
        try:
            asked, told = question
            each, told = np.atleast_1d(asked).tolist(), np.asarray(told).item()
        except (TypeError, ValueError):
            raise InputError("question", question, "(transition or list, message set)") from None
        if not 1 <= len(each) <= MAX_CLIP:
            raise InputError("question", len(each), f"1 … {MAX_CLIP} transitions")
        last, every = known.n_transitions - 1, (1 << known.n_messages) - 1
        transitions = [whole_number("question.transition", t, 0, last) for t in each]
        return np.array(transitions), whole_number("question.messages", told, 0, every)


def _read_rates(
    slip: ArrayLike | None, guess: ArrayLike | None, transitions: int
) -> NDArray[np.float64] | None:
    """Returns the slips and guesses as [2, T] probabilities; None if neither is given.

    Raises:
        InputError: a value is no probability, or slip + guess ≥ 1.
    """
    if slip is None and guess is None:
        return None
    given = [0.0 if one is None else one for one in (slip, guess)]
    try:
        rates = np.stack([np.broadcast_to(np.asarray(one, float), transitions) for one in given])
        sound = bool((rates >= 0).all() and (rates.sum(axis=0) < 1).all())
    except (TypeError, ValueError):
        sound = False
    if not sound:
        allowed = f"{transitions} probabilities each, or one; slip + guess < 1"
        raise InputError("slip and guess", given, allowed)
    return rates


def _compute_digest(hypotheses: Hypotheses) -> int:
    """Computes a digest that distinguishes tables of labels."""
    return zlib.crc32(hypotheses.tables.tobytes() + hypotheses.facts.tobytes())
