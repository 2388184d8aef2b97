"""A real Chromium: MLflow shows a sweep's curves and compares its runs; the report page renders.

Screenshots are left in ``outputs/screenshots`` (``XPLAIN_SCREENSHOTS`` names another folder).
"""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from tests.runs import sweeps
from xplain.participants.simulation.chromium import browser, missing

pytestmark = pytest.mark.browser

SCREENSHOTS = Path(os.environ.get("XPLAIN_SCREENSHOTS", sweeps.ROOT / "outputs/screenshots"))


@pytest.fixture(scope="module")
def driver():
    if what := missing():
        pytest.skip(f"no browser to drive: install {what}")
    with browser() as opened:
        opened.set_window_size(1400, 1000)
        yield opened


@pytest.fixture(scope="module")
def sweep(tmp_path_factory, driver):
    """Folder and output of a finished sweep."""
    folder = tmp_path_factory.mktemp("sweep")
    code, output = sweeps.run(folder, *sweeps.TINY)
    assert code == 0, output
    return folder, output


@pytest.fixture(scope="module")
def server(sweep):
    """Address of an MLflow UI on the sweep's database."""
    folder, _ = sweep
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    database = folder / "outputs" / "mlflow.db"
    arguments = ["--backend-store-uri", f"sqlite:///{database}", "--port", str(port)]
    with (folder / "ui.txt").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "mlflow", "ui", "--workers", "1", *arguments],
            cwd=folder,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    address = f"http://127.0.0.1:{port}"
    try:
        deadline = time.monotonic() + 120
        while True:
            try:
                urllib.request.urlopen(f"{address}/health", timeout=2).close()
                break
            except (urllib.error.URLError, OSError):
                assert time.monotonic() < deadline, (folder / "ui.txt").read_text()
                time.sleep(0.5)
        yield address
    finally:
        sweeps.kill_group(process)


def shown(driver, condition, seconds=90):
    """Waits until a script's condition holds."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if driver.execute_script(f"return Boolean({condition})"):
            return
        time.sleep(0.3)
    screenshot(driver, "failed.png")
    raise AssertionError(f"never came true: {condition}")


def screenshot(driver, name):
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    driver.save_screenshot(str(SCREENSHOTS / name))


def links(output, server):
    """The links that the sweep printed, on the test's server."""
    found = re.findall(r": (http://127\.0\.0\.1:5000/\S+)", output)
    assert len(found) == 3, output
    return [address.replace("http://127.0.0.1:5000", server) for address in found]


def test_mlflow_shows_the_parents_curves(driver, sweep, server):
    parent, _, _ = links(sweep[1], server)
    driver.get(f"{parent}/model-metrics")
    shown(driver, "document.body.innerText.includes('four_rooms/qmdp')")
    # A curve is drawn, not an empty chart: Plotly's traces have points.
    shown(driver, "document.querySelectorAll('.js-plotly-plot .scatterlayer path').length > 0")
    time.sleep(1)
    screenshot(driver, "mlflow-parent.png")


def test_mlflow_shows_the_table_on_the_parent(driver, sweep, server):
    parent, _, _ = links(sweep[1], server)
    driver.get(parent)
    shown(driver, "document.body.innerText.includes('Oracle')")
    screenshot(driver, "mlflow-parent-note.png")


def test_mlflow_lists_and_compares_the_children(driver, sweep, server):
    _, table, comparison = links(sweep[1], server)
    driver.get(table)
    # The parent's row, folded; the count says that its six children are below it.
    shown(driver, "/7\\s+matching runs/.test(document.body.innerText)")
    screenshot(driver, "mlflow-runs.png")
    driver.get(comparison)
    for name in ("qmdp λ=0.5", "qhr λ=2"):
        shown(driver, f"document.body.innerText.includes('{name}')")
    shown(driver, "document.querySelectorAll('.js-plotly-plot, .plotly').length > 0")
    time.sleep(1)
    screenshot(driver, "mlflow-comparison.png")


def test_the_report_page_renders(driver, sweep):
    page = sweeps.sweep_folder(sweep[0]) / "report" / "index.html"
    driver.get(page.as_uri())
    height = driver.execute_script("return document.documentElement.scrollHeight")
    driver.set_window_size(1280, min(height + 150, 8000))
    broken = driver.execute_script(
        "return [...document.images].filter(i => !i.complete || i.naturalWidth == 0).length"
    )
    assert broken == 0
    assert driver.execute_script("return document.images.length") >= 6
    # Nothing sticks out of the page, and nothing was fetched from elsewhere.
    assert driver.execute_script("return document.documentElement.scrollWidth <= window.innerWidth")
    assert driver.execute_script("return performance.getEntriesByType('resource').length") == 0 or (
        driver.execute_script(
            "return performance.getEntriesByType('resource').every(r => r.name.startsWith('data:'))"
        )
    )
    screenshot(driver, "report.png")
    driver.set_window_size(1400, 1000)
