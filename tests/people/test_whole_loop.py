"""The whole method with simulated people: labels over the pages, types, and a study without a
briefing, whose policies know only these types."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.people.client import Client
from tests.people.study.stand_in import FAULTLESS
from tests.people.visitors import GENEROUS, Visitor
from xplain.cli.main import main
from xplain.errors import InputError
from xplain.experiment.config import compose_config
from xplain.learning.saved import LearnedTypes
from xplain.people.bots import Visitor as Bot
from xplain.people.bots import visit
from xplain.people.collect.bot import Habits, bot
from xplain.people.collect.flow import Collection
from xplain.people.collect.plan import CollectRules
from xplain.people.collect.prepare import assemble, material_of
from xplain.people.collect.tables import export
from xplain.people.flow import Flow
from xplain.people.material import select_plan_keys
from xplain.people.store import Store
from xplain.people.study.bot import StudyBot
from xplain.people.study.flow import Study
from xplain.people.study.plan import StudyPlan
from xplain.people.study.prepare import study_plan
from xplain.people.web import create_app
from xplain.questions.designs import Adaptive


def over_the_pages(
    path: Path, flow: Flow[Any, Any], count: int, person: Callable[[int], Bot]
) -> None:
    """Bots take part; the database is closed afterwards."""
    store = Store(path, flow)
    app = create_app(store, GENEROUS)
    for number, token in enumerate(store.invite(count, "bot")):
        assert visit(Visitor(Client(app)), person(number), token) == "done"
    store.close()


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Makes a folder with the tables of 15 people × 20 adaptive questions, with 5 % wrong
    answers."""
    folder = tmp_path_factory.mktemp("labels")
    cfg = compose_config("collect", [])
    plan = assemble(
        material_of(cfg),
        Adaptive(),
        CollectRules(points=20, **select_plan_keys(cfg)["rules"]),
        select_plan_keys(cfg),
    )

    def person(number: int) -> Bot:
        return bot(plan, Habits(error=0.05), 1, number)

    over_the_pages(folder / "c.sqlite", Collection(plan), 15, person)
    export(folder / "c.sqlite", folder)
    return folder


def found(data: Path, folder: Path, *arguments: str) -> Path:
    """Finds the types in these labels; returns their file."""
    given = (f"data={data}/labels_bot.csv", f"hypotheses={data}/hypotheses.npz", "held_out=false")
    main(["discover", *given, "labeler=hypotheses", f"output={folder}", *arguments])
    return folder / "types.npz"


@pytest.fixture(scope="module")
def types(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return found(data, tmp_path_factory.mktemp("found"))


def planned(types: Path, *arguments: str) -> StudyPlan:
    return study_plan(compose_config("study", [f"types={types}", "seed=0", *arguments]))


def test_people_as_they_are_get_fewer_messages_by_the_types_that_were_found(
    types: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = planned(types, "briefing=none")
    assert plan.problem.type_names[:-1] == LearnedTypes.load(types).names
    assert [role.briefing for role in plan.roles] == [()]
    path = tmp_path / "study.sqlite"

    def person(number: int) -> Bot:
        return StudyBot(plan, FAULTLESS, np.random.default_rng(number))

    over_the_pages(path, Study.of(plan), 10, person)
    main(["study", "replay", str(path)])
    assert "all equal" in capsys.readouterr().out
    main(["study", "export", str(path), str(tmp_path / "out")])
    main(["study", "analyse", str(tmp_path / "out"), "--stream", "bot"])
    assert "Messages" in capsys.readouterr().out
    people = pd.read_csv(tmp_path / "out" / "participants.csv")
    means = people.groupby("condition")[["messages_given", "inexplicable_transitions"]].mean()
    assert people.groupby("condition").size().tolist() == [5, 5]
    assert means["messages_given"]["personalized"] < means["messages_given"]["conformant"] - 1
    wrong = means["inexplicable_transitions"]
    assert wrong["personalized"] <= wrong["conformant"]


def test_types_that_were_found_are_for_people_as_they_are(types: Path) -> None:
    with pytest.raises(InputError, match=r"briefing='assigned': none with types"):
        planned(types)
    with pytest.raises(InputError, match=r"types=.*types with the messages of four_rooms"):
        planned(types, "domain=four_rooms", "briefing=none")
    with pytest.raises(InputError, match=r"briefing='some'"):
        planned(types, "briefing=some")
