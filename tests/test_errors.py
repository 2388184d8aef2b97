"""Errors are one line with key, value and what is allowed."""

import pickle
import signal
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import pytest

from xplain.errors import (
    Count,
    InputError,
    Range,
    checks,
    leave_at_once,
    number,
    one_of,
    whole_number,
)


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


def test_ctrl_c_leaves_at_once_while_libraries_load_unless_another_handler_is_there() -> None:
    for before in (signal.SIG_IGN, signal.default_int_handler):
        signal.signal(signal.SIGINT, before)
        with leave_at_once():
            assert (signal.getsignal(signal.SIGINT) == before) == (before == signal.SIG_IGN)
        assert signal.getsignal(signal.SIGINT) == before


@pytest.mark.parametrize("value", [True, "1", None, float("nan"), float("inf")])
def test_what_is_no_finite_number_is_refused(value: object) -> None:
    with pytest.raises(InputError, match="finite"):
        number("key", value)


def test_limits_are_part_of_what_is_allowed_or_not() -> None:
    assert whole_number("key", 2, 2) == 2
    assert number("key", 0.5, Range(0, 1, "()")) == 0.5
    for value in (1, 2.0, True, "2"):
        with pytest.raises(InputError, match="whole number ≥ 2"):
            whole_number("key", value, 2)
    for value in (0, 8):
        with pytest.raises(InputError, match=r"whole number in 1 … 7"):
            whole_number("key", value, 1, 7)


@pytest.mark.parametrize("ends", ["[]", "[)", "(]", "()"])
def test_ends_are_allowed_as_their_brackets_say(ends: Literal["[]", "[)", "(]", "()"]) -> None:
    for value, bracket, others in ((0, ends[0], "("), (1, ends[1], ")")):
        if bracket == others:
            with pytest.raises(InputError, match=rf"key={value}: a number in \{ends[0]}0, 1"):
                number("key", value, Range(0, 1, ends))
        else:
            assert number("key", value, Range(0, 1, ends)) == value
    with pytest.raises(InputError, match=f"a number {'≥' if ends[0] == '[' else '>'} 0$"):
        number("key", -1, Range(0, ends=ends))


@checks("thing")
@dataclass(frozen=True)
class Thing:
    """A class with annotated parameters."""

    count: Count
    share: Annotated[float, Range(0, 1)] = 0.5
    way: Literal["here", "there"] = "here"
    most: Count | None = None


def test_what_annotations_do_not_allow_is_refused_by_its_key() -> None:
    thing = Thing(1, way="there", most=3)
    assert thing == Thing(count=1, share=0.5, way="there", most=3)
    assert replace(thing, most=None).most is None
    refused = {
        "count": (0, "a whole number ≥ 1"),
        "share": (1.5, "a number in [0, 1]"),
        "way": ("up", "one of here, there"),
        "most": (0, "a whole number ≥ 1"),
    }
    for name, (value, allowed) in refused.items():
        with pytest.raises(InputError) as error:
            replace(thing, **{name: value})
        assert str(error.value) == f"thing.{name}={value!r}: {allowed}"
    with pytest.raises(TypeError):
        Thing(number=1)  # type: ignore[call-arg]


def test_a_choice_is_one_of_those_that_there_are() -> None:
    assert one_of("key", "a", ("a", "b")) == "a"
    with pytest.raises(InputError, match="one of a, b"):
        one_of("key", ["a"], ("a", "b"))  # also what cannot be hashed
