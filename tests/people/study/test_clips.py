"""What may be asked about in a study of a domain."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tests.domains.configs import setting_of
from tests.people.study.stand_in import english_words
from xplain.domains.base import cell_name
from xplain.experiment.pipeline import draw_trace
from xplain.explanation.asking import Pool
from xplain.people.study.site import StudySite
from xplain.people.study.task import OfDomain


def test_clips_are_steps_of_the_robot_as_its_map_shows_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On the map and with what was done before, each with what the types think of it."""
    setting = setting_of("domain=rescue")
    domain, task = setting.domain, OfDomain(setting)
    monkeypatch.setattr(OfDomain, "table", lambda _, learned, steps: setting.true_labels(steps))
    trace = draw_trace(setting, 20, 0, 0)
    asked = task.may_ask(None, trace, Pool(clips=40))  # type: ignore[arg-type]
    made = {}
    for step in setting.reachable.tolist():
        begin, _, end = step
        about = domain.situation(begin), domain.gone(begin)  # type: ignore[attr-defined]
        cells = domain.position(begin), domain.position(end)
        made[domain.describe(np.array(step)), (cells,), *about] = step
    assert 5 < len(asked.clips) <= 40
    told = asked.labels.array(setting.n_messages)
    off = 0
    for q, clip in enumerate(asked.clips):
        step = np.array(made[clip.phrase, clip.way, clip.situation, clip.gone])
        assert asked.shows[q].tolist() == (trace == step).all(axis=1).tolist()
        assert (told[:, q] == setting.label_table(step[None])[:, 0]).all()
        off += not asked.shows[q].any()
    assert off  # not of the trace alone
    picture = StudySite.picture
    plan = SimpleNamespace(
        scene=domain.scene,
        icons={},
        clips=asked.clips,
        texts=SimpleNamespace(words=english_words()),
    )
    for q, clip in enumerate(asked.clips):
        drawn = picture(SimpleNamespace(plan=plan), ("clip", q))  # type: ignore[arg-type]
        assert cell_name(*clip.way[0][1]) in drawn
