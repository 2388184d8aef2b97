"""Questions in an experiment: the questions of a trace, right answers to them, and their costs."""

import json
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hydra.utils import instantiate

from tests.configurations import composed, world
from tests.report import handmade
from xplain.domains.base import transition_features
from xplain.domains.users.setting import Setting, UserType
from xplain.errors import InputError
from xplain.experiment.asking import CaseQuestions, belief_questions
from xplain.experiment.explanations import (
    evaluate,
    problem_of_types,
    true_thoughts,
    with_true_labels,
)
from xplain.experiment.from_config import components_of
from xplain.experiment.pipeline import observe, with_others
from xplain.experiment.results import EPISODES, episode_lines
from xplain.explanation.asking import SENSE, Limits, Pool
from xplain.explanation.belief import Independent
from xplain.explanation.label_table import LabelTable
from xplain.interaction.explainees import Exact, Heedless, Slips, Unseen
from xplain.interaction.metrics import Record, summarise
from xplain.report.trace import list_said, stories
from xplain.solvers.base import Solver
from xplain.solvers.greedy import QMDP
from xplain.solvers.simple import AskFirst

TRUE = ("labeler=truth", "clusterer=perfect")
ROOMS = ("domain=four_rooms", *TRUE, "discount=1", "traces=3")
CLIPS = (*ROOMS, "ask=clips")
ASKED = (*TRUE, "discount=1", "traces=3", "lambda=0.5", "ask=clips", "ask.cost=0.2")
TWO = (*TRUE, "traces=2")


def questions(*overrides: str) -> CaseQuestions:
    """Returns the questions of the first trace."""
    return world(*overrides)[0].cases[0].questions


@cache
def records_of(solver: Solver, limits: Limits | None, *overrides: str) -> list[Record]:
    prepared, costs = world(*overrides)
    costs = costs if limits is None else replace(costs, asking=limits)
    return evaluate(prepared, costs, {"solver": solver}, Independent(), Exact(), 0)


def test_clips_are_the_tasks_nearest_first_with_their_labels() -> None:
    components = components_of(composed(*CLIPS))
    own = (components.domain, components.users, components.observers, components.queries)
    setting = observe(*own, components.seed).setting
    for case in world(*CLIPS)[0].cases:
        asked = case.questions
        assert {*map(tuple, asked.transitions.tolist())} <= {
            *map(tuple, setting.reachable.tolist())
        }
        truth = setting.true_labels(asked.transitions)
        assert np.array_equal(asked.labels.p, truth.p)
        assert np.array_equal(asked.learned.p, truth.p)  # labeler=truth
        trace, clips = (
            transition_features(setting.domain, t) for t in (case.transitions, asked.transitions)
        )
        apart = (clips[:, None] != trace).sum(axis=2).min(axis=1)
        assert (np.diff(apart) >= 0).all()
        shows = [(case.transitions == clip).all(axis=1).tolist() for clip in asked.transitions]
        assert asked.to_questions(Limits(), case.transitions).shows.tolist() == shows
    assert len(questions(*CLIPS, "ask.clips=4").texts) == 4


@pytest.mark.parametrize(
    ("solver", "limits", "overrides"),
    [(QMDP(), None, ASKED), (AskFirst(), Limits(0.3, most=2), CLIPS)],
)
def test_an_episode_costs_its_questions_too(
    solver: Solver, limits: Limits | None, overrides: tuple[str, ...]
) -> None:
    """Exact users answer with their true labels under the messages given."""
    prepared, costs = world(*overrides)
    records = records_of(solver, limits, *overrides)
    price = (limits or costs.asking).cost
    for record in records:
        episode, asked = record.episode, prepared.cases[record.trace].questions
        paid = costs.trade_off * episode.n_messages + episode.n_inexplicable
        assert (episode.cost, episode.asking) == (
            pytest.approx(paid + price * episode.n_questions),
            pytest.approx(price * episode.n_questions),
        )
        for step, question, answer in episode.questions.tolist():
            given = int(np.bitwise_or.reduce(episode.messages[:step], initial=0))
            labels = asked.labels.label_probabilities(question + 1, given)
            assert answer == labels[record.user_type, -1]
    counts = [record.episode.n_questions for record in records]
    assert max(counts) <= (limits.most if limits else np.inf)
    figures = summarise(records)
    assert figures["questions"].mean == np.mean(counts) > 0
    assert figures["questions_cost"].mean == pytest.approx(price * np.mean(counts))


def test_each_question_is_told_with_its_step_and_its_answer_and_the_report_counts_it(
    tmp_path: Any,
) -> None:
    prepared, records = world(*ASKED)[0], records_of(QMDP(), None, *ASKED)
    text = episode_lines(prepared, records)
    (tmp_path / EPISODES).write_text(text)
    messages = handmade.results("run", {}, ()).messages
    for line, story, record in zip(
        text.splitlines(), stories(tmp_path, "solver"), records, strict=True
    ):
        told = [
            (k, one["about"], one["answer"], one["reply"])
            for k, step in enumerate(json.loads(line)["steps"])
            for one in step["questions"]
            if one["text"] == SENSE
        ]
        texts = prepared.cases[record.trace].questions.texts
        rows = record.episode.questions.tolist()
        assert told == [(k, texts[q], answer, ("no", "yes")[answer]) for k, q, answer in rows]
        assert sum(len(step["questions"]) for step in story["steps"]) == len(rows)
        assert list_said(story, messages).count("it asks: “") == len(rows)


def test_where_nothing_is_asked_which_is_the_default_nothing_is_told_of_it() -> None:
    prepared, costs = world(*TRUE, "traces=1")
    records = records_of(QMDP(), None, *TRUE, "traces=1")
    assert prepared.cases[0].questions is None
    assert not problem_of_types(prepared, prepared.cases[0], costs, Independent()).questions
    assert '"questions"' not in episode_lines(prepared, records)
    assert not {"questions", "questions_cost"} & summarise(records).keys()


def test_a_clip_is_answered_as_the_label_is_mistakes_included() -> None:
    """People who repeat a mistake make it about a transition and about its clip."""
    prepared, _ = world(*CLIPS)
    mistakes = 0
    for case in prepared.cases:
        (labels, same), m = true_thoughts(case), len(case.transitions)
        asked = case.questions.to_questions(Limits(), case.transitions)
        for user in range(len(prepared.types)):
            person = Slips(0.4, repeats=True).meet(labels.of_types([user]), same, seed=user)
            answers = person.react(0, m).answers
            for clip, step in np.argwhere(asked.shows).tolist():
                answer = person.answer(m + clip, 0)
                assert answer == answers[step]
                truth = labels.of_types([user]).label_probabilities(m, 0)[0, step]
                mistakes += answer != truth
    assert mistakes > 0


def test_who_missed_a_message_answers_without_it() -> None:
    p = np.array([[[0.0, 1.0], [0.0, 1.0]]])  # one transition, one clip: both need the message
    answers = []
    for seed in range(8):
        person = Heedless(accept=0.5).meet(LabelTable.dense(p), np.arange(2), seed)
        person.hear(1)
        answers.append(person.answer(1, 1))
        assert answers[-1] == person.knows
    assert {*answers} == {0, 1}


def test_true_labels_answer_questions_too() -> None:
    for case in with_true_labels(world(*CLIPS)[0]).cases:
        assert case.questions.learned is case.questions.labels


@pytest.mark.parametrize(
    ("key", "made"),
    [
        ("ask.kinds", lambda: Pool(("riddles",))),
        ("ask.clips", lambda: Pool(clips=0)),
        ("ask.cost", lambda: Limits(-0.1)),
        ("ask.when", lambda: Limits(when="later")),
    ],
)
def test_what_may_be_asked_is_checked(key: str, made: Any) -> None:
    with pytest.raises(InputError, match=key):
        made()


# --- Questions about beliefs ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def setting() -> Setting:
    domain = instantiate(composed().domain)
    values = {one.name: one.inaccurate for one in domain.parameters}
    held = [(), ("fire",), ("rubble", "fence"), ("refuel", "puddle", "first_aid")]
    return Setting.build(
        domain,
        tuple(UserType(str(t), {n: values[n] for n in own}) for t, own in enumerate(held)),
    )


def test_a_fact_is_right_unless_it_is_held_wrong_and_was_not_told(setting: Setting) -> None:
    beliefs = belief_questions(setting, setting.wrong, 0)
    names = setting.message_names
    assert [names[j] for j in beliefs.facts] == list(names)
    for given in range(1 << len(names)):
        found = beliefs.labels.label_probabilities(len(names), given)
        for t, user in enumerate(setting.types):
            wanted = [n not in user.inaccurate or given >> j & 1 for j, n in enumerate(names)]
            assert found[t].tolist() == wanted


@pytest.mark.parametrize("most", [12, 2])
def test_what_types_know_is_what_is_left_until_they_are_told(
    setting: Setting, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A message tells a type about the facts that it most probably believes incorrectly."""
    monkeypatch.setattr("xplain.experiment.asking.MOST_TOLD", most)
    rng = np.random.default_rng(0)
    wrong = np.where(rng.random((3, 6)) < 0.3, 0.004, rng.random((3, 6)))
    learned = belief_questions(setting, wrong, 0).learned
    for given in range(1 << 6):
        told = np.array([given >> j & 1 for j in range(6)], bool)
        likely = wrong >= np.maximum(np.sort(wrong)[:, [-min(most, 6)]], 0.01)
        wanted = np.where(told & likely, 1, 1 - wrong)
        np.testing.assert_allclose(learned.label_probabilities(6, given), wanted)


def test_the_order_of_sentences_is_drawn_and_says_nothing_of_the_right_one(
    setting: Setting,
) -> None:
    drawn = [belief_questions(setting, setting.wrong, seed) for seed in range(200)]
    again = belief_questions(setting, setting.wrong, 7)
    assert (again.texts, again.right.tolist()) == (drawn[7].texts, drawn[7].right.tolist())
    shares = np.mean([one.right for one in drawn], axis=0)
    assert (abs(shares - 0.5) < 4 * 0.5 / np.sqrt(200)).all()
    for one in drawn:
        for j, text, right in zip(one.facts, one.texts, one.right, strict=True):
            assert text.split("\n")[right] == setting.domain.parameters[j].message
            assert text.split("\n")[1 - right] == setting.domain.parameters[j].belief


def test_labels_of_people_tell_what_their_types_hold_wrong() -> None:
    """20 labels of each person are enough for these types; the posterior is never certain."""
    learner = ("labeler=hypotheses", "queries=adaptive", "points=20", "traces=2")
    found, true = (questions(*words, "ask=beliefs") for words in (learner, TWO))
    assert found.facts.tolist() == true.facts.tolist()
    p = found.learned.label_probabilities(len(found.facts), 0)
    truth = true.learned.label_probabilities(len(true.facts), 0)
    assert ((p > 0) & (p < 1)).all()
    for own in p:  # types come in another order
        assert abs(truth - own).sum(axis=1).min() < 0.1


def test_types_without_fact_sets_are_refused_in_one_line() -> None:
    with pytest.raises(InputError, match="labeler=truth and labeler=hypotheses"):
        world("labeler=tree", "clusterer=perfect", "ask=beliefs", "traces=1", "points=20")


def test_clips_and_beliefs_are_one_list_with_one_cap() -> None:
    both, clips = (questions(*TWO, f"ask={kind}") for kind in ("both", "clips"))
    assert len(both.texts) == len(clips.texts) + (both.facts >= 0).sum()
    assert (both.transitions[both.facts < 0] == clips.transitions).all()
    assert len(questions(*TWO, "ask=both", "ask.clips=7").texts) == 7


@pytest.mark.parametrize("kind", ["clips", "beliefs", "both"])
def test_strangers_answer_for_themselves(kind: str) -> None:
    prepared, costs = world(*TWO, f"ask={kind}")
    components = components_of(composed(*TWO, f"ask={kind}"))
    strangers = with_others(prepared, components, Unseen())
    for case in strangers.cases:
        asked = case.questions
        assert asked.labels.n_types == len(strangers.types)
        for t, name in enumerate(strangers.types):
            facts = set(name.removeprefix("unseen ").split("+"))
            for q in np.flatnonzero(asked.facts >= 0):
                right = asked.labels.label_probabilities(q + 1, 0)[t, q]
                assert right == (strangers.messages[asked.facts[q]] not in facts)
        for q, i in np.argwhere(asked.to_questions(Limits(), case.transitions).shows):
            for given in (0, 5, 63):
                one = case.labels.label_probabilities(i + 1, given)[:, i]
                other = asked.labels.label_probabilities(q + 1, given)[:, q]
                np.testing.assert_array_equal(one, other)
    free = replace(costs, asking=Limits(0.0))
    records = evaluate(strangers, free, {"solver": QMDP()}, Independent(), Unseen(), 0)
    assert any(record.episode.n_questions for record in records)
    assert len(records) == len(strangers.types) * len(strangers.cases)
