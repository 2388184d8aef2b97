"""From a configuration to the plan of a study."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.participants.visitors import GENEROUS, Visitor
from tests.study.stand_in import FAULTLESS
from xplain.errors import InputError
from xplain.participants.server.app import create_app
from xplain.participants.server.store import Store
from xplain.participants.simulation.http_client import visit
from xplain.study.simulation.participant import Person


def test_the_rescue_study_is_prepared_from_its_configuration() -> None:
    from xplain.config import composed
    from xplain.study.policies import study_of
    from xplain.study.prepare import study_plan

    cfg = composed("study", ["trace.candidates=40"])
    plan = study_plan(cfg)
    assert study_plan(cfg).hash == plan.hash  # same configuration, same study
    study_of(plan)
    assert (len(plan.roles), plan.problem.trade_off) == (5, 1.0)
    assert set(plan.conditions) == {"personalized", "conformant"}
    agree = (plan.problem.p_explicable > 0.5) == plan.true_labels.astype(bool)
    assert agree.mean() > 0.95
    assert plan.scene is not None
    assert set(plan.icons) >= {item.name for item in plan.scene.items}
    for role in plan.roles:
        assert len(role.wrong) == 2
        assert all(q.options == ("0 or more", "less than 0") for q in role.eligibility)
        assert [q.answer for q in role.eligibility] == [int(j in role.wrong) for j in range(6)]
    assert json.loads(plan.text)["config"]["lambda"] == 1.0


def test_four_rooms_gets_a_study_whose_map_gives_nothing_away(tmp_path: Path) -> None:
    from xplain.config import composed
    from xplain.study.policies import study_of
    from xplain.study.prepare import study_plan

    cfg = composed("study", ["domain=four_rooms", "observers.points=150", "trace.candidates=40"])
    plan = study_plan(cfg)
    assert plan.scene is not None
    assert plan.scene.items == ()  # goals and penalties are among what types hold wrong
    assert "four rooms" in plan.texts.introduction[0]
    for role in plan.roles:
        assert len(role.quiz) == 4
    study = study_of(plan)
    store = Store(tmp_path / "s.sqlite", study)
    client = Visitor(create_app(store, GENEROUS).test_client())
    person = Person(plan, FAULTLESS, np.random.default_rng(0))
    assert visit(client, person, store.invite(1, "bot")[0]) == "done"
    store.close()
    with pytest.raises(InputError, match=r"wording\.hide"):
        study_plan(
            composed("study", ["domain=four_rooms", "wording.hide=[Q]", "observers.points=50"])
        )
