"""A real Chromium: MLflow shows a sweep and compares its runs; the report page renders.

Screenshots are left in ``outputs/screenshots`` (``XPLAIN_SCREENSHOTS`` names another folder).
"""

import itertools
import json
import os
import re
import socket
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from tests import processes
from tests.chromium import resize
from tests.runs import sweeps

pytestmark = pytest.mark.browser

SCREENSHOTS = Path(os.environ.get("XPLAIN_SCREENSHOTS", sweeps.ROOT / "outputs/screenshots"))


@pytest.fixture(scope="module")
def sweep(tmp_path_factory, chromium):
    """Runs a sweep; returns its folder and output."""
    folder = tmp_path_factory.mktemp("sweep")
    arguments = ["users.count=2,3" if word == "users.count=2" else word for word in sweeps.TINY]
    code, output = sweeps.run(folder, *arguments)
    assert code == 0, output
    return folder, output


@pytest.fixture(scope="module")
def server(sweep):
    """Starts an MLflow UI on the sweep's database; returns its address."""
    folder, _ = sweep
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    database = folder / "outputs" / "mlflow.db"
    arguments = ["--backend-store-uri", f"sqlite:///{database}", "--port", str(port)]
    with (folder / "ui.txt").open("w") as log:
        process = processes.start(
            [sys.executable, "-m", "mlflow", "ui", "--workers", "1", *arguments],
            cwd=folder,
            env=os.environ | {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"},  # six processes
            stdout=log,
            stderr=log,
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
        processes.kill(process)


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


def link(output, server, words):
    """Returns the link that the sweep printed after these words, on the test's server."""
    (found,) = re.findall(rf"^{words}: http://127\.0\.0\.1:5000(/\S+)$", output, re.MULTILINE)
    return server + found


def expected_rows(folder):
    """Reads (solver, λ, users.count, regret) of every job from the disk, with the regret in
    MLflow's format."""
    found = set()
    for path in folder.glob("outputs/results/*/results.json"):
        content = json.loads(path.read_text())
        found.add(
            (
                content["choices"]["solver"],
                str(content["config"]["lambda"]),
                str(content["config"]["users"]["count"]),
                f"{round(content['metrics']['regret']['mean'], 4):g}",
            )
        )
    return found


ROWS = """
return (function () {
  const params = ['solver', 'lambda', 'users.count'].map(key => 'params.`' + key + '`');
  const columns = [...params, 'metrics.`regret`'];
  const rows = {};
  for (const cell of document.querySelectorAll('[role=gridcell]')) {
    const column = columns.indexOf(cell.getAttribute('col-id'));
    const box = cell.getBoundingClientRect();
    if (column < 0 || box.width == 0 || box.right > window.innerWidth) continue;
    const row = cell.closest('[row-index]').getAttribute('row-index');
    (rows[row] = rows[row] || [])[column] = cell.innerText.trim();
  }
  return Object.values(rows);
})()
"""


def assert_the_answer_is_seen(driver, folder):
    """Checks a row for each (solver, λ, users.count) with its regret, in the order of the
    problems."""
    wanted = expected_rows(folder)
    assert len(wanted) == 8
    deadline = time.monotonic() + 90
    rows = []
    while time.monotonic() < deadline and {tuple(row) for row in rows} != wanted:
        time.sleep(0.5)
        rows = driver.execute_script(ROWS)
    assert {tuple(row) for row in rows} == wanted
    trade_offs = [float(row[1]) for row in rows]
    assert trade_offs == sorted(trade_offs)  # across λ no regret is better than another


def test_the_printed_link_shows_the_answer_without_a_click(driver, sweep, server):
    resize(driver, 1400, 1000)
    driver.get(link(sweep[1], server, "MLflow"))
    assert_the_answer_is_seen(driver, sweep[0])
    screenshot(driver, "mlflow-sweep.png")


def test_comparing_runs_draws_the_regret_first(driver, sweep, server):
    with sweeps.database(sweep[0]) as database:
        found = database.execute(
            "select run_uuid from tags where key = 'mlflow.parentRunId' order by run_uuid limit 3"
        )
        ids = [run_id for (run_id,) in found]
    runs = json.dumps(ids, separators=(",", ":"))
    driver.get(f'{server}/#/compare-runs?runs={runs}&experiments=["1"]')
    shown(driver, "document.querySelector('.js-plotly-plot')")
    shown(driver, "document.querySelector('.js-plotly-plot').innerText.includes('regret')")
    screenshot(driver, "mlflow-compare.png")


LOOKS = list(itertools.product((1440, 390), ("light", "dark")))


@pytest.mark.parametrize(("width", "colours"), LOOKS)
def test_the_report_page_renders(driver, sweep, width, colours):
    page = sweeps.sweep_folder(sweep[0]) / "report" / "index.html"
    wanted = [{"name": "prefers-color-scheme", "value": colours}]
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": wanted})
    resize(driver, width, 900, mobile=False)
    driver.get(page.as_uri())
    broken = "[...document.images].some(i => !i.complete || i.naturalWidth == 0)"
    assert not driver.execute_script(f"return {broken}")
    # Nothing sticks out of the page, and nothing was fetched from elsewhere.
    assert driver.execute_script("return document.documentElement.scrollWidth") <= width
    fetched = "performance.getEntriesByType('resource').map(r => r.name)"
    names = driver.execute_script(f"return {fetched}")
    assert all(name.startswith("data:") for name in names)
    ground = driver.execute_script("return getComputedStyle(document.body).backgroundColor")
    bright = sum(map(int, re.findall(r"\d+", ground)[:3])) > 380
    assert bright == (colours == "light")
    assert driver.execute_script("return document.images.length") >= 5
    screenshot(driver, f"report-{width}-{colours}.png")
