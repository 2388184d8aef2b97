"""Simulated participants take in what is said, also again, and may lose it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from tests.people.study.stand_in import FAULTLESS
from xplain.people.study.bot import StudyBot


def test_a_message_that_was_missed_is_taken_in_when_it_is_said_again(
    person: Callable[..., StudyBot],
) -> None:
    someone = person(habits=replace(FAULTLESS, forgetting=1))
    (wrong, *_) = someone.plan.wrong[someone.user_type]
    sentence = someone.plan.facts[wrong].message
    someone.labels(1, 1, [sentence])
    assert someone.known == 0
    someone.habits = FAULTLESS
    someone.labels(2, 1, [])  # it stands on the page, and nobody says it
    assert someone.known == 0
    someone.labels(3, 1, [sentence])
    assert someone.known == 1 << wrong


def test_what_is_lost_after_a_step_counts_at_the_next(person: Callable[..., StudyBot]) -> None:
    someone = person(habits=replace(FAULTLESS, losing=1))
    truth = someone.plan.true_labels[someone.user_type]
    count = someone.plan.n_steps
    facts = [fact.message for fact in someone.plan.facts]
    right, _ = someone.labels(count, len(facts), facts)
    assert right == truth[:, -1].tolist()
    assert not any(someone.known >> j & 1 for j in someone.plan.wrong[someone.user_type])
    forgotten, _ = someone.labels(count, len(facts), [])
    assert forgotten == truth[:, 0].tolist() != right
