"""A collection of labels in a real Chromium: a few observers; axe-core checks every page, and a
picture of it is saved (``outputs/study/screenshots/collect``; ``XPLAIN_SCREENSHOTS`` names another
folder)."""

from dataclasses import replace

import numpy as np
import pytest

from tests.chromium import (
    Driver,
    answer,
    go_in,
    log_in_and_invite,
    resize,
    take_part,
    wait,
)
from tests.conftest import Run
from tests.people.server_process import running
from tests.people.street import at_work, bot_of, street_collection
from tests.people.test_browser import axe as axe
from tests.people.test_browser import complaints, look_at
from tests.people.visitors import GENEROUS, Opened, differences
from xplain.experiment.config import compose_config
from xplain.people.bots import Page
from xplain.people.collect.flow import Collection
from xplain.people.collect.prepare import collect_plan
from xplain.people.web import create_app
from xplain.questions.designs import Adaptive

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def rescue() -> Collection:
    """Makes a collection of the rescue task with clips of two steps and the lab's questions."""
    questions = (
        "wording.questions=[{name: age, label: Your age, kind: number, low: 18, high: 110},"
        "{name: comment, label: 'Was anything unclear?', kind: text}]"
    )
    few = ("points=8", "rules.listening=2", "queries.clip=2")
    return at_work(collect_plan(compose_config("collect", [*few, questions])))


def test_every_page_is_accessible_and_is_photographed(
    driver: Driver, axe: str, rescue: Collection, opened: Opened, run: Run
) -> None:
    store, seen = opened(rescue), dict[str, int]()
    key = store.researcher_key
    with running(create_app(store, GENEROUS)) as url:

        def look(page: Page) -> None:
            count = seen[page.stage] = seen.get(page.stage, 0) + 1
            if page.stage != "clips" or count < 3 or not page.steps:
                look_at(driver, axe, f"collect/{page.stage}-{count:02d}")

        go_in(driver, url, *store.invite(1, "pilot"))
        person = bot_of(rescue, 0)
        assert take_part(driver, person, look=look) == "done"
        assert set(seen) == {*rescue.stages}
        assert complaints(driver) == []

        # Off the way: practice gone wrong, leaving, the researcher's page.
        go_in(driver, url, *store.invite(1, "pilot"))
        while (page := Page.of_html(driver.page_source)).stage != "practice":
            answer(driver, page, person.fill(page)[0])
        answer(driver, page, [("label", "1")])
        look_at(driver, axe, "collect/practice-wrong")
        driver.find_element("css selector", "details.leave summary").click()
        driver.find_element("css selector", "details.leave button").click()
        wait(lambda: "You have left" in driver.page_source)
        bots = ("collect bots", "--url", url, "--key", key, "--count")
        run(*bots, 4)
        driver.get(f"{url}/researcher")
        log_in_and_invite(driver, key, "Types found so far")
        look_at(driver, axe, "collect/researcher")
        driver.find_element("id", "count").clear()
        driver.find_element("id", "count").send_keys("7")
        run(*bots, 2)
        # It keeps itself up to date, and what is typed stays.
        wait(lambda: "</meter> 6</td>" in driver.page_source)
        assert driver.find_element("id", "count").get_attribute("value") == "7"


def test_under_three_messages_the_button_is_in_sight(
    driver: Driver, rescue: Collection, opened: Opened
) -> None:
    """This holds on a phone, also in the practice, in which the first answer to each half is
    wrong."""
    plan, rng = rescue.plan, np.random.default_rng(0)
    threes = [told for told in range(1 << len(plan.facts)) if told.bit_count() == 3]
    steps = rng.integers(plan.hypotheses.n_transitions, size=8)
    listed = tuple((int(step), int(rng.choice(threes))) for step in steps)
    store = opened(at_work(replace(plan, design=Adaptive(), questions=listed)))
    resize(driver, 390, 844, mobile=False)
    bottom = "return document.querySelector('main form button').getBoundingClientRect().bottom"
    with running(create_app(store, GENEROUS)) as url:
        below: dict[tuple[str, int], float] = {}

        def look(page: Page) -> None:
            if page.stage in ("practice", "ahead", "clips", "listening"):
                key = page.stage, len(page.messages)
                below[key] = max(driver.execute_script(bottom) - 844, below.get(key, -np.inf))

        go_in(driver, url, *store.invite(1, "bot"))
        assert take_part(driver, bot_of(store.flow, 0, mistake=1.0), look=look) == "done"
        seen = {("practice", 1), ("ahead", 0), ("clips", 3), ("listening", 0), ("listening", 1)}
        assert seen <= below.keys()
        assert max(below.values()) <= 0, below


def test_the_facts_of_people_who_answer_in_a_browser_are_found(
    driver: Driver, opened: Opened
) -> None:
    store = opened(street_collection())
    known = store.flow.plan.hypotheses
    with running(create_app(store, GENEROUS)) as url:
        for number, token in enumerate(store.invite(3, "bot")):
            go_in(driver, url, token)
            assert take_part(driver, bot_of(store.flow, number)) == "done"
    for role, one in zip(store.flow.plan.roles, store.present(), strict=True):
        belief = one.state.belief
        best = max((facts for facts in belief if facts != "none"), key=belief.__getitem__)
        assert int(best) == known.essential[known.row(np.array(role.held))]
    assert differences(store) == []
