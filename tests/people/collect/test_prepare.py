"""From configuration to a plan: own transitions, images, lists, and errors."""

import base64
import io
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from sklearn.metrics import adjusted_rand_score

from tests.people.bare_flow import crowd, truth_of
from xplain.cli.people import load_config
from xplain.errors import InputError
from xplain.experiment.config import CONF, compose_config
from xplain.explanation.message_sets import mask_of
from xplain.people.collect.bot import Habits
from xplain.people.collect.plan import CollectPlan
from xplain.people.collect.prepare import collect_plan
from xplain.people.collect.tables import fact_sets
from xplain.people.material import read_own_table

TABLE = """text,image,alt,inexplicable_if,floor,place
Drives over the cable,cable.png,A red cable,cable,0,hall
Takes the lift,,,lift;queue,1,hall
Waits at the door,,,queue,0,door
Goes around the cable,,,,0,hall
"""
FACTS = """fact,message,belief
cable,The robot may drive over cables.,Cables stop the robot.
lift,The lift is fast.,The lift is slow.
queue,People let the robot pass.,The robot has to queue.
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "lab"
    folder.mkdir()
    (folder / "own.csv").write_text(TABLE)
    (folder / "facts.csv").write_text(FACTS)
    Image.new("RGB", (8, 6), "red").save(folder / "cable.png")
    return folder


def test_own_transitions_become_a_task(folder: Path) -> None:
    source = read_own_table(folder / "own.csv", str(folder / "facts.csv"), 0)
    known = source.hypotheses
    assert known.feature_names == ("floor", "place=door", "place=hall")
    assert known.features.tolist() == [[0, 0, 1], [1, 0, 1], [0, 1, 0], [0, 0, 1]]
    assert [fact.name for fact in source.facts] == ["cable", "lift", "queue"]
    assert [clip.picture is not None for clip in source.clips] == [True, False, False, False]
    assert source.types
    held = [mask_of(one.inaccurate, known.messages) for one in source.types]
    assert all(one in known.essential for one in held)
    assert [clip.picture.alt for clip in source.clips if clip.picture] == ["A red cable"]
    # People who believe one of its facts incorrectly find a step inexplicable.
    assert known.labels[known.row(np.array(0b010)), 1] == 0
    assert known.labels[known.row(np.array(0b001)), 1] == 1


NO_PICTURES = ("page", "empty", "wide", "bomb", "link", "../up")


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("facts.csv", FACTS.replace("lift,", "elevator,"), "facts='lift'"),
        ("facts.csv", FACTS.replace("The lift is slow.", ""), "facts='lift'"),
        ("own.csv", TABLE.replace("cable.png", "nowhere.png"), "nowhere.png"),
        ("own.csv", TABLE.replace("cable.png", "cable.svg"), "a picture"),
        ("own.csv", TABLE.replace("0,door", ",door"), "floor.*missing in 1 rows"),
        ("own.csv", TABLE.replace("0,door", "inf,door"), "infinite in 1 rows of floor"),
        *(
            ("own.csv", TABLE.replace("cable.png", f"{name}.png"), r"transitions\.image")
            for name in NO_PICTURES
        ),
    ],
)
def test_what_is_wrong_with_ones_own_table_is_named(
    folder: Path, file: str, content: str, said: str
) -> None:
    """What is no picture of the folder is refused; of a picture with too many pixels only the
    header is read: decoding 60,000 × 60,000 pixels would take 10 GB."""
    (folder / "page.png").write_text("<html><script>alert(1)</script></html>")
    (folder / "empty.png").write_bytes(b"")
    Image.new("1", (60_000, 10)).save(folder / "wide.png")
    Image.new("1", (8, 8)).save(folder / "bomb.png")
    data = bytearray((folder / "bomb.png").read_bytes())
    data[16:24] = (60_000).to_bytes(4, "big") * 2
    data[29:33] = zlib.crc32(bytes(data[12:29])).to_bytes(4, "big")
    (folder / "bomb.png").write_bytes(bytes(data))
    Image.new("RGB", (4, 4)).save(folder.parent / "up.png")
    (folder / "link.png").symlink_to(folder.parent / "up.png")
    (folder / file).write_text(content)
    with pytest.raises(InputError, match=said):
        read_own_table(folder / "own.csv", str(folder / "facts.csv"), 0)


def test_pixels_are_kept_and_where_they_were_taken_is_not(folder: Path) -> None:
    exif = Image.Exif()
    exif[0x010E] = "taken at home"
    exif[0x8825] = {1: "N", 2: (52.0, 30.0, 0.0)}
    Image.new("RGB", (40, 30), "red").save(folder / "a.jpg", exif=exif, comment=b"by Ann")
    assert b"taken at home" in (folder / "a.jpg").read_bytes()
    (folder / "own.csv").write_text(TABLE.replace("cable.png", "a.jpg"))
    clip = read_own_table(folder / "own.csv", str(folder / "facts.csv"), 0).clips[0]
    picture = Image.open(io.BytesIO(base64.b64decode(clip.picture.content)))
    assert (picture.size, picture.format) == ((40, 30), "JPEG")
    assert not picture.getexif()
    assert "comment" not in picture.info
    assert picture.getpixel((20, 15))[0] > 250  # type: ignore[index]


OWN_TEXTS = """introduction: [A delivery robot drives through our house.]
attention: The robot waits for an hour before a wall.
"""


@pytest.mark.parametrize("more", [[], ["domain=null"]])
def test_of_ones_own_table_no_domain_s_words_are_told(folder: Path, more: list[str]) -> None:
    table = [f"transitions={folder / 'own.csv'}", f"facts={folder / 'facts.csv'}", *more]
    task = load_config("collect", ["domain=rescue"]).wording.introduction
    own = load_config("collect", table).wording
    assert own.introduction != task
    assert "rescue" not in str(own)
    assert not own.icons
    (folder / "collect" / "texts").mkdir(parents=True)
    english = (CONF / "collect" / "texts" / "en.yaml").read_text(encoding="utf-8")
    (folder / "collect" / "texts" / "ours.yaml").write_text(english + OWN_TEXTS)
    ours = [f"hydra.searchpath=[{folder}]", "collect/texts@wording=ours"]
    for arguments in ([*table, *ours], ["domain=rescue", *ours]):
        said = load_config("collect", arguments).wording
        assert (said.introduction, said.attention) == (
            ["A delivery robot drives through our house."],
            "The robot waits for an hour before a wall.",
        )


@pytest.mark.parametrize(
    "arguments", [["domain=null"], ["domain=rescue", "transitions=own.csv", "facts=facts.csv"]]
)
def test_a_task_is_either_a_domain_or_a_table(arguments: list[str]) -> None:
    with pytest.raises(InputError, match="domain="):
        load_config("collect", arguments)


def rand_index(plan: CollectPlan, people: int, error: float, seed: int) -> float:
    """Finds the types of simulated people in their labels; returns the adjusted Rand index."""
    facts, _ = fact_sets(plan, crowd(plan, people, Habits(error=error), seed))
    return float(adjusted_rand_score(truth_of(plan, people), facts))


@pytest.mark.slow
@pytest.mark.parametrize(("domain", "types"), [("rescue", 5), ("four_rooms", 3)])
def test_24_people_and_20_questions_find_the_types(domain: str, types: int) -> None:
    """The docs promise an adjusted Rand index of at least 0.95 with 5 % wrong answers."""
    plan = collect_plan(compose_config("collect", [f"domain={domain}"]))
    assert len(plan.roles) == types
    found = [rand_index(plan, 24, 0.05, seed) for seed in range(100, 105)]
    assert min(found) >= 0.9
    assert np.mean(found) >= 0.95
