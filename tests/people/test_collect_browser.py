"""A collection of labels in a real Chromium: a few observers; axe-core checks every page, and a
picture of it is saved (``outputs/study/screenshots/collect``; ``XPLAIN_SCREENSHOTS`` names another
folder)."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.chromium import Driver, answer, choose, go_in, log_in_and_invite, press, take_part, wait
from tests.conftest import Run
from tests.people.collect.stand_in import FAULTLESS, at_work, street_collection
from tests.people.server_process import ServerProcess
from tests.people.test_browser import axe as axe
from tests.people.test_browser import complaints, look_at, moved_on
from xplain.experiment.config import compose_config
from xplain.people.bots import Page, Researcher
from xplain.people.collect.bot import bot
from xplain.people.collect.flow import Collection
from xplain.people.collect.plan import CollectRules
from xplain.people.collect.prepare import assemble, material_of
from xplain.people.material import select_plan_keys
from xplain.people.store import Store
from xplain.questions.designs import Adaptive

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def rescue() -> Collection:
    """Makes a collection of the rescue task with clips of two steps and the lab's questions."""
    questions = (
        "wording.questions=[{name: age, label: Your age, kind: number, low: 18, high: 110},"
        "{name: comment, label: 'Was anything unclear?', kind: text}]"
    )
    cfg = compose_config("collect", ["points=8", questions])
    config = select_plan_keys(cfg)
    rules = CollectRules(points=8, **config["rules"] | {"listening": 2})
    plan = assemble(material_of(cfg), Adaptive(clip=2), rules, config)
    return at_work(plan)


def serving(path: Path, collection: Collection) -> ServerProcess:
    Store(path, collection).close()
    limits = ("server.burst=1e6", "server.visitor_burst=1e6")
    return ServerProcess(path, *limits, command="collect")


def test_every_page_is_accessible_and_is_photographed(
    driver: Driver, axe: str, rescue: Collection, tmp_path: Path, run: Run
) -> None:
    with serving(tmp_path / "c.sqlite", rescue) as server:
        researcher = Researcher(server.url, server.key)
        seen: dict[str, int] = {}

        def look(page: Page) -> None:
            count = seen[page.stage] = seen.get(page.stage, 0) + 1
            if page.stage != "clips" or count < 3 or not page.steps:
                look_at(driver, axe, f"collect/{page.stage}-{count:02d}")

        go_in(driver, server.url, researcher.invite(1, "pilot")[0])
        person = bot(rescue.plan, FAULTLESS, 0, 0)
        assert take_part(driver, person, look=look) == "done"
        assert set(seen) == {*rescue.stages}
        assert complaints(driver) == []

        # Off the way: practice gone wrong, leaving, the researcher's page.
        go_in(driver, server.url, researcher.invite(1, "pilot")[0])
        while (page := Page.of_html(driver.page_source)).stage != "practice":
            answer(driver, page, person.fill(page)[0])
        answer(driver, page, [("label", "1")])
        look_at(driver, axe, "collect/practice-wrong")
        driver.find_element("css selector", "details.leave summary").click()
        driver.find_element("css selector", "details.leave button").click()
        wait(lambda: "You have left" in driver.page_source)
        bots = ("collect bots", "--url", server.url, "--key", server.key, "--count")
        run(*bots, 4)
        driver.get(f"{server.url}/researcher")
        log_in_and_invite(driver, server.key, "Types found so far")
        look_at(driver, axe, "collect/researcher")
        driver.find_element("id", "count").clear()
        driver.find_element("id", "count").send_keys("7")
        run(*bots, 2)
        # It keeps itself up to date, and what is typed stays.
        wait(lambda: "</meter> 6</td>" in driver.page_source)
        assert driver.find_element("id", "count").get_attribute("value") == "7"


def test_under_three_messages_the_button_is_in_sight(
    driver: Driver, rescue: Collection, tmp_path: Path
) -> None:
    """This holds on a phone, also in the practice, in which the first answer to each half is
    wrong."""
    plan, rng = rescue.plan, np.random.default_rng(0)
    threes = [told for told in range(1 << len(plan.facts)) if told.bit_count() == 3]
    steps = rng.integers(plan.hypotheses.n_transitions, size=8)
    listed = tuple((int(step), int(rng.choice(threes))) for step in steps)
    collection = at_work(replace(plan, design=Adaptive(), questions=listed))
    phone = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", phone)
    bottom = "return document.querySelector('main form button').getBoundingClientRect().bottom"
    with serving(tmp_path / "c.sqlite", collection) as server:
        below: dict[tuple[str, int], float] = {}

        def look(page: Page) -> None:
            if page.stage in ("practice", "ahead", "clips", "listening"):
                key = page.stage, len(page.messages)
                below[key] = max(driver.execute_script(bottom) - 844, below.get(key, -np.inf))

        go_in(driver, server.url, Researcher(server.url, server.key).invite(1)[0])
        erring = replace(FAULTLESS, mistake=1.0)
        assert take_part(driver, bot(collection.plan, erring, 0, 0), look=look) == "done"
        seen = {("practice", 1), ("ahead", 0), ("clips", 3), ("listening", 0), ("listening", 1)}
        assert seen <= below.keys()
        assert max(below.values()) <= 0, below


def test_the_facts_of_people_who_answer_in_a_browser_are_found(
    driver: Driver, tmp_path: Path, run: Run
) -> None:
    """The first of them loses the network for a while, and no label."""
    collection = street_collection()
    plan, path = collection.plan, tmp_path / "c.sqlite"
    with serving(path, collection) as server:
        for number, invitation in enumerate(Researcher(server.url, server.key).invite(3, "bot")):
            person = bot(plan, FAULTLESS, 0, number)
            go_in(driver, server.url, invitation)
            while number == 0 and (page := Page.of_html(driver.page_source)).stage != "clips":
                answer(driver, page, person.fill(page)[0])
            if number == 0:
                server.kill()
                choose(driver, person.fill(page)[0])
                press(driver)
                wait(lambda: "kept on your device" in driver.find_element("id", "connection").text)
                server.start()
                wait(lambda before=page.hidden["sequence"]: moved_on(driver, before), 40)
                after = Page.of_html(driver.page_source)
                assert int(after.hidden["sequence"]) == int(page.hidden["sequence"]) + 1
            assert take_part(driver, person) == "done"
    assert "all equal" in run("collect replay", path)[1]
    store = Store(path, collection)
    for number, one in enumerate(store.present()):
        state = one.state
        held = plan.roles[number].held
        best = max((f for f in state.belief if f != "none"), key=lambda f: state.belief[f])
        assert int(best) == plan.hypotheses.essential[plan.hypotheses.row(np.array(held))]
    store.close()
