"""The plan as a value that is stored and read back."""

from __future__ import annotations

from tests.study.stand_in import street_plan
from xplain.study.protocol.plan import StudyPlan


def test_a_plan_survives_storage_to_the_last_bit() -> None:
    for shown in (True, False):
        plan = street_plan(shown)
        again = StudyPlan.from_text(plan.text)
        assert again.text == plan.text
        assert again.hash == plan.hash
        assert again.problem.p_explicable.tobytes() == plan.problem.p_explicable.tobytes()
        assert (again.scene, again.path, again.roles) == (plan.scene, plan.path, plan.roles)
