"""A real Chromium: participants with a screen, with the keyboard, without network; axe-core checks
the pages.

Screenshots of every page, on a desktop and on a phone, are left in ``outputs/study/screenshots``
(``XPLAIN_SCREENSHOTS`` names another folder).
"""

import json
import os
import shutil
import subprocess
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock
from starlette.responses import Response

from tests.chromium import (
    Driver,
    answer,
    choose,
    go_in,
    log_in_and_invite,
    press,
    resize,
    sequence,
    take_part,
    wait,
)
from tests.people.server_process import ROOT, running, serving
from tests.people.street import ASKING, SCREENS, bot_of, flow_of
from tests.people.visitors import GENEROUS, Opened, differences, query
from xplain.experiment.config import compose_config
from xplain.people.bots import Bot, Page, Researcher
from xplain.people.store import Store
from xplain.people.study.flow import Study
from xplain.people.study.prepare import study_plan
from xplain.people.web import create_app

KEYBOARD = pytest.importorskip(
    "selenium.webdriver.common.keys", reason="selenium is not installed"
).Keys

pytestmark = pytest.mark.browser

SCREENSHOTS = Path(os.environ.get("XPLAIN_SCREENSHOTS", ROOT / "outputs/study/screenshots"))


@pytest.fixture(scope="module")
def axe(request: pytest.FixtureRequest) -> str:
    """Fetches axe-core's script from npm once, and keeps it in pytest's cache, not in the
    project."""
    folder = Path(request.config.cache.mkdir("axe-core"))
    with FileLock(folder / ".lock"):  # tests run in several processes
        if not list(folder.glob("axe-core-*.tgz")):
            if not shutil.which("npm"):
                pytest.skip("no npm here to fetch axe-core with")
            fetch = ["npm", "pack", "axe-core@4"]
            done = subprocess.run(fetch, cwd=folder, capture_output=True, text=True, timeout=120)
            if done.returncode:
                pytest.skip(f"npm could not fetch axe-core: {done.stderr.strip()[-200:]}")
    (archive,) = folder.glob("axe-core-*.tgz")
    with tarfile.open(archive) as content:
        script = content.extractfile("package/axe.min.js")
        return script.read().decode()


def learned(*changes: str) -> Study:
    """The rescue study, learned from few labels to save time."""
    return Study.of(
        study_plan(compose_config("study", ["seed=0", "observers.points=150", *changes]))
    )


def moved_on(driver: Driver, before: str) -> bool:
    """Returns True if another page is loaded completely."""
    return sequence(driver) not in (before, None)


def faults(driver: Driver, axe: str) -> list[str]:
    """Returns serious and critical findings of axe-core, by WCAG 2.2 A and AA and its best
    practices."""
    driver.execute_script(axe)
    found = driver.execute_async_script(
        "const done = arguments[0]; axe.run(document, {resultTypes: ['violations']}).then(done)"
    )
    assert found["passes"], "axe-core looked at nothing"
    return [
        f"{v['id']} ({v['impact']}): {v['help']}: {[n['html'][:120] for n in v['nodes']]}"
        for v in found["violations"]
        if v["impact"] in ("serious", "critical", "moderate")
    ]


def photograph(driver: Driver, name: str) -> None:
    """Photographs the whole page on a desktop and on a phone, and checks that nothing is too
    wide."""
    (SCREENSHOTS / name).parent.mkdir(parents=True, exist_ok=True)
    for width in (1280, 390):
        resize(driver, width, 700)
        resize(driver, width, driver.execute_script("return document.documentElement.scrollHeight"))
        # New messages fade in.
        driver.execute_script("document.getAnimations().forEach(one => one.finish())")
        driver.save_screenshot(str(SCREENSHOTS / f"{name}-{width}.png"))
        assert driver.execute_script("return document.documentElement.scrollWidth") <= width, name
    driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def complaints(driver: Driver) -> list[str]:
    """Returns errors in the browser's console, including violated content policies."""
    return [line["message"] for line in driver.get_log("browser") if line["level"] == "SEVERE"]


def look_at(driver: Driver, axe: str, name: str) -> None:
    assert faults(driver, axe) == [], name
    photograph(driver, name)


def preview(driver: Driver, url: str, key: str, cell: int) -> None:
    """Begins as a pilot participant of this type and condition, from the researcher's page."""
    driver.get(f"{url}/researcher")
    if driver.find_elements("id", "key"):
        driver.find_element("id", "key").send_keys(key)
        press(driver)
    wait(lambda: bool(driver.find_elements("id", "cell")))
    box = driver.find_element("id", "cell")
    driver.execute_script("arguments[0].value = arguments[1]", box, str(cell))
    box.find_element("xpath", "./ancestor::form//button").click()
    wait(lambda: sequence(driver) is not None)


# At once: a call of the driver for each of the thousands of clicks takes minutes.
SCROLLED = """
window.scrollTo({top: 0, behavior: 'instant'});
let total = 0;
for (const selector of arguments[0]) {
  const found = document.querySelector(selector);
  if (found.checked) continue;
  const y = found.getBoundingClientRect().top;  // whatever scrolls, the page or a list in it
  found.scrollIntoView({block: 'nearest', behavior: 'instant'});
  total += Math.abs(found.getBoundingClientRect().top - y);
}
return total;
"""
FILLED = """
for (const selector of arguments[0]) {
  const found = document.querySelector(selector);
  if (!found.checked) found.click();
}
"""
SIZES = (1920, 1080), (1280, 800), (390, 844)


def scrolled(
    driver: Driver, person: Bot[Any, Any], look: Callable[[Page], None]
) -> dict[int, float]:
    """Pixels that a participant scrolls in the evaluation, by the window's width: to every answer
    that they click, and to the button, no further than they have to. Every page is looked at."""
    total = {width: 0.0 for width, _ in SIZES}
    while (page := Page.of_html(driver.page_source)).hidden:
        look(page)
        targets = [f'input[name="{name}"][value="{v}"]' for name, v in person.fill(page)[0]][::-1]
        if page.stage == "evaluation":
            for width, height in SIZES:
                resize(driver, width, height, mobile=False)
                total[width] += driver.execute_script(SCROLLED, [*targets, "main form button"])
        driver.execute_script(FILLED, targets)
        answer(driver, page, [])
    look(page)
    assert page.stage == "done"
    return total


BELOW = """
window.scrollTo(0, 0);
const bottom = one => one.getBoundingClientRect().bottom;
const seen = [...document.querySelectorAll('.newest, .steps li, main form button')];
const news = [...document.querySelectorAll('.message.new')];
const end = document.querySelector('.said');
const hidden = end ? news.map(one => bottom(one) - bottom(end)) : [];
const spare = end ? bottom(end) - Math.max(...[...end.children].map(bottom)) : 0;
return [Math.max(...seen.map(bottom)), Math.max(0, ...hidden), spare];
"""


def out_of_sight(driver: Driver) -> tuple[float, float]:
    """Measures how far the new step or the next button is below the window: on a phone, on a small
    laptop, and there at 200 % zoom; and the part of the new messages that one sees only after
    scrolling, on the phone and with zoom."""
    below, cut_off = -np.inf, 0.0
    for width, height in ((390, 844), (1280, 720), (640, 360)):
        resize(driver, width, height)
        bottom, hidden, spare = driver.execute_script(BELOW)
        assert spare <= 1  # there is no room for messages that were not given
        below = max(below, bottom - height)
        cut_off = max(cut_off, hidden if width < 1280 else 0)
    driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    return below, cut_off


def test_every_page_is_accessible_in_sight_and_photographed(
    driver: Driver, axe: str, opened: Opened
) -> None:
    """In both conditions; over a whole study they differ in scrolling by less than a tenth, at
    three window sizes."""
    questions = (
        "questions=[{name: age, label: Your age, kind: number, low: 18, high: 110},"
        "{name: gender, label: Your gender, kind: choice, choices: [woman, man, another]},"
        "{name: comment, label: 'Was anything unclear?', kind: text}]"
    )
    # With this belief no message makes a faultless person change an earlier answer.
    rescue = learned("belief=persistent", questions)
    plan, seen, measured = rescue.plan, set[str](), dict[str, dict[int, float]]()

    def look(page: Page) -> None:
        shown = len(page.fields) if page.stage == "evaluation" else len(page.messages)
        name = page.stage
        if name == "evaluation":
            name += f"-{shown:02d}"
        elif name == "practice":
            name += f"-{shown + 1}"
        if page.stage in ("practice", "ahead", "evaluation"):
            below, cut_off = out_of_sight(driver)
            assert below <= 0, page
            assert cut_off <= 12 or page.stage != "evaluation", page  # the last one's padding
        if name not in seen:
            assert faults(driver, axe) == [], name
            if page.stage != "evaluation" or shown in (1, plan.n_steps // 2, plan.n_steps):
                photograph(driver, name)
        seen.add(name)

    store = opened(rescue)
    key = store.researcher_key
    with running(create_app(store, GENEROUS)) as url:
        driver.get(f"{url}/?invitation={store.invite(1, 'pilot')[0]}")
        look_at(driver, axe, "entrance")
        for cell, (user_type, condition) in enumerate(plan.cells):
            if user_type == 0:  # the other types meet the same pages
                preview(driver, url, key, cell)
                person = bot_of(rescue, 0)
                measured[condition] = scrolled(driver, person, look)
        assert len(seen) == plan.n_steps + 9
        assert measured.keys() == {*plan.conditions}
        for width, _ in SIZES:
            total = [of_condition[width] for of_condition in measured.values()]
            assert max(total) - min(total) <= 0.1 * max(total), measured
        assert complaints(driver) == []

        # The pages off the way: a failed check, the ends, errors, the researcher's.
        go_in(driver, url, *store.invite(1, "pilot"))
        forgetful = bot_of(rescue, 0, mistake=1.0)
        for _ in range(20):
            if not (page := Page.of_html(driver.page_source)).hidden:
                break
            fields = forgetful.fill(page)[0]
            if page.stage == "practice":
                fields = [("label", str(len(page.messages)))]
            if "Some of your answers were different" in driver.page_source:
                look_at(driver, axe, "briefing-again")
            answer(driver, page, fields)
        look_at(driver, axe, "ineligible")
        go_in(driver, url, *store.invite(1, "pilot"))
        driver.find_element("css selector", "details.leave summary").click()
        look_at(driver, axe, "leaving")
        driver.find_element("css selector", "details.leave button").click()
        wait(lambda: "You have left the study" in driver.page_source)
        look_at(driver, axe, "withdrawn")
        driver.get(f"{url}/nowhere")
        look_at(driver, axe, "error")
        driver.execute_cdp_cmd("Network.clearBrowserCookies", {})
        driver.get(f"{url}/researcher")
        look_at(driver, axe, "researcher-login")
        log_in_and_invite(driver, key, "Each participant")
        look_at(driver, axe, "researcher")


SAID = """
const [situation, step] = arguments[0];
[...document.querySelectorAll('.see p.hint')].at(-1).textContent = situation;
document.querySelector('fieldset.newest legend').textContent = step;
"""


class TestQuestions:
    """The longest test, beside which others run (see browser-test in the Makefile)."""

    def test_a_question_is_accessible_in_sight_and_photographed(
        self, driver: Driver, axe: str, opened: Opened
    ) -> None:
        """On a phone and on a small laptop, before the first step and with messages on the page;
        with the paper's belief it also asks after messages."""
        asking = learned("ask=clips", "belief=independent", "belief.error=0")
        plan, store = asking.plan, opened(asking)
        seen: list[tuple[int, int]] = []
        said = (f"Before this: {' '.join(clip.situation)}" for clip in plan.clips)
        longest = [max(said, key=len), max((f"The robot {c.phrase}" for c in plan.clips), key=len)]
        with running(create_app(store, GENEROUS)) as url:
            for user_type in range(len(plan.roles)):
                cell = plan.cells.index((user_type, "asking"))
                preview(driver, url, store.researcher_key, cell)

                def look(page: Page) -> None:
                    if page.stage == "asking":
                        (clip,) = page.steps
                        (name,) = driver.find_elements("css selector", "fieldset.newest legend")
                        assert plan.clips[clip].phrase in name.text
                        assert out_of_sight(driver)[0] <= 0, page
                        assert faults(driver, axe) == [], page
                        if not seen or len(page.messages) > seen[-1][1]:
                            photograph(driver, f"asking-{len(page.messages):02d}")
                        seen.append((clip, len(page.messages)))
                        if plan.clips[clip].situation:
                            driver.execute_script(SAID, longest)
                            assert out_of_sight(driver)[0] <= 0, longest

                person = bot_of(asking, user_type)
                assert take_part(driver, person, look=look) == "done"
                if len({messages for _, messages in seen}) > 1:  # the other types meet such pages
                    break
            assert complaints(driver) == []
        assert len({messages for _, messages in seen}) > 1


def test_bots_in_chromium_take_part_hear_new_messages_and_replay_agrees(
    driver: Driver, store: Store
) -> None:
    study, announced = store.flow, list[str]()

    def look(page: Page) -> None:
        new = [e.text for e in driver.find_elements("css selector", ".message.new")]
        if new:
            live = driver.find_element("css selector", "[aria-live]#announce")
            wait(lambda: bool(live.get_attribute("textContent")))
            said = " ".join(str(live.get_attribute("textContent")).split())
            assert said == " ".join(" ".join(new).split())
            announced.extend(new)

    with running(create_app(store, GENEROUS)) as url:
        for number, invitation in enumerate(store.invite(2, "bot")):
            go_in(driver, url, invitation)
            person = bot_of(study, number, label_noise=0.1)
            assert take_part(driver, person, look=look) == "done"
            assert "Simulated participant" in driver.page_source
    assert len(announced) > 3  # practice, then at least one of the robot's
    assert differences(store) == []
    sql = "SELECT count(*) AS n, min(browser) AS low FROM event WHERE kind = 'labels'"
    (times,) = query(store, sql)
    assert times["n"] == 2 * study.plan.n_steps
    assert times["low"] > 0  # the page's own clock came along
    pages = query(store, "SELECT count(*) AS n FROM event WHERE kind = 'visible'")
    assert pages[0]["n"] >= 2 * (study.plan.n_steps + 6)


def test_the_keyboard_is_enough(driver: Driver, opened: Opened) -> None:
    """For every page of a study, and for questions in between."""
    store = opened(flow_of(ASKING))
    with running(create_app(store, GENEROUS)) as url:
        driver.get(f"{url}/?invitation={store.invite(1, 'bot')[0]}")
        _tab_to(driver, "button")
        driver.switch_to.active_element.send_keys(KEYBOARD.ENTER)
        wait(lambda: moved_on(driver, "none"))
        person = bot_of(store.flow, 0)
        while (page := Page.of_html(driver.page_source)).hidden:
            wanted = dict(person.fill(page)[0])
            for name, value in wanted.items():
                _tab_to(driver, f'input[name="{name}"]')
                for _ in range(4):  # arrows move within a group of radio buttons
                    box = driver.switch_to.active_element
                    if box.get_attribute("value") == value:
                        break
                    box.send_keys(KEYBOARD.TAB if page.stage == "quiz" else KEYBOARD.ARROW_DOWN)
                if not driver.switch_to.active_element.is_selected():
                    driver.switch_to.active_element.send_keys(KEYBOARD.SPACE)
            _tab_to(driver, "main form button")
            driver.switch_to.active_element.send_keys(KEYBOARD.ENTER)
            wait(lambda before=page.hidden["sequence"]: moved_on(driver, before))  # type: ignore[misc]
        assert page.stage == "done"


def _tab_to(driver: Driver, selector: str) -> None:
    """Presses Tab until the wanted element has the focus; every focused element must be visibly
    focused."""
    for _ in range(80):
        focus = driver.switch_to.active_element
        if driver.execute_script("return arguments[0].matches(arguments[1])", focus, selector):
            outline = focus.value_of_css_property("outline-style")
            assert outline != "none", f"{selector}: the focus is not to be seen"
            return
        focus.send_keys(KEYBOARD.TAB)
    raise AssertionError(f"Tab does not lead to {selector}")


def test_an_answer_survives_a_lost_server_a_reload_and_a_double_click(
    driver: Driver, study: Study, tmp_path: Path
) -> None:
    path = tmp_path / "s.sqlite"
    server = serving(path, study)
    with server:
        (invitation,) = Researcher(server.url, server.key).invite(1)
        go_in(driver, server.url, invitation)
        # What is missing is said on the page to a browser that does not insist on it.
        driver.execute_script("document.querySelectorAll('form').forEach(f => f.noValidate = true)")
        press(driver)
        wait(lambda: bool(driver.find_elements("css selector", "[role=alert]")))
        assert "choose whether" in driver.find_element("css selector", "[role=alert]").text
        person = bot_of(study, 0)
        for _ in range(5 + SCREENS):
            page = Page.of_html(driver.page_source)
            choose(driver, person.fill(page)[0])
            button = driver.find_element("css selector", "main form button")
            driver.execute_script("arguments[0].click(); arguments[0].click()", button)
            wait(lambda before=page.hidden["sequence"]: moved_on(driver, before))  # type: ignore[misc]
        page = Page.of_html(driver.page_source)
        assert page.stage == "evaluation"
        choose(driver, person.fill(page)[0])
        server.kill()
        press(driver)
        wait(lambda: "no connection" in driver.find_element("id", "connection").text)
        stored = driver.execute_script("return JSON.stringify(localStorage)")
        assert "labels" in stored  # the outbox
        server.start()
        wait(lambda: moved_on(driver, page.hidden["sequence"]))
        assert len(Page.of_html(driver.page_source).fields) == 2
        assert driver.execute_script("return localStorage.length") == 0
        # Back and forth again: always where they are.
        here = driver.find_element("tag name", "body").get_attribute("data-sequence")
        driver.refresh()
        driver.back()
        driver.forward()
        driver.get(f"{server.url}/study")
        assert driver.find_element("tag name", "body").get_attribute("data-sequence") == here
        # An answer left in the outbox when the page was closed is sent by the next page.
        page = Page.of_html(driver.page_source)
        fields = [*page.hidden.items(), ("label_0", "1"), ("label_1", "0")]
        item = {"action": f"{server.url}/study", "fields": fields, "sequence": int(here)}
        driver.execute_script(
            "localStorage.setItem('study-outbox-' + arguments[0].slice(0, 16), arguments[1])",
            page.hidden["token"],
            json.dumps(item),
        )
        driver.refresh()
        wait(lambda: moved_on(driver, here))
        assert len(Page.of_html(driver.page_source).fields) == 3
    store = Store(path, study)
    kinds = [event.kind for event in store.events("source = 'protocol'")]
    assert kinds == [
        *("consent", *["read"] * SCREENS, "example", "example", "ahead"),
        "eligibility",
        *["labels"] * 2,
    ]
    store.close()


def test_an_answer_outlives_what_a_proxy_says(driver: Driver, store: Store) -> None:
    """A proxy answers for the server: no entered text is lost."""
    statuses, app = (302, 403, 404, 502, 503), create_app(store, GENEROUS)
    answers, answered = list[Response](), list[Response]()

    @app.middleware("http")
    async def proxy(request: Any, forward: Any) -> Response:
        if not answers or (request.method, request.url.path) != ("POST", "/study"):
            own: Response = await forward(request)
            return own
        answered.append(answers[0])
        return answers[0]

    with running(app) as url:
        for token, status in zip(store.invite(len(statuses), "bot"), statuses, strict=True):
            go_in(driver, url, token)
            answers.append(Response(status_code=status, headers={"Location": "/elsewhere"}))
            answered.clear()
            choose(driver, [("agree", "1")])
            press(driver)
            wait(lambda: len(answered) > 1)
            assert "no connection" in driver.find_element("id", "connection").text, status
            assert sequence(driver) == "0"
            answers.clear()
            wait(lambda: sequence(driver) == "1")
