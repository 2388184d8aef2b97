"""From a configuration to the plan of a study."""

import json

import numpy as np
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from tests.domains.configs import setting_of
from tests.people.conftest import Opened
from tests.people.study.stand_in import FAULTLESS
from tests.people.visitors import take_part
from xplain.domains.base import cell_name
from xplain.errors import InputError
from xplain.experiment.config import compose_config
from xplain.explanation.anybody import Open
from xplain.people.material import Material, name_items, phrases_of
from xplain.people.study.bot import StudyBot
from xplain.people.study.flow import Study
from xplain.people.study.prepare import find_needed, study_plan, traces_of


def test_the_rescue_study_is_prepared_from_its_configuration() -> None:

    cfg = compose_config("study", ["seed=0", "trace.candidates=40"])
    plan = study_plan(cfg)
    assert study_plan(cfg).hash == plan.hash  # same configuration, same study
    assert Study.of(plan).belief == Open("learned")
    assert (len(plan.roles), plan.problem.trade_off) == (5, 1.0)
    assert set(plan.conditions) == {"personalized", "conformant"}
    found = plan.problem.as_found  # people who answer what they think, then those who err
    assert plan.problem.whose[found].tolist() == [*range(5), *range(5)]
    assert 0.5 < plan.problem.start[found].sum() < 1
    true = np.tile(plan.true_labels.astype(bool), (2, 1, 1))
    agree = (plan.problem.p_explicable[found] > 0.5) == true
    assert agree.mean() > 0.95
    assert plan.scene is not None
    assert set(plan.icons) >= {item.name for item in plan.scene.items}
    for role in plan.roles:
        assert len(role.wrong) == 2
        signs = ("0 points or more", "less than 0 points")
        assert all(q.options == signs for q in role.eligibility)
        assert [q.answer for q in role.eligibility] == [int(j in role.wrong) for j in range(6)]
    assert json.loads(plan.text)["config"]["lambda"] == 1.0


@pytest.mark.parametrize("name", ["four_rooms", "rescue"])
def test_no_map_on_the_pages_depends_on_what_a_participant_may_believe(name: str) -> None:
    """If an incorrect value were the robot's, the map would be the same."""
    cfg = compose_config("study", [f"domain={name}"])
    maps = []
    for key in [None, *cfg.domain.parameters]:
        own = OmegaConf.merge(cfg.domain, {})
        if key:
            swapped, before = own.parameters[key], cfg.domain.parameters[key]
            swapped.accurate, swapped.inaccurate = before.inaccurate, before.accurate
        maps.append(name_items(instantiate(own).scene, str))
    assert all(one == maps[0] for one in maps)
    assert maps[0].walls


def test_four_rooms_gets_a_study_whose_map_gives_nothing_away(opened: Opened) -> None:
    cfg = compose_config(
        "study",
        ["seed=0", "domain=four_rooms", "observers.points=150", "trace.candidates=60"],
    )
    plan = study_plan(cfg)
    assert plan.scene is not None
    assert plan.scene.items == ()  # goals and penalties are among what types believe incorrectly
    assert "four rooms" in plan.texts.introduction[0]
    for role in plan.roles:
        assert len(role.quiz) == 4
    person = StudyBot(plan, FAULTLESS, np.random.default_rng(0))
    assert take_part(opened(Study.of(plan)), [person]) == ["done"]


def trace_rules(**changes: object) -> dict[str, object]:
    return {"start": None, "rows": [], "candidates": 3, "min_steps": 1} | changes


def test_traces_that_tell_most_come_first_the_shortest_among_equals() -> None:
    setting = setting_of("domain=four_rooms", "users.count=3")
    ranked = traces_of(Material.of(setting), trace_rules(candidates=80), 40, 0)
    facts = [
        sum(
            find_needed(of_type).bit_count()
            for of_type in setting.label_table(setting.reachable[one])
        )
        for one in ranked
    ]
    assert facts == sorted(facts, reverse=True)
    lengths = [[len(o) for o, own in zip(ranked, facts, strict=True) if own == f] for f in {*facts}]
    assert all(own == sorted(own) for own in lengths)
    assert any(own[0] < own[-1] for own in lengths)  # there is something to order
    assert len({one.tobytes() for one in ranked}) == len(ranked)


def test_a_study_whose_conditions_are_alike_is_refused() -> None:
    with pytest.raises(InputError, match=r"conditions=.*differ on average by one message"):
        study_plan(
            compose_config(
                "study",
                [
                    *("seed=0", "observers.points=50", "trace.candidates=5"),
                    "conditions.personalized={_target_: xplain.solvers.greedy.Conformant}",
                ],
            )
        )


def test_places_have_letters_and_numbers_and_phrases_their_words() -> None:
    in_words = phrases_of({"first aid": "kit", "first": "1st", "north": "drives north"}, True)
    assert in_words("picks up the first aid") == "picks up the kit"
    assert in_words("moves to (2, 3)") == "moves to D3"
    assert in_words("a goal in row 6, column 9") == "a goal in J7"
    assert in_words("northern") == "northern"
    assert phrases_of({}, False)("moves to (2, 3)") == "moves to (2, 3)"
    assert [cell_name(0, c) for c in (0, 25, 26)] == ["A1", "Z1", "AA1"]
