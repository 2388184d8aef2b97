"""One line that says what, where and what instead."""

from __future__ import annotations

import pickle

import pytest

from xplain.errors import InputError, discount_factor, number, whole_number


def test_a_long_value_keeps_both_ends() -> None:
    path = "/a/long/way/" + "below/" * 40 + "labels.csv"
    text = str(InputError("data", path, "a table"))
    assert text.startswith("data='/a/long/way/below/")
    assert text.endswith("labels.csv': a table")
    assert len(text) == len("data=") + 80 + len(": a table")
    assert str(InputError("data", "x" * 78, "a table")) == f"data='{'x' * 78}': a table"


def test_an_error_comes_whole_out_of_another_process() -> None:
    error = InputError("lambda", -1, "a number ≥ 0")
    again = pickle.loads(pickle.dumps(error))
    assert (again.key, again.value, again.allowed) == ("lambda", -1, "a number ≥ 0")
    assert str(again) == str(error)


@pytest.mark.parametrize("value", [True, "1", None, float("nan"), float("inf")])
def test_what_is_no_finite_number_is_refused(value: object) -> None:
    with pytest.raises(InputError, match="finite"):
        number("key", value)


def test_limits_are_part_of_what_is_allowed_or_not() -> None:
    assert whole_number("key", 2, 2) == 2
    assert discount_factor("key", 0.5) == 0.5
    for value in (1, 2.0, True, "2"):
        with pytest.raises(InputError, match="whole number ≥ 2"):
            whole_number("key", value, 2)
    for factor in (0, 1, -0.1):
        with pytest.raises(InputError, match="both ends excluded"):
            discount_factor("key", factor)
