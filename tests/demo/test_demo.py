"""The demo plays the same explanation as the experiments, and makes a page without other files."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from hydra.core.global_hydra import GlobalHydra

from tests.refusals import line_of
from xplain.demo.page import content, page
from xplain.demo.play import play, set_up
from xplain.experiment.explanations import true_thoughts
from xplain.explanation.belief import Independent
from xplain.explanation.message_sets import mask_of
from xplain.interaction.episode import explain
from xplain.randomness import derive_seed
from xplain.solvers.base import CachedPolicy
from xplain.solvers.greedy import QMDP

QUICK = ["points=150", "lambda=1.5", "clusterer=dirichlet", "labeler=tree"]


@pytest.fixture(scope="module")
def rescue():
    GlobalHydra.instance().clear()
    return set_up(QUICK, trace=1)


@pytest.mark.parametrize(
    ("user", "more"),
    [
        ("A", ()),
        ("C", ("ask=clips", "explainee=heedless", "points=25")),  # types with unequal shares
        ("E", ("prior=observers", "points=25")),
    ],
)
def test_it_plays_the_experiments_episode(rescue, user, more):
    """This also holds if the robot asks questions and the person misses messages."""
    scene = set_up([*QUICK, *more], trace=1) if more else rescue
    (truth, same), place = true_thoughts(scene.case), scene.prepared.types.index(user)
    person = scene.explainee.meet(
        truth.of_types([place]), same, derive_seed(scene.explainer.seed, "explainee", user)
    )
    problem = scene.session().explained.problem
    episode = explain(problem, CachedPolicy(QMDP().plan(problem)), person, Independent())
    played = play(scene, user)
    assert episode.messages.tolist() == [
        mask_of(step.said, scene.prepared.messages) for step in played.steps
    ]
    asked = [(k, *one) for k, step in enumerate(played.steps) for one in step.asked]
    assert [(k, one.number, answer) for k, one, answer in asked] == [*map(tuple, episode.questions)]
    assert bool(asked) == ("ask=clips" in more)
    shares = scene.prepared.type_shares if "prior=observers" in more else 1 / len(played.prior)
    np.testing.assert_allclose(list(played.prior.values()), shares)
    assert played.steps[-1].cost == pytest.approx(episode.cost)
    for k, step in enumerate(played.steps):
        np.testing.assert_array_equal(step.labels, episode.labels[k, : k + 1])
        np.testing.assert_array_equal(list(step.belief.values()), episode.beliefs[k + 1])


def test_by_default_it_tells_of_a_type_that_is_found_with_few_messages(rescue):
    """No user of any type is found on this trace with fewer messages, unless nothing is said."""
    found = {}
    assert rescue.case is rescue.prepared.cases[1]
    for user in rescue.prepared.types:
        played = play(rescue, user)
        said = sum(len(step.said) for step in played.steps)
        if sum(played.steps[-1].belief[name] for name in rescue.right(user)) > 0.9 and said:
            found[user] = said
    assert found, "no type is found on this trace"
    assert found[rescue.user_type(None)] == min(found.values())


def test_a_learned_type_is_called_by_the_true_one_that_it_stands_for(rescue):
    for user in rescue.prepared.types:
        for name in rescue.right(user):
            assert user in rescue.title(name).split(" ")[0].split("/")
    assert rescue.title("none of these") == "none of these"


def test_the_page_holds_the_session_and_loads_nothing(rescue):
    played = play(rescue, "A")
    html = page(rescue, played)
    data = re.search(r"^const D = (.*);$", html, re.MULTILINE)
    assert json.loads(data.group(1)) == json.loads(json.dumps(content(rescue, played)))
    assert "costs a penalty of" in content(rescue, played)["believes"][0]
    assert "question" not in content(rescue, played)["steps"][0]["values"][0]
    outside = r"(?:src|href|url|import|fetch)\s*[=(]\s*[\"']?([^\"'\s)>]*)"
    assert {*re.findall(outside, html)} <= {"data:,"}
    assert "http" not in html.replace("http://www.w3.org/2000/svg", "")


def test_words_of_a_domain_cannot_end_the_script(rescue):
    sentences = ("</script><script>alert(1)</script><!--",) * len(rescue.prepared.sentences)
    scene = replace(rescue, prepared=replace(rescue.prepared, sentences=sentences))
    html = page(scene, play(scene, "A"))
    assert html.count("</script>") == 1
    assert "<!--" not in html


@pytest.mark.parametrize("flags", [(), ("--html", "mine.html")])
def test_the_page_is_written_where_it_was_asked_for(run, tmp_path, flags):
    code, out, err = run("demo", *flags, "--user", "C", *QUICK, "lambda=5")
    name = "mine.html" if flags else "demo.html"
    assert (code, out, err) == (0, f"{name}\n", "")
    text = (tmp_path / name).read_text(encoding="utf-8")
    assert "of the first 5: here the type" in text
    # On one of the five traces this user is found without a message: this is no instructive trace.
    assert re.search(r'const D = {.*"user": "C".*"said": \["', text)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--trace", "-1"], ["--trace", "-1"]),
        (["--trace", "x"], ["--trace", "x"]),
        (["--bogus"], ["--bogus"]),
        (["--user", "Q", *QUICK], ["--user", "Q", "A, B"]),
        (["lamda=2"], ["lamda", "lambda"]),
        (["lambda=-1"], ["lambda", "-1"]),
        (["lambda"], ["lambda", "key=value"]),
        (["solver=oracle"], ["solver", "oracle"]),
        (["domain=mars"], ["domain", "mars", "rescue"]),
        (["--html", "absent/session.html"], ["--html", "absent"]),
        (["--me"], ["--me"]),
    ],
    ids=lambda value: " ".join(value)[:30],
)
def test_bad_input_is_one_line(run, tmp_path, arguments, words):
    line = line_of(run("demo", *arguments))
    assert [word for word in words if word not in line] == []
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.browser
def test_the_page_can_be_stepped_through(rescue, driver, tmp_path):
    from selenium.webdriver.common.keys import Keys

    played = play(rescue, "A")
    (tmp_path / "session.html").write_text(page(rescue, played), encoding="utf-8")
    driver.get((tmp_path / "session.html").as_uri())
    body, last = driver.find_element("tag name", "body"), len(played.steps)
    assert "believes" in driver.find_element("id", "speech").text
    for k, step in enumerate(played.steps, start=1):
        body.send_keys(Keys.ARROW_RIGHT)
        assert driver.find_element("id", "where").text == f"step {k} of {last}"
        speech = driver.find_element("id", "speech").text
        for name, sentence in zip(rescue.prepared.messages, rescue.prepared.sentences, strict=True):
            assert (sentence in speech) == (name in step.said)
        squares = driver.find_elements("css selector", "#trace .now")
        assert [s.text for s in squares] == ["✓" if label else "?" for label in step.labels]
    assert f"cost {step.cost:g}" in driver.find_element("id", "cost").text
    assert not driver.find_element("id", "next").is_enabled()
    body.send_keys(Keys.HOME)
    driver.find_element("id", "next").click()
    assert driver.find_element("id", "where").text == f"step 1 of {last}"
    assert driver.get_log("browser") == []
