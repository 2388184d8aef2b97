"""Problems keep what they are given, in memory and in files."""

from __future__ import annotations

from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from xplain.errors import InputError
from xplain.explanation.problem import Problem


def unusual() -> Problem:
    """No field has its default."""
    rng = np.random.default_rng(0)
    return Problem(
        p_explicable=rng.random((2, 3, 4)),
        message_cost=np.array([0.5, 3.0]),
        inexplicability_cost=2.5,
        trade_off=0.7,
        discount=0.8,
        prior=np.array([0.3, 0.7]),
        discount_per="step",
        message_names=("fuel", "fire"),
        type_names=("novice", "expert"),
    )


def plain(problem: Problem) -> dict[str, Any]:
    """Every field, arrays as lists."""
    values = {field.name: getattr(problem, field.name) for field in fields(problem)}
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}


def test_every_field_comes_back_from_a_file(tmp_path: Path) -> None:
    problem = unusual()
    default = Problem(problem.p_explicable, np.ones(2))
    for field in fields(problem):
        if field.name in ("relevant", "p_relevant"):  # in the place of the table, not beside it
            continue
        if field.default is not MISSING or field.default_factory is not MISSING:
            assert plain(problem)[field.name] != plain(default)[field.name], field.name
    problem.save(tmp_path / "problem.npz")
    assert plain(Problem.load(tmp_path / "problem.npz")) == plain(problem)


def test_a_file_may_hold_tables_and_costs_alone(tmp_path: Path) -> None:
    problem = unusual()
    arrays = {"p_explicable": problem.p_explicable, "message_cost": problem.message_cost}
    np.savez(tmp_path / "problem.npz", **arrays)
    assert plain(Problem.load(tmp_path / "problem.npz")) == plain(Problem(**arrays))


def test_what_is_left_out_is_as_documented() -> None:
    problem = Problem(np.full((4, 1, 2), 0.5), np.array([2.0]))
    assert problem.prior.tolist() == [0.25] * 4
    assert (problem.inexplicability_cost, problem.trade_off, problem.discount) == (1, 1, 0.95)
    assert problem.discount_per == "action"
    assert (len(problem.type_names), len(problem.message_names)) == (4, 1)


def test_other_types_keep_the_costs_and_are_equally_likely() -> None:
    problem = unusual()
    other = problem.with_types(np.full((4, 3, 4), 0.25), ("a", "b", "c", "d"))
    changed = {"p_explicable", "prior", "type_names"}
    assert {k: v for k, v in plain(other).items() if k not in changed} == {
        k: v for k, v in plain(problem).items() if k not in changed
    }
    assert other.prior.tolist() == [0.25] * 4
    assert other.type_names == ("a", "b", "c", "d")


def test_a_prior_is_a_distribution_to_the_last_bit_however_often_it_is_handed_on() -> None:
    first = Problem(np.full((3, 1, 1), 0.5), np.empty(0), prior=np.array([0.3, 0.3, 0.4 + 5e-7]))
    assert first.prior.sum() == pytest.approx(1, abs=1e-15)
    assert first.prior == pytest.approx(np.array([0.3, 0.3, 0.4]), abs=1e-6)
    again = Problem(first.p_explicable, np.empty(0), prior=first.prior)
    assert np.array_equal(again.prior, first.prior)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("p_explicable", np.full((2, 3, 3), 0.5)),
        ("p_explicable", np.full((2, 3), 0.5)),
        ("p_explicable", np.full((2, 3, 4), 1.1)),
        ("p_explicable", np.full((2, 3, 4), -0.1)),
        ("p_explicable", np.full((2, 3, 4), np.nan)),
        ("message_cost", np.array([1.0, -1.0])),
        ("message_cost", np.ones(3)),
        ("prior", np.array([0.5, 0.4])),
        ("prior", np.array([1.5, -0.5])),
        ("prior", np.ones(1)),
        ("inexplicability_cost", -1.0),
        ("lambda", -0.5),
        ("discount", 0.0),
        ("discount", 1.5),
        ("discount_per", "minute"),
        ("message_names", ("one",)),
        ("type_names", ("one", "two", "three")),
    ],
)
def test_a_bad_field_is_named(key: str, value: Any) -> None:
    given = {field.name: getattr(unusual(), field.name) for field in fields(Problem)}
    with pytest.raises(InputError) as caught:
        Problem(**given | {"trade_off" if key == "lambda" else key: value})
    assert caught.value.key == key
    assert "\n" not in str(caught.value)
