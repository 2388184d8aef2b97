"""A condition that asks: its explanation is that of the experiments, and the other conditions do
not change."""

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from tests.people.study.protocol.test_machine import at_evaluation
from tests.people.study.stand_in import ASK, CONFIG, street_plan, street_study
from xplain.errors import InputError
from xplain.explanation.anybody import Open
from xplain.explanation.belief import Independent, Persistent
from xplain.explanation.label_table import LabelTable, join_steps
from xplain.interaction.episode import explain
from xplain.interaction.explainees import Exact, Slips
from xplain.people.study.flow import Study
from xplain.people.study.prepare import conditions_of
from xplain.solvers.base import CachedPolicy
from xplain.solvers.greedy import QMDP


@pytest.fixture(scope="module")
def asking() -> Study:
    return street_study(ask=ASK)


def with_belief(study: Study, update: Persistent | Independent | None) -> Study:
    """Returns the study with this belief about people; None keeps its own."""
    if update is None:
        return study
    problem = update.people(study.plan.problem, None, None)
    plan = replace(study.plan, problem=problem)
    policies = {"asking": CachedPolicy(QMDP().plan(problem))}
    return replace(study, plan=plan, policies=policies, belief=update)


UPDATES = [None, Persistent(), Persistent(0.1), Independent("learned"), Open("learned")]


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("slips", [0.0, 0.3])
def test_people_are_asked_what_the_offline_experiment_asks(
    asking: Study, update: Persistent | Independent | None, slips: float
) -> None:
    """Questions, messages and beliefs are equal to the last bit, also for people who err."""
    study = with_belief(asking, update)
    plan, people, met = study.plan, Slips(slips) if slips else Exact(), set()
    assert plan.clip_labels is not None
    same = np.array([*range(4), *range(4)])  # the clips are the trace's own steps
    for seed, user_type in product(range(6), range(3)):
        of_trace = LabelTable.dense(plan.true_labels[[user_type]])
        labels = join_steps([of_trace, plan.clip_labels.of_types([user_type])])
        offline_person, person = (people.meet(labels, same, seed) for _ in range(2))
        offline = explain(plan.problem, study.policies["asking"], offline_person, study.belief)
        state, pages = at_evaluation(study, user_type, "asking"), []
        while state.stage in ("asking", "evaluation"):
            if state.stage == "asking":
                question = state.asked[-1].question
                label = person.answer(plan.n_steps + question, state.given)  # type: ignore[attr-defined]
                pages.append((state.step, question, label))
                state = study.advance(state, "clip", {"label": label})
            else:
                assert state.new == offline.messages[state.step]
                answers = person.react(state.given, state.step + 1).answers.tolist()
                step, state = state.step, study.advance(state, "labels", {"labels": answers})
                assert list(state.after) == offline.beliefs[step + 1].tolist()
        assert pages == [tuple(one) for one in offline.questions.tolist()]
        assert [(one.step, one.question, one.answer) for one in state.asked] == pages
        # Each question goes on from where the one before it led, and was worth its price.
        for one, other in zip(state.asked, state.asked[1:], strict=False):
            assert one.step != other.step or one.after == other.before
        assert all(one.worth is not None and one.worth > 0 for one in state.asked)
        met |= {one.question for one in state.asked}
    assert len(met) > 1


@pytest.mark.parametrize("condition", ["personalized", "conformant"])
def test_the_other_conditions_are_as_they_were_to_the_last_bit(
    study: Study, asking: Study, condition: str
) -> None:
    for number, user_type in product(range(5), range(3)):
        rng = np.random.default_rng(number)
        states = [at_evaluation(one, user_type, condition) for one in (study, asking)]
        while states[0].stage == "evaluation":
            assert states[0].text == states[1].text
            payload = {"labels": rng.integers(2, size=states[0].step + 1).tolist()}
            both = zip((study, asking), states, strict=True)
            states = [one.advance(state, "labels", payload) for one, state in both]
        assert states[0].text == states[1].text


@pytest.mark.parametrize(
    ("when", "most", "cost", "error"),
    [("first", 10, 0.01, 0), ("anytime", 1, 0.01, 0), ("anytime", 10, 0.15, 0.3)],
)
def test_questions_keep_to_their_limits(when: str, most: int, cost: float, error: float) -> None:
    """People answer at random; some get questions between later steps, too."""
    ask = ASK | {"when": when, "most": most, "cost": cost}
    study = street_study(ask=ask, belief=CONFIG["belief"] | {"error": error})
    asked = later = 0
    for number, user_type in product(range(8), range(3)):
        rng, state = np.random.default_rng(number), at_evaluation(study, user_type, "asking")
        while state.stage in ("asking", "evaluation"):
            kind, labels = study.waits_for(state), rng.integers(2, size=state.step + 1).tolist()
            if state.stage == "asking":
                assert state.new == 0  # nothing on a question's page is new
                later += state.step > 0
            payload = {"label": labels[0]} if kind == "clip" else {"labels": labels}
            state = study.advance(state, kind, payload)
        questions = [one.question for one in state.asked]
        assert len(questions) == len({*questions}) <= most
        assert when == "anytime" or all((one.step, one.told) == (0, 0) for one in state.asked)
        asked += len(questions)
    assert asked
    assert (later > 0) == (error > 0)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"ask": ASK | {"kinds": ["beliefs"]}}, r"ask\.kinds=\['beliefs'\]: clips in a study"),
        ({"ask": ASK | {"kinds": ["clips", "beliefs"]}}, r"ask\.kinds=.*: clips in a study"),
        ({"ask": ASK | {"cost": -1}}, r"ask\.cost=-1"),
        ({"ask": ASK | {"when": "later"}}, r"ask\.when='later'"),
        ({"ask": ASK | {"clips": 0}}, r"ask\.clips=0"),
        ({"conditions": {"asking": {}}}, r"conditions\.asking='set': only with ask=clips"),
        (
            {"ask": ASK, "conditions": {"conformant": {}}},
            r"conditions\.asking=None: a condition of this name, or personal",
        ),
    ],
)
def test_what_cannot_be_asked_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        conditions_of(CONFIG | changes)


def test_conditions_may_differ_by_questions_alone_and_have_to() -> None:
    """If questions are too expensive, the third condition equals the first."""
    assert Study.of(street_plan(ask=ASK)).difference() >= 1
    assert Study.of(street_plan(ask=ASK | {"cost": 9.0})).difference() == 0
