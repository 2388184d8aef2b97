"""A real Chromium renders the report page.

Screenshots are left in ``outputs/screenshots`` (``XPLAIN_SCREENSHOTS`` names another folder).
"""

from __future__ import annotations

import itertools
import os
import re
from pathlib import Path

import pytest

from tests.chromium import browser, missing
from tests.conftest import ROOT
from tests.report.test_report import made
from xplain.report.page import write_report

pytestmark = pytest.mark.browser

SCREENSHOTS = Path(os.environ.get("XPLAIN_SCREENSHOTS", ROOT / "outputs/screenshots"))


@pytest.fixture(scope="module")
def driver():
    if what := missing():
        pytest.skip(f"no browser to drive: install {what}")
    with browser() as opened:
        yield opened


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The address of a sweep's report."""
    _, report = write_report(made(tmp_path_factory.mktemp("sweep")))
    return (report / "index.html").as_uri()


@pytest.mark.parametrize(("width", "colours"), itertools.product((1440, 390), ("light", "dark")))
def test_the_report_page_renders(driver, page, width, colours):
    wanted = [{"name": "prefers-color-scheme", "value": colours}]
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": wanted})
    screen = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    driver.get(page)
    broken = "[...document.images].some(i => !i.complete || i.naturalWidth == 0)"
    assert not driver.execute_script(f"return {broken}")
    # Nothing sticks out of the page, and nothing was fetched from elsewhere.
    assert driver.execute_script("return document.documentElement.scrollWidth") <= width
    fetched = "performance.getEntriesByType('resource').map(r => r.name)"
    assert all(name.startswith("data:") for name in driver.execute_script(f"return {fetched}"))
    ground = driver.execute_script("return getComputedStyle(document.body).backgroundColor")
    bright = sum(map(int, re.findall(r"\d+", ground)[:3])) > 380
    assert bright == (colours == "light")
    assert driver.execute_script("return document.images.length") >= 6
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    driver.save_screenshot(str(SCREENSHOTS / f"report-{width}-{colours}.png"))
