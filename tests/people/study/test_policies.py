"""From a stored plan to the policies that its study was started with."""

from __future__ import annotations

import json

import pytest

from tests.people.study.stand_in import street_plan, street_study
from xplain.errors import XplainError
from xplain.people.study.evaluation import StudyState
from xplain.people.study.plan import StudyPlan
from xplain.people.study.site import StudySite
from xplain.randomness import stream


def test_code_that_decides_differently_does_not_run_the_study() -> None:
    plan = street_plan()
    value = json.loads(plan.text)
    value["conditions"]["personalized"] = value["conditions"]["conformant"]
    with pytest.raises(XplainError, match="decides differently"):
        StudySite.of(StudyPlan.from_text(json.dumps(value)))


def test_probes_of_stored_plans_are_answered_as_when_they_were_stored() -> None:
    """Another stream of answers would refuse the databases of all earlier studies."""
    study = street_study()
    for number in (0, 1):
        rng = stream(0, "probes", number)
        state = study.after(StudyState(stage="eligibility", user_type=0, condition="conformant"))
        while state.stage == "evaluation":
            labels = [int(one < 0.8) for one in rng.random(state.step + 1)]
            state = study.advance(state, "labels", {"labels": labels})
        last = str([belief.hex() for belief in state.belief])
        assert study.plan.probes["conformant"][number].endswith(last)
