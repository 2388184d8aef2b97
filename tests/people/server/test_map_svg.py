"""The map and the robot's way on it."""

import re
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from omegaconf import OmegaConf

from xplain.experiment.config import compose_config
from xplain.people.map_svg import COLOURS, about, picture
from xplain.people.material import phrases_of
from xplain.people.study.flow import Study


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


def test_no_two_kinds_of_things_look_alike() -> None:
    def lab(colour: str) -> NDArray[np.float64]:
        """Converts sRGB to CIE L*a*b*."""
        share = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
        linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
        to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
        x, y, z = np.cbrt(np.array(to_xyz) @ linear / [0.9505, 1, 1.089])
        return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])

    for one, other in combinations(COLOURS, 2):
        assert np.linalg.norm(lab(one) - lab(other)) > 20, (one, other)


def test_each_fact_of_rescue_has_a_picture_of_its_own() -> None:
    """There are nine sentences, true or false; their pictures have the names of icons."""
    wording: Any = OmegaConf.to_container(compose_config("study", []).wording, resolve=True)
    in_words = phrases_of(wording["phrases"], on_a_map=True)
    icons = {in_words(name): path for name, path in wording["icons"].items()}
    plan: Any = SimpleNamespace(scene=None, icons=icons)
    facts = [(one["message"], one["belief"]) for one in wording["facts"].values()]
    pictures = [[about(plan, in_words(sentence)) for sentence in pair] for pair in facts]
    pictures += [[about(plan, one["right"])] * 2 for one in wording["known"]]
    assert all(right == wrong != "" for right, wrong in pictures)
    assert len({right for right, _ in pictures}) == len(facts) + 3 == 9
    assert about(plan, "The robot hums.") == ""
