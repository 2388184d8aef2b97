"""A simulated participant in a real browser: Debian's chromium and chromium-driver, by selenium."""

import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from xplain.errors import InputError
from xplain.people.bots import Bot, Page, walk
from xplain.people.flow import Fields

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--window-size=1280,900",
)
Driver = Any


def missing() -> str:
    """Names the programs that must be installed to drive a browser; "" if nothing is missing."""
    try:
        import selenium  # noqa: F401
    except ImportError:
        return "selenium (pip install selenium)"
    if not (shutil.which("chromium") or shutil.which("google-chrome")):
        return "Chromium (Debian: apt-get install chromium)"
    return "" if shutil.which("chromedriver") else "its driver (Debian: chromium-driver)"


@contextmanager
def browser() -> Iterator[Driver]:
    """Opens a new Chromium with an empty profile.

    Raises:
        InputError: something is not installed.
    """
    if what := missing():
        raise InputError("--chromium", "not here", f"install {what}")
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or shutil.which("google-chrome") or ""
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        for flag in (*FLAGS, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        service = webdriver.ChromeService(executable_path=shutil.which("chromedriver"))
        driver = webdriver.Chrome(options=options, service=service)
        driver.implicitly_wait(3)
        try:
            yield driver
        finally:
            driver.quit()


def sequence(driver: Driver) -> str | None:
    """Waits for the complete page. Returns its number."""
    from selenium.common.exceptions import WebDriverException

    script = "return document.readyState === 'complete' ? document.body.dataset.sequence : null"
    try:
        found: str | None = driver.execute_script(script)
    except WebDriverException:  # between two pages
        return None
    return found


def wait(true: Callable[[], bool], seconds: float = 60) -> None:
    """Waits until a condition is true.

    Raises:
        TimeoutError: the condition does not become true.
    """
    until = time.monotonic() + seconds
    while not true():
        if time.monotonic() > until:
            raise TimeoutError("the page did not change")
        time.sleep(0.03)


def resize(driver: Driver, width: int, height: int, mobile: bool | None = None) -> None:
    """Gives the page a window of this size; narrow windows are those of a phone."""
    size = {"width": width, "height": height, "deviceScaleFactor": 1}
    size["mobile"] = width < 500 if mobile is None else mobile
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


def press(driver: Driver) -> None:
    """Presses the button that continues."""
    driver.find_element("css selector", "main form button").click()


UNCHOSEN = "return arguments[0].map(one => document.querySelector(one)).filter(one => !one.checked)"


def choose(driver: Driver, fields: Fields) -> None:
    """Clicks the inputs that are not chosen yet, as a person would."""
    wanted = [f'input[name="{name}"][value="{value}"]' for name, value in fields]
    for box in driver.execute_script(UNCHOSEN, wanted):
        box.click()


def answer(driver: Driver, page: Page, fields: Fields) -> None:
    """Fills in a page and continues to the next page."""
    choose(driver, fields)
    press(driver)
    wait(lambda: sequence(driver) not in (page.hidden["sequence"], None))


def go_in(driver: Driver, url: str, invitation: str) -> None:
    """Goes to the first page of the study, or to the participant's page."""
    driver.get(f"{url}/?invitation={invitation}")
    press(driver)
    wait(lambda: sequence(driver) is not None)


def log_in_and_invite(driver: Driver, key: str, shown: str) -> None:
    """Logs in as the researcher on the open page, waits for this text, and creates invitations."""
    driver.find_element("id", "key").send_keys(key)
    press(driver)
    wait(lambda: shown in driver.page_source)
    driver.find_element("css selector", "form.inline button").click()
    wait(lambda: "New invitations" in driver.page_source)


def take_part(
    driver: Driver,
    person: Bot[Any, Any],
    look: Callable[[Page], None] = lambda page: None,
) -> str:
    """Takes part from the page after :func:`go_in` to the end, by
    :func:`xplain.people.bots.walk`."""

    def answered(page: Page, fields: Fields) -> Page:
        answer(driver, page, fields)
        return opened()

    def opened() -> Page:
        page = Page.of_html(driver.page_source)
        look(page)
        return page

    return walk(opened(), answered, person)
