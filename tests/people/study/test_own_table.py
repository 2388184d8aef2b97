"""A study on a lab's own table of transitions, with images and found types, without a map."""

import base64
import io
import re
from copy import deepcopy
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import DictConfig, OmegaConf
from PIL import Image

from tests.people.street import bot_of
from tests.people.visitors import Opened, differences, newcomer, pages, take_part
from xplain import Explainer
from xplain.cli.people import load_config
from xplain.errors import InputError
from xplain.explanation.anybody import Open
from xplain.explanation.belief import NO_FIT
from xplain.explanation.message_sets import mask_of
from xplain.learning.labelers import TableLabeler
from xplain.learning.saved import LearnedTypes
from xplain.people.study.flow import Study
from xplain.people.study.plan import StudyPlan
from xplain.people.study.prepare import study_plan
from xplain.people.study.tables import fit_of, glance, tables


def pixels(picture: bytes) -> bytes:
    """Returns the visible pixels of a picture."""
    return Image.open(io.BytesIO(picture)).convert("RGBA").tobytes()


PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)
WHEN = ("cable", "lift", "queue", "cable;lift", "queue", "")
FACTS = ("cable", "lift", "queue")
TRACE = [6, 1, 3, 4, 5]
GIVEN = {
    "transitions": "own.csv",
    "facts": "facts.csv",
    "types": "types.npz",
    "briefing": "none",
    "trace.rows": [[1, 2, 1, 2, 1], TRACE],
    "trace.min_steps": "5",
    "seed": "1",
}


def sense(row: int, wrong: set[str]) -> int:
    """Returns the label of a person who believes these facts incorrectly, by the table."""
    return int(not wrong & {*WHEN[row].split(";")})


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Writes two tables, an image, and the types of people who believe one fact incorrectly
    each."""
    rows = [f"Step {i} & <more>,{when},{i}," for i, when in enumerate(WHEN)]
    rows[0] += "red.png,A red cable"
    rows[1:] = [f"{row}," for row in rows[1:]]
    own = "\n".join(["text,inexplicable_if,place,image,alt", *rows])
    (tmp_path / "own.csv").write_text(f"{own}\n")
    said = [f"{fact},The  {fact} is so.,The {fact} is not so." for fact in FACTS]
    (tmp_path / "facts.csv").write_text("\n".join(["fact,message,belief", *said]) + "\n")
    (tmp_path / "red.png").write_bytes(PIXEL)
    save_types(tmp_path / "types.npz", "place")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def save_types(
    path: Path, feature: str, messages: tuple[str, ...] = FACTS, facts: bool = False
) -> None:
    features = np.arange(len(WHEN), dtype=np.float32)[:, None]
    told = [{f for j, f in enumerate(FACTS) if mask >> j & 1} for mask in range(8)]
    *labelers, everything = [
        TableLabeler(
            rows=features,
            values=np.array(
                [[0.01 + 0.98 * sense(row, wrong - one) for one in told] for row in range(6)]
            ),
            n_messages=3,
        )
        for wrong in (*({fact} for fact in FACTS), {*FACTS})
    ]
    names = tuple(f"{fact}?" for fact in FACTS)
    known: dict[str, Any] = {"wrong": (1, 2, 4), "about_everything": everything} if facts else {}
    LearnedTypes(tuple(labelers), names, np.full(3, 1 / 3), messages, (feature,), **known).save(
        path
    )


@cache
def composed(*words: str) -> DictConfig:
    given = [f"{key}={value}" for key, value in GIVEN.items()]
    return load_config("study", [*given, *words])


def plan_of(*words: str, **changes: Any) -> StudyPlan:
    """Makes the plan of the lab's study with these choices and values."""
    cfg = deepcopy(composed(*words))
    for key, value in changes.items():
        OmegaConf.update(cfg, key, value)
    return study_plan(cfg)


def test_the_plan_is_what_the_table_says(lab: Path) -> None:
    plan = plan_of()
    problem = plan.problem
    rows = [row - 1 for row in TRACE]
    assert plan.trace == tuple(f"Step {row} & <more>" for row in rows)
    assert (plan.scene, plan.path, plan.ahead) == (None, None, None)
    assert problem.type_names == ("cable?", "lift?", "queue?", "none of these")
    assert [clip.picture and clip.picture.alt for clip in plan.shown] == [
        "A red cable" if row == 0 else None for row in rows
    ]
    assert [fact.message for fact in plan.facts] == [f"The {fact} is so." for fact in FACTS]
    for kind, wrong in enumerate(plan.kinds):
        held = {FACTS[j] for j in wrong}
        for (k, row), told in product(enumerate(rows), ([], ["lift"], ["cable", "queue"])):
            label = plan.true_labels[kind, k, mask_of(told, FACTS)]
            assert label == sense(row, held - {*told})
    for number, fact in enumerate(FACTS):
        for p in problem.p_explicable[problem.as_found & (problem.whose == number)]:
            assert [int(one) for one in p[:, 0] > 0.5] == [sense(row, {fact}) for row in rows]
    # Whole sentences, the practice's too.
    assert plan.example.action.startswith("The robot ")
    assert plan.texts.words["robot_does"] == "{phrase}"


def test_people_see_sentences_and_images_and_the_log_replays(lab: Path, opened: Opened) -> None:
    flow = Study.of(plan_of())
    store = opened(flow)
    visitor = newcomer(store)
    seen = list(pages(visitor, bot_of(flow, 0), *store.invite(1, "person")))
    assert [page.stage for _, page in seen] == [
        *("consent", "briefing", "briefing", "practice", "practice", *["evaluation"] * 5),
        *("quiz", "done"),
    ]
    steps = [html for html, page in seen if page.stage == "evaluation"]
    for k, (row, html) in enumerate(zip(TRACE, steps, strict=True)):
        assert f"Step {row - 1} &amp; &lt;more&gt;" in html
        assert "The robot Step" not in html
        images = re.findall(r'<img class="clip" src="([^"]*)" alt="([^"]*)"', html)
        assert images == ([(f"/picture/{k}", "A red cable")] if row == 1 else [])
        for address, _ in images:
            reply = visitor.client.get(address)
            assert (pixels(reply.data), reply.headers["content-type"]) == (
                pixels(PIXEL),
                "image/png",
            )
    assert differences(store) == []


def test_whom_no_type_fits_is_in_the_export_and_on_the_researchers_page(
    lab: Path, opened: Opened
) -> None:
    save_types(lab / "types.npz", "place", facts=True)
    flow = Study.of(plan_of("belief=open"))
    assert flow.plan.problem.type_names[-1] == "none of these"
    explainer = Explainer(LearnedTypes.load(lab / "types.npz"), belief_update=Open("learned"))
    beliefs = explainer.session([[row - 1] for row in TRACE]).belief
    known = flow.plan.problem.type_belief(flow.plan.problem.start)
    np.testing.assert_allclose([*beliefs.values()], known)
    store, fits = opened(flow), []
    for who, noise in enumerate((0.0, 0.5)):
        assert take_part(store, [bot_of(flow, who, label_noise=noise)]) == ["done"]
        fits.append(fit_of(flow.plan, store.present()[who].state))
    assert fits[0] > NO_FIT > fits[1]
    written = tables(flow.plan, store.present())
    assert [row["fit"] for row in written["participants"]] == fits
    assert "questions" not in written
    seen = glance(flow, store.present())
    assert (seen["fits"], seen["unfit"]) == (2, 1)


def test_rows_of_the_table_are_asked_about_with_their_images(lab: Path, opened: Opened) -> None:
    """Every row is a possible question, those of the trace first; the bot judges the row on the
    page."""
    plan = plan_of("ask=clips", **{"ask.cost": 0.02})
    rows = [int(clip.phrase.split()[1]) for clip in plan.clips]
    told = plan.clip_labels.array(len(FACTS))
    for kind, wrong in enumerate(plan.kinds):
        held = {FACTS[j] for j in wrong}
        for (q, row), facts in product(enumerate(rows), ([], ["lift"], ["cable", "queue"])):
            assert told[kind, q, mask_of(facts, FACTS)] == sense(row, held - {*facts})
    assert [clip.picture is not None for clip in plan.clips] == [row == 0 for row in rows]
    questions = plan.problem.questions
    trace = [row - 1 for row in TRACE]
    assert questions.shows.tolist() == [[row == step for step in trace] for row in rows]
    store, asked = opened(Study.of(plan)), 0
    for number, token in enumerate(store.invite(9, "person")):
        visitor = newcomer(store)
        for html, page in pages(visitor, bot_of(store.flow, number), token):
            if page.stage != "asking":
                continue
            asked, (clip,) = asked + 1, page.steps
            assert f"Step {rows[clip]} &amp; &lt;more&gt;" in html
            images = re.findall(r'<img class="clip" src="([^"]*)" alt="([^"]*)"', html)
            assert [alt for _, alt in images] == ["A red cable"] * (rows[clip] == 0)
            for address, _ in images:
                assert pixels(visitor.client.get(address).data) == pixels(PIXEL)
    assert asked
    assert differences(store) == []


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ("ask=beliefs", r"ask\.kinds=\['beliefs'\]: clips in a study"),
        ("domain=rescue", r"domain='rescue': null with transitions"),
        ({"briefing": "assigned"}, r"briefing='assigned': none for your own transitions"),
        ({"types": None}, r"types=None: types\.npz of xplain discover"),
        ({"facts": None}, r"facts=None: a \.csv file"),
        ({"transitions": None}, r"facts='facts\.csv': only with transitions"),
        ({"transitions": None, "facts": None, "types": None}, r"trace\.rows=.*: only with trans"),
        ({"trace.rows": []}, r"trace\.rows=\[\]: lists of rows of the table.* from 1 to 6"),
        ({"trace.rows": [[1, 0]]}, r"trace\.rows=0: lists of rows"),
        ({"trace.rows": [[1, 7]]}, r"trace\.rows=7: lists of rows"),
        ({"trace.rows": [1, 2]}, r"trace\.rows=.*: lists of rows"),
        ({"trace.rows": [[1, 2]]}, r"trace\.min_steps=5: 2 steps or fewer"),
        ({"trace.rows": [[6, 6, 6, 6, 6]]}, r"conditions=.* differ on average by one message"),
        ("+wording.facts.lamp.belief=x", r"wording\.facts\.lamp"),
        ({"types": "others.npz"}, r"types='others\.npz: lane': types with the features"),
        ({"types": "fewer.npz"}, r"types='fewer\.npz: a, b, c': types with the messages"),
    ],
)
def test_what_does_not_go_together_is_refused_with_what_to_do(
    lab: Path, changes: str | dict[str, Any], said: str
) -> None:
    save_types(lab / "others.npz", "lane")
    save_types(lab / "fewer.npz", "place", ("a", "b", "c"))
    with pytest.raises(InputError, match=said):
        plan_of(changes) if isinstance(changes, str) else plan_of(**changes)


def test_a_trace_that_tells_more_goes_first_and_is_cut_where_traces_end(lab: Path) -> None:
    rows = {"trace.rows": [[6, 6, 6, 6, 6, 6], [6, 1, 3, 4, 5, 2], [1, 6, 6, 6, 6]]}
    assert len(plan_of(**rows, max_steps=5).trace) == 5
    assert plan_of(**rows).trace[1] == "Step 0 & <more>"
