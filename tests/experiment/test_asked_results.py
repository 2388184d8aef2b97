"""Questions and their costs in all files of a run."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import instantiate

from tests.report import handmade
from xplain.experiment.config import compose_config
from xplain.experiment.explanations import evaluate
from xplain.experiment.from_config import components_of, costs_of
from xplain.experiment.pipeline import Prepared, prepare
from xplain.experiment.results import EPISODES, episode_lines
from xplain.explanation.asking import SENSE
from xplain.interaction.metrics import Record, by_step, summarise
from xplain.report.trace import LISTED, list_said, stories

OVERRIDES = ("labeler=truth", "clusterer=perfect", "ask=clips", "ask.cost=0.2", "traces=3")


def explained(*overrides: str) -> tuple[Prepared, list[Record]]:
    GlobalHydra.instance().clear()
    cfg = compose_config("config", [*OVERRIDES, *overrides])
    prepared = prepare(components_of(cfg))
    solvers = {"solver": instantiate(cfg.solver)}
    update, explainee = instantiate(cfg.belief), instantiate(cfg.explainee)
    return prepared, evaluate(prepared, costs_of(cfg), solvers, update, explainee, 0)


@pytest.fixture(scope="module")
def asked() -> tuple[Prepared, list[Record]]:
    return explained("lambda=0.5", "discount=1")


def test_cost_is_of_messages_labels_and_questions(asked: Any) -> None:
    _, records = asked
    for record in records:
        episode = record.episode
        parts = 0.5 * episode.n_messages + episode.n_inexplicable + 0.2 * episode.n_questions
        assert episode.cost == pytest.approx(parts)
        assert episode.asking == pytest.approx(0.2 * episode.n_questions)
    figures = summarise(records)
    assert figures["questions"].mean == np.mean([r.episode.n_questions for r in records]) > 0
    assert figures["questions_cost"].mean == pytest.approx(0.2 * figures["questions"].mean)
    own = by_step(records)["questions_asked"] @ by_step(records)["episodes"][1:]
    assert own == pytest.approx(sum(r.episode.n_questions for r in records))


def test_each_question_is_told_with_its_step_and_its_answer(asked: Any) -> None:
    prepared, records = asked
    for text, record in zip(episode_lines(prepared, records).splitlines(), records, strict=True):
        told = [
            (k, one["about"], one["answer"], one["reply"])
            for k, step in enumerate(json.loads(text)["steps"])
            for one in step["questions"]
            if one["text"] == SENSE
        ]
        texts = prepared.cases[record.trace].questions.texts
        rows = record.episode.questions.tolist()
        assert told == [(k, texts[q], answer, ("no", "yes")[answer]) for k, q, answer in rows]


def test_the_report_counts_questions_step_by_step(asked: Any, tmp_path: Any) -> None:
    prepared, records = asked
    results = handmade.results("run", {}, ())
    config = {"lambda": 0.5, "ask": {"cost": 0.2}, "message_cost": 1.0}
    (tmp_path / EPISODES).write_text(episode_lines(prepared, records))
    object.__setattr__(results, "config", {**results.config, **config})
    for story, record in zip(stories(tmp_path, "solver"), records, strict=True):
        asked_in_all = sum(len(step["questions"]) for step in story["steps"])
        assert asked_in_all == record.episode.n_questions
        said = list_said(story, results.messages)
        assert said.count("it asks: “") == min(asked_in_all, LISTED)


def test_where_nothing_is_asked_nothing_is_told_of_it() -> None:
    prepared, records = explained("ask=never")
    assert '"questions"' not in episode_lines(prepared, records)
    assert not {"questions", "questions_cost"} & summarise(records).keys()
    assert "questions_asked" not in by_step(records)
