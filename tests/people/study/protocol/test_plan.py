"""The plan as a value that is stored and read back."""

from __future__ import annotations

import pytest

from xplain.errors import InputError
from xplain.people.study.plan import StudyRules


@pytest.mark.parametrize("key", ["per_cell", "max_attempts", "timeout_minutes"])
@pytest.mark.parametrize("value", [0, -1, float("nan")])
def test_rules_that_let_nobody_through_are_named(key: str, value: float) -> None:
    numbers = {"per_cell": 4, "max_attempts": 3, "timeout_minutes": 30.0} | {key: value}
    with pytest.raises(InputError, match=rf"rules\.{key}"):
        StudyRules(**numbers, recall=True)  # type: ignore[arg-type]
