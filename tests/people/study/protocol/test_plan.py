"""The plan as a value that is stored and read back."""

from __future__ import annotations

import pytest

from tests.people.study.stand_in import street_plan
from xplain.errors import InputError
from xplain.people.study.plan import StudyPlan, StudyRules


def test_a_plan_survives_storage_to_the_last_bit() -> None:
    for shown in (True, False):
        plan = street_plan(shown)
        again = StudyPlan.from_text(plan.text)
        assert again.text == plan.text
        assert again.hash == plan.hash
        assert again.problem.p_explicable.tobytes() == plan.problem.p_explicable.tobytes()
        assert (again.scene, again.path, again.roles) == (plan.scene, plan.path, plan.roles)


@pytest.mark.parametrize("key", ["per_cell", "max_attempts", "timeout_minutes"])
@pytest.mark.parametrize("value", [0, -1, float("nan")])
def test_rules_that_let_nobody_through_are_named(key: str, value: float) -> None:
    numbers = {"per_cell": 4, "max_attempts": 3, "timeout_minutes": 30.0} | {key: value}
    with pytest.raises(InputError, match=rf"rules\.{key}"):
        StudyRules(**numbers, recall=True)  # type: ignore[arg-type]
