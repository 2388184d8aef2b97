"""The playground, and a lab's own page in jsPsych, in a real browser."""

import json
import os
import random
import shutil
import subprocess
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.chromium import Driver, resize, wait
from tests.conftest import ROOT
from tests.people.server_process import running
from xplain.people.service.app import create_app
from xplain.people.service.talks import Talks

pytestmark = pytest.mark.browser
SCREENSHOTS = Path(os.environ.get("XPLAIN_SCREENSHOTS", ROOT / "outputs/screenshots"))
PRESS = "const b = document.querySelector('button, [type=submit]'); b && b.click()"
WIDTHS = {390: 844, 1280: 900}


def in_sight(driver: Any, element: Any) -> bool:
    box = driver.execute_script("return arguments[0].getBoundingClientRect().toJSON()", element)
    return bool(box["top"] >= 0 and box["bottom"] <= driver.execute_script("return innerHeight"))


@pytest.mark.parametrize("width", WIDTHS)
def test_the_playground_tells_who_you_are(url: str, driver: Driver, width: int) -> None:
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    resize(driver, width, WIDTHS[width])
    driver.get(url)
    find = partial(driver.find_element, "css selector")
    for fact in ("fire", "rubble"):
        find(f"#facts input[value={fact}]").click()
    for turn in range(60):
        if not (button := find("#next")).is_displayed():
            break
        assert in_sight(driver, button)
        before = find("body").get_attribute("data-number")
        for reply in driver.find_elements("css selector", "#now [name=reply]")[:1]:
            reply.click()
        button.click()
        wait(lambda before=before: find("body").get_attribute("data-number") != before)
        if said := driver.find_elements("css selector", "#says .bubble"):
            assert in_sight(driver, said[0])
        if turn in (0, 8):
            driver.save_screenshot(str(SCREENSHOTS / f"playground-{width}-{turn}.png"))
    assert "messages" in find("#now").text
    assert driver.execute_script("return document.documentElement.scrollWidth") <= width
    driver.save_screenshot(str(SCREENSHOTS / f"playground-{width}-end.png"))
    assert not [one for one in driver.get_log("browser") if one["level"] == "SEVERE"]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Starts a lab's own server with the page, and jsPsych from npm; yields its address."""
    if not shutil.which("npm"):
        pytest.skip("npm is not installed")
    folder = tmp_path_factory.mktemp("lab")
    page = (ROOT / "examples/service/jspsych.html").read_text(encoding="utf-8")
    names = [part.split('"')[0] for part in page.split("https://unpkg.com/")[1:]]
    scripts = [name for name in names if not name.endswith(".css")]
    subprocess.run(["npm", "install", "--no-audit", "--no-fund", *scripts], cwd=folder, check=True)
    for name in scripts:
        own = f"node_modules/{name.rpartition('@')[0]}/dist/index.browser.min.js"
        page = page.replace(f'https://unpkg.com/{name}"', f'{own}"')
    page = page.replace("https://unpkg.com/jspsych@8/", "node_modules/jspsych/")
    (folder / "index.html").write_text(page, encoding="utf-8")
    quiet = type("Quiet", (SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("kind", ["session", "questionnaire"])
def test_a_lab_s_page_in_jspsych_counts_each_answer_once(
    talks: Talks, driver: Driver, lab: str, kind: str
) -> None:
    """Three people of each kind take part, with reloads and lost replies."""
    app, draw = create_app(talks, origins=[lab]), random.Random(1)
    trace, lost = list(talks.task.traces[0])[:4], random.Random(0)

    @app.middleware("http")
    async def lossy(request: Any, call_next: Any) -> Any:
        reply = await call_next(request)
        if lost.random() < 0.3:
            reply.status_code = 502
        return reply

    with running(app) as url:
        for person in range(3):
            given = f"service={url}&person=p{person}&kind={kind}"
            driver.get(f"{lab}?{given}&trace={','.join(map(str, trace))}")
            while not driver.find_elements("id", "thanks"):
                driver.execute_script(PRESS)
                if draw.random() < 0.02:
                    driver.refresh()
        assert not [e for e in driver.get_log("browser") if "Uncaught" in e["message"]]
    began = {"trace": trace, "expected_steps": 0} if kind == "session" else {}
    for person in range(3):
        which, _ = talks.begin(kind, f"p{person}", began)
        rows, _ = talks.read(kind, which)
        keys = [row.kind for row in rows]
        assert keys == ["begin", *(f"answer {n}" for n in range(1, len(rows)))]
        assert json.loads(str(rows[-1].state))["kind"] in ("wait", "end")
