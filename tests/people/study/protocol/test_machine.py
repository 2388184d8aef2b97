"""The protocol without a server: accepted answers, hidden values, and the policies' decisions."""

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from starlette.datastructures import ImmutableMultiDict

from tests.people.bare_flow import take_part
from tests.people.street import ASK, CONFIG, SCREENS, bot_of, street_plan, street_study
from xplain.errors import InputError, Refused
from xplain.explanation.anybody import Open
from xplain.explanation.belief import BeliefUpdate, Independent, Persistent
from xplain.explanation.label_table import LabelTable, join_steps
from xplain.interaction.episode import explain
from xplain.interaction.explainees import Exact, Explainee, Heedless, SimulatedUser, Slips
from xplain.people.flow import CANNOT_TELL
from xplain.people.study.flow import Study, StudyState
from xplain.people.study.prepare import conditions_of
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


@pytest.fixture(scope="module")
def asking() -> Study:
    return street_study(ask=ASK)


def with_belief(study: Study, update: Any) -> Study:
    """Returns the study with this belief about people, and policies for it."""
    problem = update.people(study.plan.problem, None, None)
    policies = dict.fromkeys(study.policies, CachedPolicy(QMDP().plan(problem)))
    plan = replace(study.plan, problem=problem)
    return replace(study, plan=plan, policies=policies, belief=update)


FAILING = (Persistent(0.05, 0.7), Persistent(0.0, "learned", 0.1), Independent(0.0, 0.8, 0.1))
ASKED = (None, Persistent(), Persistent(0.1), Independent("learned"), Open("learned"))


@pytest.mark.parametrize(
    ("condition", "update", "people"),
    [
        *product(("personalized", "conformant"), [None], [Exact()]),
        *product(["personalized"], [Persistent("learned"), Open("learned")], [Exact()]),
        *product(["personalized"], FAILING, [Heedless(0.4, 0.3)]),
        *product(["asking"], ASKED, [Exact(), Slips(0.3)]),
    ],
)
def test_participants_meet_what_the_offline_experiment_computes(
    study: Study, asking: Study, condition: str, update: BeliefUpdate | None, people: Explainee
) -> None:
    """Questions, messages and beliefs are equal to the last bit, also for people who err, miss and
    forget. The belief that a state carries is over types, habits and knowledge, that of the log
    over types."""
    own = asking if condition == "asking" else study
    own = with_belief(own, update) if update else own
    plan, problem, met, said_again = own.plan, own.plan.problem, set(), 0
    clips = () if plan.clip_labels is None else (plan.clip_labels,)
    same = np.tile(np.arange(plan.n_steps), 1 + len(clips))  # the clips are the trace's own steps
    for seed, user_type in product(range(8), range(3)):
        of_trace = LabelTable.dense(plan.true_labels[[user_type]])
        labels = join_steps([of_trace, *(one.of_types([user_type]) for one in clips)])
        offline_person, person = (people.meet(labels, same, seed) for _ in range(2))
        offline = explain(problem, own.policies[condition], offline_person, own.belief)
        state, pages, steps = at_evaluation(own, user_type, condition), [], 0
        while state.stage in ("asking", "evaluation"):
            if state.stage == "asking":
                question = state.asked[-1].question
                label = person.answer(plan.n_steps + question, state.given)
                pages.append((state.step, question, label))
                state = own.advance(state, "clip", {"label": label})
                continue
            assert (state.step, state.new) == (steps, offline.messages[steps])
            assert len(state.belief) == len(problem.start)
            assert pages or list(state.before) == offline.beliefs[steps].tolist()
            person.hear(state.new)
            answers = person.react(state.given, steps + 1).answers.tolist()
            state, steps = own.advance(state, "labels", {"labels": answers}), steps + 1
            assert list(state.after) == offline.beliefs[steps].tolist()
        # After the last step nothing is marked as new.
        assert (state.stage, state.new, steps) == ("quiz", 0, plan.n_steps)
        assert state.again == offline.n_again
        assert pages == [tuple(one) for one in offline.questions.tolist()]
        assert [(one.step, one.question, one.answer) for one in state.asked] == pages
        # Each question goes on from where the one before it led, and was worth its price.
        for one, other in zip(state.asked, state.asked[1:], strict=False):
            assert one.step != other.step or one.after == other.before
        assert all(one.worth is not None and one.worth > 0 for one in state.asked)
        met |= {one.question for one in state.asked}
        said_again += state.again
    assert (len(met) > 1) == (condition == "asking")
    assert (said_again > 0) == isinstance(people, Heedless) != problem.messages_land


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
    assert {*street_plan().texts.task} < {*street_plan(ask=ASK).texts.task}


def test_a_faultless_participant_errs_only_where_nothing_was_said(study: Study) -> None:
    plan = study.plan
    for user_type, condition in plan.cells:
        user = SimulatedUser.of(plan.true_labels[user_type])
        offline = explain(plan.problem, study.policies[condition], user, study.belief)
        person = bot_of(study, 0)
        found = take_part(study, person, user_type, condition)
        assert found.labels.count(0) == (offline.labels[-1] == 0).sum()
        assert found.given.bit_count() == offline.n_messages
        told = sum(int(mask) for mask in offline.messages)
        untold = [j for j in plan.roles[user_type].wrong if not told >> j & 1]
        assert found.score == 4 - len(untold)


@pytest.mark.parametrize(
    ("habits", "messages", "known"),
    [
        *(({}, 1, 0b01), ({}, 2, 0b11), ({"label_noise": 1.0}, 2, 0b11)),
        *(({"overload": 1.0}, 1, 0b01), ({"overload": 1.0}, 2, 0), ({"forgetting": 1.0}, 1, 0)),
    ],
)
def test_a_bot_hears_labels_and_takes_time_as_its_habits_say(
    study: Study, habits: dict[str, float], messages: int, known: int
) -> None:
    """By hand: an old message takes a twentieth of 5 s, a kept label a tenth of 4 s, a page 4 s."""
    person = bot_of(study, 0, spread=0.0, **habits)
    said = [fact.message for fact in study.plan.facts[:messages]]
    right = (study.plan.true_labels[0, :, known] ^ ("label_noise" in habits)).tolist()
    assert person.labels(2, messages, said) == (right[:2], 4 + 5 * messages + 4 * 2)
    assert person.labels(4, messages, ()) == (right, pytest.approx(4 + messages / 4 + 4 * 2.2))
    # Times vary about these.
    times = [bot_of(study, number).labels(0, 0, ())[1] for number in range(1000)]
    assert np.mean(times) == pytest.approx(4, rel=0.1)


def test_failing_the_check_leads_to_the_briefing_then_to_a_polite_end(study: Study) -> None:
    wrong = [1 - q.answer for q in study.plan.roles[0].eligibility]
    state = replace(
        study.after(StudyState(stage="practice", part=1)),  # the practice's second half
        stage="eligibility",
        user_type=0,
        condition="conformant",
    )
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
    for none in ("4", "-1", "0.0", "", "٣"):
        with pytest.raises(Refused):
            study.read(state, "quiz", ImmutableMultiDict({"true": none}))
    for chosen, score in ((true, 4), ([], 2), ([0, 1, 2, 3], 2), (true[:1], 3)):
        assert study.advance(state, "quiz", {"chosen": chosen}).score == score


def test_pages_carry_nothing_that_tells_type_condition_or_answers(study: Study) -> None:
    for user_type, condition in study.plan.cells:
        state = at_evaluation(study, user_type, condition)
        view = study.view(replace(state, heard=(2, 0, 1, 0), given=7, new=1))
        assert not view.keys() & {"belief", "condition", "user_type", "score", "values", "untrue"}
        told = [study.plan.facts[j].message for j in (2, 1, 0)]  # by when each was said last
        assert (view["old"], view["new"], view["again"]) == (told[:2], told[2:], told[2:])


CHECK = {"name": "blue", "label": "Choose blue", "kind": "choice", "choices": ["red", "blue"]}
RATING = {"name": "robots", "label": "I know robots", "kind": "scale", "low": 1, "high": 7}


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
        form = ImmutableMultiDict({f"answer_{name}": value for name, value in missing.items()})
        with pytest.raises(Refused):
            study.read(state, "screening", form)
    for blue, stage in (("blue", "briefing"), ("red", "screened_out")):
        answers = {"blue": blue, "robots": "7"}
        assert study.advance(state, "screening", answers).stage == stage


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
