"""The map and the robot's way on it."""

from __future__ import annotations

import re

from tests.people.study.stand_in import street_plan
from xplain.people.server.map_svg import legend, picture
from xplain.people.study.flow import Study


def test_the_map_says_what_happened_and_a_domain_without_one_does_without(study: Study) -> None:
    plan = study.plan
    words = plan.texts.words
    way = words["way"]
    assert [name for name, _ in legend(plan, way=True)] == [
        "bridge",
        "market",
        "school",
        "tunnel",
        way,
    ]
    for k in range(1, plan.n_steps + 1):
        svg = picture(plan, plan.path, k)
        numbers = re.findall(r'font-weight="700" fill="#fff">([\d·]+)</text>', svg)
        assert [int(n) for text in numbers for n in text.split("·")] == list(range(1, k + 1))
        assert "style=" not in svg
    assert ">B<" in picture(plan, plan.path, 1)  # a letter where there is no icon
    assert plan.icons["market"] in picture(plan, plan.path, 1)
    assert picture(street_plan(map_shown=False), None, 1) == ""
