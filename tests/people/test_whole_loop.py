"""The whole method with simulated people: labels over the pages, types, and a study without a
briefing, whose policies know only these types."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.conftest import Run
from tests.people.study.stand_in import FAULTLESS
from tests.people.visitors import take_part
from xplain.cli.main import main
from xplain.errors import InputError
from xplain.experiment.config import compose_config
from xplain.learning.saved import LearnedTypes
from xplain.people.collect.bot import Habits, bot
from xplain.people.collect.flow import Collection
from xplain.people.collect.plan import CollectRules
from xplain.people.collect.prepare import assemble, material_of
from xplain.people.collect.tables import export
from xplain.people.material import select_plan_keys
from xplain.people.store import Store
from xplain.people.study.bot import StudyBot
from xplain.people.study.flow import Study
from xplain.people.study.plan import StudyPlan
from xplain.people.study.prepare import study_plan
from xplain.questions.designs import Adaptive


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the tables of 10 people × 20 adaptive questions at 5 % wrong answers."""
    folder = tmp_path_factory.mktemp("labels")
    cfg = compose_config("collect", [])
    plan = assemble(
        material_of(cfg),
        Adaptive(),
        CollectRules(points=20, **select_plan_keys(cfg)["rules"]),
        select_plan_keys(cfg),
    )

    with closing(Store(folder / "c.sqlite", Collection(plan))) as store:
        people = (bot(plan, Habits(error=0.05), 1, number) for number in range(10))
        assert {*take_part(store, people, "bot")} == {"done"}
    export(folder / "c.sqlite", folder)
    return folder


@pytest.fixture(scope="module")
def types(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Finds the types in these labels; returns their file."""
    folder = tmp_path_factory.mktemp("found")
    given = (f"data={data}/labels_bot.csv", f"hypotheses={data}/hypotheses.npz", "held_out=false")
    main(["discover", *given, "labeler=hypotheses", f"output={folder}"])
    return folder / "types.npz"


def planned(types: Path, *arguments: str) -> StudyPlan:
    return study_plan(compose_config("study", [f"types={types}", "seed=0", *arguments]))


def test_people_as_they_are_get_fewer_messages_by_the_types_that_were_found(
    types: Path, tmp_path: Path, run: Run
) -> None:
    plan = planned(types, "briefing=none")
    assert plan.problem.type_names[:-1] == LearnedTypes.load(types).names
    assert [role.briefing for role in plan.roles] == [()]
    path = tmp_path / "study.sqlite"

    with closing(Store(path, Study.of(plan))) as store:
        rngs = map(np.random.default_rng, range(10))
        assert {*take_part(store, (StudyBot(plan, FAULTLESS, r) for r in rngs), "bot")} == {"done"}
    assert "all equal" in run("study replay", path)[1]
    run("study export", path, "out")
    assert "Messages" in run("study analyse", "out", "--stream", "bot")[1]
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
