"""The steps of docs/collect.md in a real Chromium: from an empty folder with a lab's own images to
labels, types, a robot, and a study of these types. axe-core checks every page, and a picture of it
is saved (``outputs/study/screenshots/lab``; ``XPLAIN_SCREENSHOTS`` names another folder)."""

from pathlib import Path

import pytest
from PIL import Image

from tests.chromium import Driver, go_in, take_part, wait
from tests.conftest import Run
from tests.people.server_process import ServerProcess
from tests.people.street import FAULTLESS_OBSERVER, bot_of
from tests.people.test_browser import axe as axe
from tests.people.test_browser import complaints, look_at, out_of_sight
from xplain import Explainer, LearnedTypes
from xplain.experiment.config import CONF
from xplain.people.bots import Page, Researcher
from xplain.people.collect.bot import bot
from xplain.people.collect.plan import CollectPlan
from xplain.people.study.flow import Study
from xplain.people.study.plan import StudyPlan

pytestmark = pytest.mark.browser

STEPS = """\
Drives over the cable,cable,0,A cable on the floor
Takes the lift to the next floor,lift,1,An open lift
Waits at the door although it is open,queue,2,An open door
Drives over the cable to the lift,cable;lift,3,A cable before a lift
Lets everybody pass before it,queue,4,People in a corridor
Drives along the empty corridor,,5,An empty corridor
"""
FACTS = """\
fact,message,belief
cable,The robot may drive over cables.,Cables stop the robot.
lift,The lift is faster than the ramp.,The ramp is faster than the lift.
queue,People always come first.,The robot need not wait for people.
"""
OURS = """\
introduction:
  - "A delivery robot drives through our house. It takes parcels from door to door."
"""
ATTENTION = 'attention: "The robot turns on the spot for an hour, while the parcels wait."\n'
LIMITS = ("server.blinded=false",)


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """Makes a folder with two tables, images, and the lab's own texts."""
    rows = [f"{line},{i}.png" for i, line in enumerate(STEPS.splitlines())]
    own = "\n".join(["text,inexplicable_if,step,alt,image", *rows])
    (tmp_path / "own.csv").write_text(f"{own}\n", encoding="utf-8")
    (tmp_path / "facts.csv").write_text(FACTS, encoding="utf-8")
    for i in range(len(rows)):
        Image.new("L", (320, 240), 40 * i).save(tmp_path / f"{i}.png")
    for kind, more in (("collect", ATTENTION), ("study", "")):
        texts = tmp_path / "texts" / kind / "texts"
        texts.mkdir(parents=True)
        shipped = (CONF / kind / "texts" / "en.yaml").read_text(encoding="utf-8")
        (texts / "ours.yaml").write_text(OURS + more + shipped, encoding="utf-8")
    return tmp_path


def serving(command: str, database: Path, *words: str) -> ServerProcess:
    own = ("transitions=own.csv", "facts=facts.csv", "hydra.searchpath=[texts]")
    return ServerProcess(
        database, *own, f"{command}/texts@wording=ours", *words, *LIMITS, command=command
    )


class Looking:
    """Looks at the first two pages of every stage, at both widths."""

    def __init__(self, driver: Driver, axe: str, of: str) -> None:
        self.driver, self.axe, self.of = driver, axe, of
        self.seen: dict[str, int] = {}
        self.alts: set[str] = set()
        self.below: dict[str, float] = {}

    def __call__(self, page: Page) -> None:
        count = self.seen[page.stage] = self.seen.get(page.stage, 0) + 1
        images = self.driver.find_elements("css selector", "img.clip")
        loaded = "return arguments[0].complete && arguments[0].naturalWidth"
        for image in images:
            wait(lambda one=image: self.driver.execute_script(loaded, one) == 320)  # type: ignore[misc]
            self.alts.add(str(image.get_attribute("alt")))
        if page.stage in ("clips", "practice", "ahead", "evaluation"):
            below, _ = out_of_sight(self.driver)
            self.below[page.stage] = max(below, self.below.get(page.stage, 0))
        if count <= 2:
            look_at(self.driver, self.axe, f"lab/{self.of}-{page.stage}-{count}")


def test_a_lab_goes_from_an_empty_folder_to_a_robot_and_a_study(
    driver: Driver, axe: str, lab: Path, run: Run
) -> None:
    people, database = lab / "people.sqlite", lab / "study.sqlite"
    with serving("collect", people, "points=8", "rules.people=8") as server:
        researcher = Researcher(server.url, server.key)
        look = Looking(driver, axe, "collect")
        go_in(driver, server.url, researcher.invite(1, "person")[0])
        observer = bot(researcher.plan(CollectPlan), FAULTLESS_OBSERVER, 0, 0)
        assert take_part(driver, observer, look=look) == "done"
        assert look.seen["clips"] == 8 + 2 + 1
        assert look.alts <= {line.rsplit(",", 1)[1] for line in STEPS.splitlines()}
        assert len(look.alts) > 2
        assert max(look.below.values()) <= 0, look.below
        run("collect bots", "--url", server.url, "--key", server.key, "--count", 8)
    run("collect export", people, "data")
    assert "all equal" in run("collect replay", people)[1]
    known = [
        "labeler=hypotheses",
        "hypotheses=data/hypotheses.npz",
        "sentences=data/sentences.yaml",
    ]
    run("discover", "data=data/labels_bot.csv", *known)

    types = LearnedTypes.load(lab / "outputs/discover/types.npz")
    session = Explainer(types, trade_off=0.5).session([[0.0], [3.0]])
    assert set(session.messages()) <= {"cable", "lift", "queue"}

    found = ("types=outputs/discover/types.npz", "briefing=none")
    # With lambda=2 the conditions differ by two messages, whatever types these people make.
    trace = ("trace.rows=[[6,1,3,4,5]]", "trace.min_steps=5", "lambda=2")
    with serving("study", database, *found, *trace) as server:
        researcher = Researcher(server.url, server.key)
        look = Looking(driver, axe, "study")
        go_in(driver, server.url, researcher.invite(1, "person")[0])
        person = bot_of(Study.of(researcher.plan(StudyPlan)), 0)
        assert take_part(driver, person, look=look) == "done"
        assert look.seen["evaluation"] == 5
        assert len(look.alts) == 5
        assert max(look.below.values()) <= 0, look.below
    assert complaints(driver) == []
    assert "all equal" in run("study replay", database)[1]
