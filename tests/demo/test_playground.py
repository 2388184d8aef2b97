"""The playground: whoever holds something wrong is found, and nobody else may talk to it."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from flask.testing import FlaskClient
from werkzeug.serving import make_server

from tests.chromium import browser, missing
from tests.runs.sweeps import ROOT
from xplain.demo.serve import create_app

QUICK = ("domain=rescue", "points=20", "queries=adaptive", "labeler=hypotheses", "seed=0")
SCREENSHOTS = Path(os.environ.get("XPLAIN_SCREENSHOTS", ROOT / "outputs/screenshots"))


@pytest.fixture(scope="module")
def app() -> Any:
    return create_app(QUICK)


@pytest.fixture
def client(app: Any) -> FlaskClient:
    return app.test_client()


def test_who_holds_two_facts_wrong_is_found_by_both_policies(client: FlaskClient) -> None:
    names = [fact["name"] for fact in client.post("/facts", json={"task": "rescue"}).json]
    assert {"fire", "rubble"} < set(names)
    wrong = ["fire", "rubble"]  # type A of the rescue task
    asked = {"task": "rescue", "solvers": ["qmdp", "pomcp"], "wrong": wrong}
    game = client.post("/begin", json=asked).json
    costs = [0.0, 0.0]
    while not game["finished"]:
        assert len(game["phrases"]) == game["shown"]
        labels = [policy["suggested"] for policy in game["policies"]]
        assert all(len(own) == game["shown"] for own in labels)
        said = [len(policy["said"]) for policy in game["policies"]]
        costs = [c + s + own.count(0) for c, s, own in zip(costs, said, labels, strict=True)]
        game = client.post("/answer", json={"game": game["game"], "labels": labels}).json
    assert [policy["cost"] for policy in game["policies"]] == costs  # λ and all prices are 1
    for policy in game["policies"]:
        assert max(policy["belief"], key=policy["belief"].get).startswith("A ")
        assert max(policy["belief"].values()) > 0.9


def test_who_holds_nothing_wrong_is_puzzled_by_nothing(client: FlaskClient) -> None:
    asked = {"task": "rescue", "solvers": ["silent", "qmdp"], "wrong": []}
    game = client.post("/begin", json=asked).json
    while not game["finished"]:
        labels = [policy["suggested"] for policy in game["policies"]]
        assert not any(0 in own for own in labels)
        game = client.post("/answer", json={"game": game["game"], "labels": labels}).json
    assert game["policies"][0]["cost"] == 0


@pytest.fixture(scope="module")
def asking() -> Any:
    return create_app((*QUICK, "ask=clips", "discount=1"))


def test_what_a_policy_asks_is_answered_first_and_costs(asking: Any) -> None:
    """QMDP asks; a policy that cannot goes on as it does."""
    client = asking.test_client()
    asked = {"task": "rescue", "solvers": ["qmdp", "conformant"], "wrong": ["fire", "rubble"]}
    game = client.post("/begin", json=asked).json
    costs, questions = [0.0, 0.0], 0
    while not game["finished"]:
        own = [policy["question"] for policy in game["policies"]]
        assert own[1] is None
        assert game["asks"] == (own[0] is not None)
        replies = [one and one["suggested"] for one in own]
        labels = [policy["suggested"] for policy in game["policies"]]
        if game["asks"]:
            assert dict(own[0]["replies"]) == {"yes": 1, "no": 0}
            refused = client.post("/answer", json={"game": game["game"], "labels": labels})
            assert refused.status_code == 400
            questions += 1
        else:
            said = [len(policy["said"]) for policy in game["policies"]]
            costs = [c + s + o.count(0) for c, s, o in zip(costs, said, labels, strict=True)]
        answer = {"game": game["game"], "labels": labels, "replies": replies}
        game = client.post("/answer", json=answer).json
    assert questions > 0
    assert [p["cost"] for p in game["policies"]] == pytest.approx(
        [costs[0] + 0.1 * questions, costs[1]]
    )
    belief = game["policies"][0]["belief"]
    assert max(belief, key=belief.get).startswith("A ")


@pytest.mark.browser
@pytest.mark.parametrize("width", [1280, 390])
def test_a_question_is_answered_in_a_browser(asking: Any, width: int) -> None:
    if what := missing():
        pytest.skip(f"no browser to drive: install {what}")
    from selenium.webdriver.common.keys import Keys
    from selenium.webdriver.support.ui import WebDriverWait

    server = make_server("127.0.0.1", 0, asking)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        with browser() as driver:
            screen = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
            driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
            driver.get(f"http://127.0.0.1:{server.server_port}/")
            wait = WebDriverWait(driver, 120)
            wait.until(
                lambda d: d.execute_script("return !document.getElementById('begin').disabled")
            )
            driver.find_element("id", "begin").send_keys(Keys.ENTER)
            wait.until(lambda d: d.execute_script("return game !== null"))
            question = driver.find_element("css selector", ".question")
            assert "Does this step make sense to you?" in question.text
            SCREENSHOTS.mkdir(parents=True, exist_ok=True)
            driver.save_screenshot(str(SCREENSHOTS / f"playground-asks-{width}.png"))
            assert driver.execute_script("return document.documentElement.scrollWidth") <= width
            while driver.execute_script("return game.asks"):
                before = driver.execute_script("return game.policies[0].cost")
                driver.find_element("id", "next").send_keys(Keys.ENTER)
                wait.until(
                    lambda d, before=before: d.execute_script(
                        "return game.policies[0].cost > arguments[0]", before
                    )
                )
            assert driver.execute_script("return game.shown") == 1
            assert driver.find_element("id", "next").text == "next step"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.mark.parametrize(
    ("path", "asked", "said"),
    [
        ("/facts", {"task": "lava"}, "task='lava': one of rescue, four_rooms"),
        ("/begin", {"task": "rescue", "solvers": ["qmdp", "oracle"], "wrong": []}, "two of qmdp"),
        ("/begin", {"task": "rescue", "solvers": ["qmdp"] * 2, "wrong": ["lava"]}, "first_aid"),
        ("/answer", {"game": 99, "labels": []}, "begin again"),
        ("/answer", {"game": [1], "labels": []}, "game=[1]: int"),
        ("/begin", ["rescue"], "in a JSON object"),
        ("/begin", {"task": "rescue", "solvers": ["qmdp"] * 2}, "wrong=None"),
        ("/begin", {"task": "rescue", "solvers": [["qmdp"], {}], "wrong": []}, "two of qmdp"),
    ],
)
def test_what_is_wrong_is_told(client: FlaskClient, path: str, asked: Any, said: str) -> None:
    answer = client.post(path, json=asked)
    assert answer.status_code == 400
    assert said in answer.json["error"]


def test_what_is_no_json_is_told(client: FlaskClient) -> None:
    answer = client.post("/begin", data="{oops", content_type="application/json")
    assert answer.status_code == 400
    assert "in a JSON object" in answer.json["error"]


def test_pages_from_elsewhere_are_refused(client: FlaskClient) -> None:
    assert client.get("/", headers={"Host": "evil.example"}).status_code == 403
    assert client.post("/begin", data={"task": "rescue"}).status_code == 403
    assert create_app(QUICK, "0.0.0.0").test_client().get("/").status_code == 200


@pytest.fixture(scope="module")
def address(app: Any) -> Iterator[str]:
    server = make_server("127.0.0.1", 0, app)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.browser
@pytest.mark.parametrize("width", [1280, 390])
def test_it_is_played_by_keyboard_alone(address: str, width: int) -> None:
    """Two facts are held wrong; both policies find the type."""
    if what := missing():
        pytest.skip(f"no browser to drive: install {what}")
    from selenium.webdriver.common.keys import Keys
    from selenium.webdriver.support.ui import WebDriverWait

    with browser() as driver:
        screen = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
        driver.get(address)
        wait = WebDriverWait(driver, 120)
        wait.until(lambda d: d.execute_script("return !document.getElementById('begin').disabled"))
        driver.execute_script("document.getElementById('second').value = 'pomcp'")
        for name in ("fire", "rubble"):
            box = driver.find_element("css selector", f"#facts input[value={name}]")
            box.send_keys(Keys.SPACE)
        driver.find_element("id", "begin").send_keys(Keys.ENTER)
        wait.until(lambda d: d.execute_script("return game !== null"))
        while not driver.execute_script("return game.finished"):
            at = driver.execute_script("return game.shown")
            driver.find_element("id", "next").send_keys(Keys.ENTER)
            wait.until(
                lambda d, at=at: d.execute_script(
                    "return game.finished || game.shown > arguments[0]", at
                )
            )
            if at == 8:
                SCREENSHOTS.mkdir(parents=True, exist_ok=True)
                driver.save_screenshot(str(SCREENSHOTS / f"playground-{width}.png"))
        for box in driver.find_elements("css selector", ".policy"):
            bars = box.find_elements("css selector", ".bar")
            best = max(bars, key=lambda bar: float(bar.get_attribute("data-p")))
            assert best.text.startswith("A ")
            assert float(best.get_attribute("data-p")) > 0.9
        assert driver.execute_script("return document.documentElement.scrollWidth") <= width
        names = driver.execute_script(
            "return performance.getEntriesByType('resource').map(r => r.name)"
        )
        assert all(name.startswith(address) for name in names)
