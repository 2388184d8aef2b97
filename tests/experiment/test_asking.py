"""Questions in an experiment: the questions of a trace, their answers, and their costs."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from xplain.domains.base import transition_features
from xplain.domains.users.setting import Setting
from xplain.errors import InputError
from xplain.experiment.cache import source_fingerprint
from xplain.experiment.config import compose_config
from xplain.experiment.explanations import (
    Costs,
    evaluate,
    problem_of_types,
    true_thoughts,
    with_true_labels,
)
from xplain.experiment.fingerprint import configuration
from xplain.experiment.from_config import components_of, costs_of
from xplain.experiment.pipeline import Prepared, observe, prepare
from xplain.experiment.strangers import with_others
from xplain.explanation.asking import Limits, Pool
from xplain.explanation.belief import Independent, Persistent
from xplain.explanation.label_table import LabelTable
from xplain.interaction.explainees import Exact, Heedless, Slips, Unseen
from xplain.solvers.greedy import QMDP
from xplain.solvers.simple import AskFirst

OVERRIDES = ("domain=four_rooms", "labeler=truth", "clusterer=perfect", "discount=1", "traces=3")


@cache
def world(*more: str) -> tuple[Prepared, Costs, Setting]:
    cfg = compose_config("config", [*OVERRIDES, "ask=clips", *more])
    components = components_of(cfg)
    own = (components.domain, components.users, components.observers, components.queries)
    setting = observe(*own, components.seed).setting
    assert setting is not None
    return prepare(components), costs_of(cfg), setting


def test_clips_are_the_tasks_nearest_first_with_their_labels() -> None:
    prepared, _, setting = world()
    for case in prepared.cases:
        asked = case.questions
        assert asked is not None
        assert {*map(tuple, asked.transitions.tolist())} <= {
            *map(tuple, setting.reachable.tolist())
        }
        truth = setting.true_labels(asked.transitions)
        assert np.array_equal(asked.labels.p, truth.p)
        assert np.array_equal(asked.learned.p, truth.p)  # labeler=truth
        own, clips = (
            transition_features(setting.domain, t) for t in (case.transitions, asked.transitions)
        )
        apart = (clips[:, None] != own).sum(axis=2).min(axis=1)
        assert (np.diff(apart) >= 0).all()
        for clip, row in zip(asked.transitions, asked.shows, strict=True):
            assert row.tolist() == (case.transitions == clip).all(axis=1).tolist()


def test_no_more_clips_are_kept_than_asked_for() -> None:
    prepared, _, _ = world("ask.clips=4")
    assert {len(c.questions.texts) for c in prepared.cases if c.questions} == {4}


def test_an_episode_costs_its_questions_too() -> None:
    """Exact users answer with their true labels under the messages given."""
    prepared, costs, _ = world()
    dear = replace(costs, asking=Limits(0.3, most=2))
    records = evaluate(prepared, dear, {"solver": AskFirst()}, Independent(), Exact(), 0)
    assert max(record.episode.n_questions for record in records) == 2
    for record in records:
        episode, asked = record.episode, prepared.cases[record.trace].questions
        assert asked is not None
        assert episode.n_questions <= 2
        paid = costs.trade_off * episode.communication + episode.inexplicability
        assert episode.cost == pytest.approx(paid + 0.3 * episode.n_questions)
        for step, question, answer in episode.questions.tolist():
            assert step == 0  # before the first step, so nothing was said
            label = asked.labels.label_probabilities(question + 1, 0)[record.user_type, -1]
            assert answer == label


def test_a_clip_is_answered_as_the_label_is_mistakes_included() -> None:
    """People who repeat a mistake make it about a transition and about its clip."""
    prepared, _, _ = world()
    mistakes = 0
    for case in prepared.cases:
        assert case.questions is not None
        labels, same = true_thoughts(case)
        m = len(case.transitions)
        for user in range(len(prepared.types)):
            person = Slips(0.4, repeats=True).meet(labels.of_types([user]), same, seed=user)
            answers = person.react(0, m).answers
            for clip, step in zip(*np.nonzero(case.questions.shows), strict=True):
                answer = person.answer(m + int(clip), 0)
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


def test_asking_is_learned_once_whatever_it_costs() -> None:
    def key(*more: str) -> str:
        return source_fingerprint(configuration(compose_config("config", [*OVERRIDES, *more])))

    assert key("ask=clips") == key("ask=clips", "ask.cost=0.5", "ask.most=3", "ask.when=first")
    assert len({key(), key("ask=clips"), key("ask=clips", "ask.clips=9")}) == 3


def test_nothing_is_asked_by_default() -> None:
    cfg = compose_config("config", list(OVERRIDES))
    components = components_of(cfg)
    assert components.ask is None
    prepared = prepare(replace(components, traces=1))
    assert prepared.cases[0].questions is None
    assert not problem_of_types(prepared, prepared.cases[0], costs_of(cfg), Independent()).questions


def test_true_labels_and_strangers_answer_questions_too() -> None:
    prepared, costs, _ = world()
    for case in with_true_labels(prepared).cases:
        assert case.questions is not None
        assert case.questions.learned is case.questions.labels
    cfg = compose_config("config", [*OVERRIDES, "ask=clips"])
    strange = with_others(prepared, components_of(cfg), Unseen())
    records = evaluate(strange, costs, {"solver": QMDP()}, Independent(0.1), Exact(), 0)
    assert len(records) == len(strange.types) * len(strange.cases)


def test_users_who_err_are_asked_twice() -> None:
    """There are second opinions if users err, otherwise none."""
    prepared, costs, _ = world()
    cheap = replace(costs, asking=Limits(0.01))
    asked = []
    for error in (0.0, 0.2):
        update = Persistent(error)
        records = evaluate(prepared, cheap, {"solver": QMDP()}, update, Exact(), 0)
        asked.append(np.mean([record.episode.n_questions for record in records]))
    assert asked[1] > asked[0] > 0


def test_what_may_be_asked_is_checked() -> None:
    with pytest.raises(InputError, match=r"ask\.kinds"):
        Pool(("riddles",))  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"ask\.clips"):
        Pool(clips=0)
    with pytest.raises(InputError, match=r"ask\.cost"):
        Limits(-0.1)
    with pytest.raises(InputError, match=r"ask\.when"):
        Limits(when="later")  # type: ignore[arg-type]
