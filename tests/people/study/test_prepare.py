"""From a configuration to the plan of a study: its trace, its briefings and tests, and its map."""

import json
import re
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from tests.domains.configs import setting_of
from tests.people.street import PLACES, TYPES, street_plan
from xplain.experiment.config import compose_config
from xplain.explanation.anybody import Open
from xplain.people.map_svg import about, legend, picture
from xplain.people.material import Material, name_items, phrases_of
from xplain.people.study.flow import Study
from xplain.people.study.plan import StudyPlan
from xplain.people.study.prepare import find_needed, study_plan, traces_of

CONFIG = ("seed=0", "trace.candidates=40")


@pytest.fixture(scope="module")
def rescue() -> StudyPlan:
    return study_plan(compose_config("study", [*CONFIG]))


def test_the_rescue_study_is_prepared_from_its_configuration(rescue: StudyPlan) -> None:
    plan = rescue
    # Same configuration, same study.
    assert study_plan(compose_config("study", [*CONFIG])).hash == plan.hash
    assert Study.of(plan).belief == Open("learned")
    assert (len(plan.roles), plan.problem.trade_off) == (5, 1.0)
    assert set(plan.conditions) == {"personalized", "conformant"}
    found = plan.problem.as_found  # people who answer what they think, then those who err
    assert plan.problem.whose[found].tolist() == [*range(5), *range(5)]
    assert 0.5 < plan.problem.start[found].sum() < 1
    true = np.tile(plan.true_labels.astype(bool), (2, 1, 1))
    agree = (plan.problem.p_explicable[found] > 0.5) == true
    assert agree.mean() > 0.95
    assert set(plan.icons) >= {item.name for item in plan.scene.items}
    for role in plan.roles:
        assert len(role.wrong) == 2
        signs = ("0 points or more", "less than 0 points")
        assert all(q.options == signs for q in role.eligibility)
        assert [q.answer for q in role.eligibility] == [int(j in role.wrong) for j in range(6)]
    assert json.loads(plan.text)["config"]["lambda"] == 1.0
    # What is gone before a step is gone for good.
    *before, after = (set(gone) for gone in plan.taken)
    assert before == [set(clip.gone) for clip in plan.shown]
    assert all(one <= other for one, other in pairwise([*before, after]))
    assert after


@pytest.mark.parametrize("name", ["four_rooms", "rescue"])
def test_no_map_on_the_pages_depends_on_what_a_participant_may_believe(name: str) -> None:
    """If an incorrect value were the robot's, the map would be the same."""
    cfg = compose_config("study", [f"domain={name}"])
    maps = []
    for key in [None, *cfg.domain.parameters]:
        own = OmegaConf.merge(cfg.domain, {})
        if key:
            swapped, before = own.parameters[key], cfg.domain.parameters[key]
            swapped.accurate, swapped.inaccurate = before.inaccurate, before.accurate
        maps.append(name_items(instantiate(own).scene, str))
    assert all(one == maps[0] for one in maps)
    # In four rooms the goals and penalties are what types believe incorrectly.
    assert (bool(maps[0].walls), bool(maps[0].items)) == (True, name == "rescue")


def test_traces_that_tell_most_come_first_the_shortest_among_equals() -> None:
    setting = setting_of("domain=four_rooms", "users.count=3")
    rules = {"rows": [], "candidates": 80, "min_steps": 1}
    ranked = traces_of(Material.of(setting), rules, 40, 0)
    facts = [
        sum(
            find_needed(of_type).bit_count()
            for of_type in setting.label_table(setting.reachable[one])
        )
        for one in ranked
    ]
    assert facts == sorted(facts, reverse=True)
    lengths = [[len(o) for o, own in zip(ranked, facts, strict=True) if own == f] for f in {*facts}]
    assert all(own == sorted(own) for own in lengths)
    assert any(own[0] < own[-1] for own in lengths)  # there is something to order
    assert len({one.tobytes() for one in ranked}) == len(ranked)


def test_places_have_letters_and_numbers_and_phrases_their_words() -> None:
    in_words = phrases_of({"first aid": "kit", "first": "1st", "north": "drives north"}, True)
    assert in_words("picks up the first aid") == "picks up the kit"
    assert in_words("moves to (2, 3)") == "moves to D3"
    assert in_words("a goal in row 6, column 9") == "a goal in J7"
    assert in_words("northern") == "northern"
    assert phrases_of({}, False)("moves to (2, 3)") == "moves to (2, 3)"


def test_needed_messages_are_smallest(study: Study) -> None:
    plan = study.plan
    for labels in plan.true_labels:
        mask = find_needed(labels)
        assert labels[:, mask].all()
        smaller = [m for m in range(16) if m.bit_count() < mask.bit_count()]
        assert not any(labels[:, m].all() for m in smaller)


def test_roles_follow_from_the_sentences(study: Study) -> None:
    plan = study.plan
    for role, kind in zip(plan.roles, TYPES, strict=True):
        assert {plan.facts[j].name for j in role.wrong} == set(kind.inaccurate)
    for role in plan.roles:
        for j, (fact, told) in enumerate(zip(plan.facts, role.briefing, strict=True)):
            assert told == (fact.belief if j in role.wrong else fact.message)
        assert len({s.fact for s in role.quiz}) == 4
        assert {plan.facts[j].name for j in role.wrong} <= {s.fact for s in role.quiz}
        for some in (role.wrong, {j for j in range(4) if j not in role.wrong}):
            names = {plan.facts[j].name for j in some}
            assert [s.true for s in role.quiz if s.fact in names] == [True, False]
        for s in role.quiz:
            (fact,) = [fact for fact in plan.facts if fact.name == s.fact]
            assert s.text == (fact.message if s.true else fact.belief)
    assert street_plan(prior="observers").problem.prior.tolist() == [1 / 3] * 3
    # A reward with a phrase gets the paper's question; what is no number gets the sentences.
    assert (
        plan.roles[0].eligibility[0].options,
        plan.roles[0].eligibility[0].answer,
        plan.roles[2].eligibility[0].answer,
    ) == (("0 points or more", "less than 0 points"), 1, 0)
    assert set(plan.roles[0].eligibility[3].options) == {
        plan.facts[3].message,
        plan.facts[3].belief,
    }


def test_no_word_of_the_quiz_gives_the_answers_away(rescue: StudyPlan) -> None:
    """People who answer by a word of the sentences, or by good and bad news, are right half of the
    time. On the rescue task, all facts are good news."""
    roles = rescue.roles
    # On this trace every type has to have both of its facts corrected.
    assert all(find_needed(own).bit_count() == 2 for own in rescue.true_labels)

    def score(ticks: Callable[[str], bool]) -> list[int]:
        return [sum(ticks(s.text) == s.true for s in role.quiz) for role in roles]

    assert score(lambda text: True) == score(lambda text: False) == [2] * 5
    assert score(lambda text: "penalty of" not in text) == [2] * 5
    words = {word for role in roles for s in role.quiz for word in s.text.lower().split()}
    for word in words:
        scores = score(lambda text, word=word: word in text.lower().split())  # type: ignore[misc]
        # A word that only a true sentence contains reveals this sentence; four need knowledge.
        assert max(scores) <= 3, word
        assert min(scores) >= 1, word
        assert 1.4 <= np.mean(scores) <= 2.6, word
    good = ("gains", "nothing", "as much", "go on")
    assert score(lambda text: any(word in text for word in good)) != [4] * 5


def test_the_map_is_told_in_words_to_those_who_do_not_see_it(study: Study) -> None:
    """The text names the place of everything, the robot's way and its current cell, but not the
    items that it took."""
    plan = study.plan
    for k in range(plan.n_steps + 1):
        svg = picture(plan, plan.path, k, ("market",) if k > 1 else ())
        assert re.search(r'<svg [^>]*aria-describedby="map-in-words"', svg)
        (said,) = re.findall(r'<p class="unseen" id="map-in-words">([^<]*)</p>', svg)
        things = {"bridge": "A1", "market": "B1", "school": "C1", "tunnel": "D1"}
        if k > 1:
            del things["market"]
            assert "market" not in said
        for name, cell in things.items():
            assert f"{name}: {cell}." in said
        assert f"The robot is in {'ABCDE'[k]}1." in said
        way = ", ".join(f"{letter}1" for letter in "ABCDE"[: k + 1])
        assert (f"Its way so far: {way}." in said) == (k > 0)
    assert [name for name, _ in legend(plan)] == [*PLACES, plan.texts.words["way"]]
    # Seven signs fit into a cell.
    to_and_fro = (((0, 0), (0, 1)), ((0, 1), (0, 0))) * 5
    for steps, badges in ((8, ["1·3·5·7", "2·4·6·8"]), (10, ["··5·7·9", "··8·10"])):
        assert re.findall('fill="#fff">([^<]*)<', picture(plan, to_and_fro, steps)) == badges


def test_each_fact_of_rescue_has_a_picture_of_its_own(rescue: StudyPlan) -> None:
    """There are nine sentences, true or false; their pictures have the names of icons."""
    pairs = [(fact.message, fact.belief) for fact in rescue.facts]
    pairs += [(one.message, one.message) for one in rescue.known]
    pictures = [[about(rescue, sentence) for sentence in pair] for pair in pairs]
    assert all(right == wrong != "" for right, wrong in pictures)
    assert len({right for right, _ in pictures}) == len(rescue.facts) + 3 == 9
    assert about(rescue, "The robot hums.") == ""
