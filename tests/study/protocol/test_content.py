"""What participants are told and asked follows from the domain's sentences."""

from __future__ import annotations

from tests.study.stand_in import TYPES
from xplain.study.protocol import content
from xplain.study.protocol.plan import Study, StudyPlan


def test_needed_messages_are_smallest(study: Study) -> None:
    plan = study.plan
    for labels in plan.true_labels:
        mask = content.needed(labels)
        assert labels[:, mask].all()
        smaller = [m for m in range(16) if m.bit_count() < mask.bit_count()]
        assert not any(labels[:, m].all() for m in smaller)


def test_roles_follow_from_the_sentences(study: Study) -> None:
    plan = study.plan
    for role, kind in zip(plan.roles, TYPES, strict=True):
        assert {plan.facts[j].name for j in role.wrong} == set(kind.inaccurate)
    for role in plan.roles:
        for j, (fact, told) in enumerate(zip(plan.facts, role.briefing, strict=True)):
            assert told == (fact.belief if j in role.wrong else fact.message)
        assert len({s.fact for s in role.quiz}) == 4
        assert {plan.facts[j].name for j in role.wrong} <= {s.fact for s in role.quiz}
        for about in (role.wrong, {j for j in range(4) if j not in role.wrong}):
            names = {plan.facts[j].name for j in about}
            assert [s.true for s in role.quiz if s.fact in names] == [True, False]
        for s in role.quiz:
            fact = plan.facts[_of(plan, s.fact)]
            assert s.text == (fact.message if s.true else fact.belief)
    # A reward with a phrase gets the paper's question; what is no number gets the sentences.
    assert plan.roles[0].eligibility[0].options == ("0 points or more", "less than 0 points")
    assert plan.roles[0].eligibility[0].answer == 1
    assert plan.roles[2].eligibility[0].answer == 0
    assert set(plan.roles[0].eligibility[3].options) == {
        plan.facts[3].message,
        plan.facts[3].belief,
    }


def _of(plan: StudyPlan, name: str) -> int:
    return [fact.name for fact in plan.facts].index(name)
