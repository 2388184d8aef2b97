"""From a stored plan to the policies that its study was started with."""

from __future__ import annotations

import json

import pytest

from tests.people.study.stand_in import street_plan
from xplain.errors import XplainError
from xplain.people.study.plan import StudyPlan
from xplain.people.study.policies import study_of


def test_code_that_decides_differently_does_not_run_the_study() -> None:
    plan = street_plan()
    value = json.loads(plan.text)
    value["conditions"]["personalized"] = value["conditions"]["conformant"]
    with pytest.raises(XplainError, match="decides differently"):
        study_of(StudyPlan.from_text(json.dumps(value)))
