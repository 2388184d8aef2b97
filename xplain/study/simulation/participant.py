"""Simulated participants: they read sentences, forget some, err now and then, and take their time.

A :class:`Person` knows the plan's table of true labels, but only uses what the pages told them.
The same person takes part in the bare protocol, over HTTP, and in a real browser.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from xplain.errors import InputError
from xplain.message_sets import indices
from xplain.participants.simulation.http_client import Page
from xplain.study.protocol import machine
from xplain.study.protocol.plan import Study, StudyPlan


@dataclass(frozen=True)
class Habits:
    """Assumptions about participants. None is measured: the power curves show what each does.

    Attributes:
        label_noise: probability that a fresh judgement of a step is the wrong way round.
        forgetting: probability that a message is not taken in.
        overload: added to it for each other message on the page that was told before or at once.
        fading: probability that a fact that was taken in is gone at the quiz.
        page_seconds: to take in an evaluation page and press the button.
        message_seconds: to read a message; half as long for a known one.
        label_seconds: to judge a step; a tenth of it for a step that needs no new judgement.
        spread: σ of the lognormal of each of these times, and of the person's pace.
        mistake: probability of a wrong answer in practice and eligibility test.
        leaving: probability of leaving at each page.
    """

    label_noise: float = 0.03
    forgetting: float = 0.05
    overload: float = 0.03
    fading: float = 0.1
    page_seconds: float = 4.0
    message_seconds: float = 5.0
    label_seconds: float = 4.0
    spread: float = 0.35
    mistake: float = 0.02
    leaving: float = 0.0

    def __post_init__(self) -> None:
        """Raises InputError: no probability, or no time."""
        for key in ("label_noise", "forgetting", "overload", "fading", "mistake", "leaving"):
            if not 0 <= getattr(self, key) <= 1:
                raise InputError(f"habits.{key}", getattr(self, key), "a probability")
        for key in ("page_seconds", "message_seconds", "label_seconds", "spread"):
            if not getattr(self, key) >= 0:
                raise InputError(f"habits.{key}", getattr(self, key), "a number ≥ 0")


class Person:
    """One simulated participant.

    Args:
        plan: for the sentences and the true labels.
        habits: how they behave.
        rng: their stream.
    """

    def __init__(self, plan: StudyPlan, habits: Habits, rng: np.random.Generator) -> None:
        self.plan, self.habits, self.rng = plan, habits, rng
        # As they are, until a briefing tells them what to know.
        self.user_type = int(rng.integers(len(plan.kinds))) if plan.kinds else 0
        self.known = 0
        self._heard: set[str] = set()
        self._judged: int | None = None
        self._labels: list[int] = []
        self._pace = self._spread()

    def _chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def _spread(self) -> float:
        sigma = self.habits.spread
        return float(self.rng.lognormal(-(sigma**2) / 2, sigma))

    def leaves(self) -> bool:
        """Whether this page is where they drop out."""
        return self._chance(self.habits.leaving)

    def asked(self) -> dict[str, str]:
        """What they answer before the briefing: what is right, else the first that is allowed, to
        questions that need an answer."""
        answers = {}
        for q in self.plan.before:
            first = q.options[0] if q.options else str(q.low) if q.kind == "number" else "–"
            if q.needed:
                answers[q.name] = q.right or first
        return answers

    def briefed(self, sentences: Sequence[str]) -> None:
        """Takes over what the briefing says, if anything."""
        if not sentences:
            return
        told = [role.briefing for role in self.plan.roles]
        self.user_type = told.index(tuple(sentences))

    def practises(self, part: int) -> int:
        """The label of the practice step."""
        return part ^ self._chance(self.habits.mistake)

    def checked(self, questions: Sequence[Sequence[str]]) -> list[int]:
        """Answers of the eligibility test, in the plan's order of the questions.

        Args:
            questions: the options of each.
        """
        right = [q.answer for q in self.plan.roles[self.user_type].eligibility]
        return [
            (answer + self._chance(self.habits.mistake)) % len(options)
            for answer, options in zip(right, questions, strict=True)
        ]

    def labels(self, count: int, messages: Sequence[str]) -> tuple[list[int], float]:
        """Labels of the first ``count`` steps with these messages on the page, and the seconds
        that it took."""
        habits, new = self.habits, [m for m in messages if m not in self._heard]
        for sentence in new:
            others = len(messages) - 1
            if not self._chance(min(1.0, habits.forgetting + habits.overload * others)):
                j = [fact.message for fact in self.plan.facts].index(sentence)
                self.known |= 1 << j
            self._heard.add(sentence)
        fresh = range(count) if self.known != self._judged else range(len(self._labels), count)
        truth = self.plan.true_labels[self.user_type, :, self.known]
        kept = self._labels
        self._labels = [
            int(truth[i]) ^ self._chance(habits.label_noise) if i in fresh else kept[i]
            for i in range(count)
        ]
        self._judged = self.known
        seconds = habits.page_seconds * self._spread()
        seconds += habits.message_seconds * (
            sum(self._spread() for _ in new) + (len(messages) - len(new)) / 2 * 0.1
        )
        seconds += habits.label_seconds * sum(
            self._spread() if i in fresh else 0.1 for i in range(count)
        )
        return list(self._labels), seconds * self._pace

    def quiz(self, sentences: Sequence[str]) -> list[int]:
        """The statements that they hold true, as positions."""
        wrong = self.plan.wrong[self.user_type]
        for j in indices(self.known):
            if j in wrong and self._chance(self.habits.fading):
                self.known &= ~(1 << j)
        true = {
            fact.belief if j in wrong and not self.known >> j & 1 else fact.message
            for j, fact in enumerate(self.plan.facts)
        } | {known.right for known in self.plan.known}
        return [
            i
            for i, sentence in enumerate(sentences)
            if (sentence in true) ^ self._chance(self.habits.label_noise)
        ]

    def fill(self, page: Page) -> tuple[list[tuple[str, str]], float]:
        """The fields that they fill in on a page, and how long it took them, in seconds."""
        groups = page.groups()
        if page.stage == "consent":
            return [("agree", "1")], 0.0
        if page.stage == "before":
            return list(self.asked().items()), 0.0
        if page.stage == "briefing":
            self.briefed(page.facts)
        elif page.stage == "training":
            return [("label", str(self.practises(len(page.messages))))], 0.0
        elif page.stage == "eligibility":
            names = sorted(groups, key=lambda name: int(name[1:]))
            answers = self.checked([[c.text for c in groups[name]] for name in names])
            pairs = zip(names, answers, strict=True)
            return [(name, groups[name][answer].value) for name, answer in pairs], 0.0
        elif page.stage == "evaluation":
            labels, seconds = self.labels(len(groups), page.messages)
            return [(f"label_{i}", str(label)) for i, label in enumerate(labels)], seconds
        elif page.stage == "quiz":
            statements = groups["true"]
            ticked = self.quiz([choice.text for choice in statements])
            return [("true", statements[i].value) for i in ticked], 0.0
        return [], 0.0


@dataclass(frozen=True)
class Measures:
    """The paper's three measures of one participant."""

    seconds: float
    inexplicable: int
    score: int
    messages: int


def take_part(
    study: Study, user_type: int, condition: str, habits: Habits, rng: np.random.Generator
) -> Measures | None:
    """One simulated participant in the bare protocol; None if they did not get to the end."""
    plan = study.plan
    person = Person(plan, habits, rng)
    role = plan.roles[user_type]
    person.briefed(role.briefing)
    state = machine.State(
        stage="training",
        part=1,
        user_type=user_type,
        condition=condition,
        orders={"quiz": tuple(range(len(role.quiz))), "eligibility": ()},
    )
    state = machine.advance(study, state, "example", {"label": 1}).state
    questions = [question.options for question in role.eligibility]
    while state.stage in ("eligibility", "briefing"):
        kind: str = "read"
        payload: dict[str, object] = {}
        if state.stage == "eligibility":
            kind, payload = "eligibility", {"answers": person.checked(questions)}
        state = machine.advance(study, state, kind, payload).state
    seconds = 0.0
    while state.stage == "evaluation":
        if person.leaves():
            return None
        on_page = [plan.facts[j].message for j in indices(state.given)]
        labels, took = person.labels(state.step + 1, on_page)
        seconds += took
        state = machine.advance(study, state, "labels", {"labels": labels}).state
    if state.stage != "quiz":
        return None
    sentences = [statement.text for statement in role.quiz]
    after = machine.advance(study, state, "quiz", {"chosen": person.quiz(sentences)}).state
    assert after.score is not None, "a quiz has a score"
    return Measures(seconds, state.labels.count(0), after.score, state.given.bit_count())
