"""The protocol without a server: accepted answers, hidden values, and the policies' decisions."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from tests.people.bare_flow import take_part
from tests.people.study.stand_in import FAULTLESS, SCREENS, street_study
from xplain.errors import Refused
from xplain.explanation.anybody import Open
from xplain.explanation.belief import Independent, Persistent
from xplain.explanation.label_table import LabelTable
from xplain.interaction.episode import explain
from xplain.interaction.explainees import Exact, Heedless, SimulatedUser
from xplain.people.flow import CANNOT_TELL
from xplain.people.study.bot import StudyBot
from xplain.people.study.flow import Study, StudyState
from xplain.solvers.base import CachedPolicy
from xplain.solvers.greedy import QMDP

ORDERS = {"eligibility": (2, 0, 1, 3), "quiz": (3, 2, 1, 0)}


def at_evaluation(study: Study, user_type: int, condition: str) -> StudyState:
    slot = {"position": 0, "user_type": user_type, "condition": condition, "orders": ORDERS}
    text = study.plan.texts.consent_hash
    right = [q.answer for q in study.plan.roles[user_type].eligibility]
    state = StudyState()
    for kind, payload in (
        ("consent", {"agree": 1, "text": text, **slot}),
        *[("read", {})] * SCREENS,
        ("example", {"label": 0}),
        ("example", {"label": 1}),
        ("ahead", {"label": 1}),
        ("eligibility", {"answers": right}),
    ):
        assert (state.given, state.new, state.heard) == (0, 0, ())  # nothing was told yet
        state = study.advance(state, kind, payload)
    return state


def evaluated(study: Study, user_type: int, condition: str) -> Iterator[StudyState]:
    """Yields each step of the evaluation of a person who never errs, and the state after it."""
    state = at_evaluation(study, user_type, condition)
    while state.stage == "evaluation":
        yield state
        labels = study.plan.true_labels[user_type, : state.step + 1, state.given].tolist()
        state = study.advance(state, "labels", {"labels": labels})
    yield state


@pytest.mark.parametrize("condition", ["personalized", "conformant"])
@pytest.mark.parametrize("user_type", range(3))
def test_participants_meet_what_the_offline_experiment_computes(
    study: Study, user_type: int, condition: str
) -> None:
    plan = study.plan
    user = SimulatedUser.of(plan.true_labels[user_type])
    offline = explain(plan.problem, study.policies[condition], user, study.belief)
    *steps, state = evaluated(study, user_type, condition)
    assert [step.step for step in steps] == list(range(plan.n_steps))
    assert [step.new for step in steps] == offline.messages.tolist()
    assert [step.belief for step in steps] == [tuple(b.tolist()) for b in offline.beliefs[:-1]]
    assert state.stage == "quiz"
    assert state.new == 0  # nothing is marked as new after the last step
    assert state.belief == tuple(offline.beliefs[-1].tolist())


@pytest.mark.parametrize(
    "update",
    [
        Persistent("learned"),
        Persistent(0.05, 0.7),
        Persistent(0.0, "learned", 0.1),
        Independent(0.0, 0.8, 0.1),
        Open("learned"),
    ],
)
def test_people_who_fail_are_explained_to_as_offline_and_logged_by_type(
    study: Study, update: Persistent | Independent
) -> None:
    """The belief that a state carries is over types, habits and knowledge, that of the log over
    types."""
    problem = update.people(study.plan.problem, None, None)
    policy = QMDP().plan(problem)
    failing = replace(
        study,
        plan=replace(study.plan, problem=problem),
        policies=dict.fromkeys(study.policies, policy),
        belief=update,
    )
    people = Heedless(0.4, 0.3) if not problem.messages_land else Exact()
    said_again = 0
    for seed, user_type in product(range(8), range(3)):
        labels = LabelTable.dense(study.plan.true_labels[user_type][None])
        offline_person, person = (
            people.meet(labels, np.arange(problem.n_steps), seed) for _ in range(2)
        )
        offline = explain(problem, CachedPolicy(policy), offline_person, update)
        state = at_evaluation(failing, user_type, "personalized")
        for k in range(problem.n_steps):
            assert (state.new, len(state.belief)) == (offline.messages[k], len(problem.start))
            person.hear(state.new)
            answers = person.react(state.given, k + 1).answers.tolist()
            state = failing.advance(state, "labels", {"labels": answers})
            assert state.after == pytest.approx(offline.beliefs[k + 1].tolist())
            if state.stage == "evaluation":
                assert state.before == state.after
        assert state.again == offline.n_again
        said_again += state.again
    assert (said_again > 0) != problem.messages_land


def test_a_faultless_participant_errs_only_where_nothing_was_said(study: Study) -> None:
    plan = study.plan
    for user_type, condition in plan.cells:
        user = SimulatedUser.of(plan.true_labels[user_type])
        offline = explain(plan.problem, study.policies[condition], user, study.belief)
        person = StudyBot(plan, FAULTLESS, np.random.default_rng(0))
        found = take_part(study, person, user_type, condition)
        assert found.labels.count(0) == (offline.labels[-1] == 0).sum()
        assert found.given.bit_count() == offline.n_messages
        told = sum(int(mask) for mask in offline.messages)
        untold = [j for j in plan.roles[user_type].wrong if not told >> j & 1]
        assert found.score == 4 - len(untold)


def test_failing_the_check_leads_to_the_briefing_then_to_a_polite_end(study: Study) -> None:
    wrong = [1 - q.answer for q in study.plan.roles[0].eligibility]
    state = StudyState(stage="eligibility", user_type=0, condition="conformant")
    state = study.advance(state, "eligibility", {"answers": wrong})
    assert (state.stage, state.attempts, state.wrong) == ("briefing", 1, True)
    assert study.view(state)["attempts_left"] == 1
    told = [study.view(state)["sentences"]]
    state = study.advance(state, "read", {})
    told.append(study.view(state)["sentences"])
    assert sum(told, ()) == study.plan.roles[0].briefing  # the facts again, three a screen
    assert len(told[0]) == 3
    state = study.advance(state, "read", {})
    assert state.stage == "eligibility"  # the practice is not repeated
    right = {"answers": [q.answer for q in study.plan.roles[0].eligibility]}
    passed = study.advance(state, "eligibility", right)
    assert (passed.stage, study.view(passed)["wrong"]) == ("evaluation", False)
    state = study.advance(state, "eligibility", {"answers": wrong})
    assert (state.stage, state.over) == ("ineligible", True)


def test_quiz_scores_every_statement_judged_rightly(study: Study) -> None:
    state = StudyState(stage="quiz", user_type=1, condition="conformant", orders=ORDERS)
    true = [i for i, s in enumerate(study.plan.roles[1].quiz) if s.true]
    for none in ([4], [-1], [0.0], ["0"], [0] * 5, None, "0"):
        with pytest.raises(Refused):
            study.advance(state, "quiz", {"chosen": none})
    for chosen, score in ((true, 4), ([], 2), ([0, 1, 2, 3], 2), (true[:1], 3)):
        assert study.advance(state, "quiz", {"chosen": chosen}).score == score


def test_pages_carry_nothing_that_tells_type_condition_or_answers(study: Study) -> None:
    for user_type, condition in study.plan.cells:
        state = at_evaluation(study, user_type, condition)
        view = study.view(state)
        assert not view.keys() & {"belief", "condition", "user_type", "true", "score", "values"}
        quiz = StudyState(stage="quiz", user_type=user_type, condition=condition, orders=ORDERS)
        texts = [text for _, text in study.view(quiz)["statements"]]
        assert sorted(texts) == sorted(s.text for s in study.plan.roles[user_type].quiz)


CHECK = {"name": "blue", "label": "Choose blue", "kind": "choice", "choices": ["red", "blue"]}
RATING = {"name": "robots", "label": "I know robots", "kind": "scale", "low": 1, "high": 7}
RULES = {"per_cell": 2, "max_attempts": 2, "timeout_minutes": 30, "recall": True}


def agreed(study: Study, **more: object) -> StudyState:
    slot = {"position": 0, "user_type": 0, "condition": "conformant", "orders": ORDERS}
    payload = {"agree": 1, "text": study.plan.texts.consent_hash, **slot, **more}
    return study.advance(StudyState(), "consent", payload)


def test_a_missed_attention_check_ends_the_part_before_it_begins() -> None:
    rating = RATING | {"ends": ["not at all", "very well"], "required": True}
    study = street_study(before=[CHECK | {"right": "blue"}, rating])
    state = agreed(study)
    assert state.stage == "before"
    assert [q.name for q in study.view(state)["asked"]] == ["blue", "robots"]
    for missing in ({}, {"blue": "blue"}, {"robots": "3"}, {"blue": "blue", "robots": "8"}):
        with pytest.raises(Refused):
            study.advance(state, "screening", missing)
    for blue, stage in (("blue", "briefing"), ("red", "screened_out")):
        answers = {"blue": blue, "robots": "7"}
        assert study.advance(state, "screening", answers).stage == stage


def test_a_plan_may_refuse_narrow_windows() -> None:
    study = street_study(rules=RULES | {"min_width": 900})
    for width in (None, 390, 899, "1280"):
        with pytest.raises(Refused, match="900 pixels"):
            agreed(study, width=width)
    assert agreed(study, width=900).stage == "briefing"
    assert agreed(street_study(), width=390).stage == "briefing"


def test_who_cannot_tell_is_told_as_if_nothing_was_answered() -> None:
    """The belief does not change, and such a label does not count as inexplicable."""
    study = street_study()
    state = study.after(StudyState(stage="eligibility", user_type=0, condition="personalized"))
    first = state.belief
    while state.stage == "evaluation":
        state = study.advance(state, "labels", {"labels": [CANNOT_TELL] * (state.step + 1)})
        assert state.belief == pytest.approx(first, abs=1e-12)
    assert state.labels.count(0) == 0
    assert set(state.labels) == {CANNOT_TELL}
