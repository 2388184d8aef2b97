"""Briefings and tests follow from the domain's sentences."""

from collections.abc import Callable

import numpy as np
from omegaconf import OmegaConf

from tests.people.study.stand_in import TYPES
from xplain.experiment.config import compose_config
from xplain.people.material import reword_parameters
from xplain.people.study import prepare as content
from xplain.people.study.flow import Study
from xplain.people.study.plan import StudyPlan


def test_needed_messages_are_smallest(study: Study) -> None:
    plan = study.plan
    for labels in plan.true_labels:
        mask = content.find_needed(labels)
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


def test_no_word_of_the_quiz_gives_the_answers_away() -> None:
    """People who answer by a word of the sentences, or by good and bad news, are right half of the
    time. On the rescue task, all facts are good news."""
    from hydra.utils import instantiate

    cfg = compose_config("study", ["seed=0"])
    domain = instantiate(cfg.domain)
    types = instantiate(cfg.users).types(domain, np.random.default_rng(0))
    wording = OmegaConf.to_container(cfg.wording, resolve=True)
    parameters = reword_parameters(domain.parameters, wording["facts"], lambda text: text)
    # As on the study's trace, every type has to have both of its facts corrected.
    labels = np.zeros((5, 1, 64), dtype=np.uint8)
    for t, user_type in enumerate(types):
        wrong = sum(1 << j for j, p in enumerate(parameters) if p.name in user_type.inaccurate)
        labels[t, 0] = (np.arange(64) & wrong) == wrong
    roles = content.roles_of(parameters, types, labels, wording)

    def score(ticks: Callable[[str], bool]) -> list[int]:
        return [sum(ticks(s.text) == s.true for s in role.quiz) for role in roles]

    assert score(lambda text: True) == score(lambda text: False) == [2] * 5
    assert score(lambda text: "penalty of" not in text) == [2] * 5
    words = {word for role in roles for s in role.quiz for word in s.text.lower().split()}
    for word in words:
        scores = score(lambda text, word=word: word in text.lower().split())  # type: ignore[misc]
        # A word that only a true sentence contains reveals this sentence; four need knowledge.
        assert max(scores) <= 3, word
        assert min(scores) >= 1, word
        assert 1.4 <= np.mean(scores) <= 2.6, word
    good = ("gains", "nothing", "as much", "go on")
    assert score(lambda text: any(word in text for word in good)) != [4] * 5
    # Both polarities are asked of the facts themselves: one is put rightly, one wrongly.
    for role in roles:
        names = {parameters[j].name for j in role.wrong}
        assert sorted(s.true for s in role.quiz if s.fact in names) == [False, True]


def _of(plan: StudyPlan, name: str) -> int:
    return [fact.name for fact in plan.facts].index(name)
