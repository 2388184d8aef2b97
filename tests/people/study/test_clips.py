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
from xplain.explanation.label_table import LabelTable
from xplain.people.map_svg import picture
from xplain.people.material import Material, Transitions
from xplain.people.study import prepare
from xplain.people.study.flow import Study


def test_clips_are_steps_of_the_robot_as_its_map_shows_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On the map and with what was done before, each with what the types think of it."""
    setting = setting_of("domain=rescue")
    domain, task = setting.domain, Material.of(setting)

    def truth(material: Material, learned: object, rows: Transitions) -> LabelTable:
        return setting.true_labels(setting.reachable[rows])

    monkeypatch.setattr(prepare, "learned_table", truth)
    trace = draw_trace(setting, 20, 0, 0)
    asked = prepare.may_ask(task, None, task.rows_of(trace), Pool(clips=40))  # type: ignore[arg-type]
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
    plan = SimpleNamespace(
        scene=domain.scene,
        icons={},
        shown=asked.clips,
        clips=asked.clips,
        texts=SimpleNamespace(words=english_words()),
    )
    for q, clip in enumerate(asked.clips):
        drawn = picture(plan, *Study.drawn(SimpleNamespace(plan=plan), ("clip", q)))  # type: ignore[arg-type]
        assert cell_name(*clip.way[0][1]) in drawn
