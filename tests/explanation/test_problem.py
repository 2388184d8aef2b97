"""Problems keep their values, in memory and in files."""

import re
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.explanation.problems import plain
from tests.refusals import refused
from xplain.errors import InputError
from xplain.explanation.asking import Limits, Questions, make_question
from xplain.explanation.files import load, save
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.testing.problems import random_problem, with_questions

HALF = np.full((1, 1, 2), 0.5)


def unusual() -> Problem:
    """Makes a problem in which no field has its default."""
    rng = np.random.default_rng(0)
    problem = Problem(
        table=LabelTable.dense(*rng.random((2, 2, 3, 4))),
        message_cost=np.array([0.5, 3.0]),
        inexplicability_cost=2.5,
        trade_off=0.7,
        discount=0.8,
        prior=np.array([0.3, 0.7]),
        discount_per="step",
        message_names=("fuel", "fire"),
        type_names=("novice", "expert"),
        copies=np.array([0, 0, 2]),
    )
    asked = LabelTable.dense(*rng.random((2, 2, 3, 4)))
    limits = Limits(cost=0.3, most=2, when="first")
    shows = np.array([[True, False, False], [False] * 3, [False, False, True]])
    texts = "goes left", "goes right", "waits"
    problem = replace(problem, questions=Questions(asked, limits, shows, texts))
    habits = Habits(*np.array([[0.1, 0.3], [1.0, 0.8], [0.0, 0.1], [0.4, 0.6]]))
    as_found = np.array([True, False, True, False])
    return replace(problem.with_habits(habits), as_found=as_found)


def test_every_field_comes_back_from_a_file(tmp_path: Path) -> None:
    problem = unusual()
    default = Problem(problem.p_explicable, np.ones(2))
    for field in fields(problem):
        if field.default is not MISSING or field.default_factory is not MISSING:
            assert plain(problem)[field.name] != plain(default)[field.name], field.name
    save(problem, tmp_path / "problem.npz")
    assert plain(load(tmp_path / "problem.npz")) == plain(problem)


def test_a_file_may_hold_tables_and_costs_alone(tmp_path: Path) -> None:
    problem = unusual()
    arrays = {"p_explicable": problem.p_explicable, "message_cost": problem.message_cost}
    np.savez(tmp_path / "problem.npz", **arrays)
    assert plain(load(tmp_path / "problem.npz")) == plain(
        Problem(problem.p_explicable, problem.message_cost)
    )


def test_what_is_left_out_is_as_documented() -> None:
    problem = Problem(np.full((4, 1, 2), 0.5), np.array([2.0]))
    assert problem.prior.tolist() == [0.25] * 4
    assert (problem.inexplicability_cost, problem.trade_off, problem.discount) == (1, 1, 0.95)
    assert problem.discount_per == "action"
    assert (len(problem.type_names), len(problem.message_names)) == (4, 1)


def test_62_messages_are_the_most_by_type() -> None:
    table = LabelTable.by_type([[0]], HALF)
    assert Problem(table, np.ones(62)).n_messages == 62
    with pytest.raises(InputError, match="at most 62"):
        Problem(table, np.ones(63))
    # One cost for all, where names say how many there are.
    named = Problem(table, np.array(2.0), message_names=("a", "b", "c"))
    assert named.message_cost.tolist() == [2, 2, 2]


def test_nobody_changes_a_problem_by_its_arrays() -> None:
    problem = unusual()
    for array in (problem.p_explicable, problem.message_cost):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    cost, prior = np.ones(2), np.full(4, 0.25)
    made = Problem(problem.p_explicable, cost, prior=prior)
    cost[0] = prior[0] = 9
    assert (made.message_cost[0], made.prior[0]) == (1, 0.25)


def test_a_mixture_by_hand() -> None:
    p = np.array([[[0.2, 0.9]], [[0.6, 0.5]]])
    problem = Problem(p, np.ones(1), prior=np.array([0.25, 0.75]))
    mixed = problem.mixture(problem.prior)
    assert mixed.p_explicable.tolist() == [[pytest.approx([0.5, 0.6])]]
    assert (mixed.prior.tolist(), mixed.n_types) == ([1], 1)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("lacks", {"p_explicable": HALF}, "lacks message_cost"),
        ("half", {"message_cost": np.ones(1), "relevant": np.array([[0]])}, "lacks p_relevant"),
        (
            "more",
            {
                "p_explicable": np.full((1, 1, 2), 0.5),
                "message_cost": np.ones(1),
                "why": np.ones(1),
            },
            "problem='why': unknown array",
        ),
        (
            "pickled",
            {"p_explicable": np.array([None]), "message_cost": np.ones(1)},
            "not a readable",
        ),
        ("one.npy", np.ones(3), "not a readable .npz"),
        ("text", b"hello", "not a readable .npz"),
        ("absent", None, "No such file"),
    ],
)
def test_a_file_of_anything_else_is_refused_in_a_line(
    tmp_path: Path, name: str, content: Any, said: str
) -> None:
    path = tmp_path / name
    if isinstance(content, dict):
        with path.open("wb") as file:
            np.savez(file, **content)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        np.save(path, content)
    with refused(said):
        load(path)


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
        ("prior", np.array([0.5, 0.5 + 1e-5])),
        ("prior", np.array([0.5, np.nan])),
        ("message_cost", np.array([1.0, np.inf])),
        ("inexplicability_cost", np.array([1.0, 1.0])),
        ("prior", np.array([1.5, -0.5])),
        ("prior", np.ones(1)),
        ("inexplicability_cost", -1.0),
        ("lambda (trade_off)", -0.5),
        ("discount", 0.0),
        ("discount", 1.5),
        ("discount_per", "minute"),
        ("message_names", ("one",)),
        ("type_names", ("one", "two", "three")),
    ],
)
def test_a_bad_field_is_named(key: str, value: Any) -> None:
    values = {field.name: getattr(unusual(), field.name) for field in fields(Problem)}
    values["table"] = unusual().p_explicable
    name = {"lambda (trade_off)": "trade_off", "p_explicable": "table"}.get(key, key)
    with refused(f"^{re.escape(key)}="):
        Problem(**values | {name: value})


@given(st.integers(0, 2**32 - 1), st.booleans())
@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_a_saved_problem_carries_its_questions(tmp_path: Path, seed: int, words: bool) -> None:
    rng = np.random.default_rng(seed)
    problem = with_questions(rng, random_problem(rng))
    asked = problem.questions
    assert asked is not None
    if words:
        right = rng.integers(-1, 2, len(asked))
        texts = tuple(
            f"“{q}” is so.\nIt is not." if r >= 0 else f"{q}" for q, r in enumerate(right)
        )
        shows = rng.random((len(asked), problem.n_steps)) < 0.5
        asked = replace(asked, texts=texts, right=right, shows=shows)
        problem = replace(problem, questions=asked)
    save(problem, tmp_path / "problem.npz")
    loaded = load(tmp_path / "problem.npz").questions
    assert loaded is not None
    assert (loaded.limits, loaded.texts) == (asked.limits, asked.texts)
    np.testing.assert_array_equal(loaded.right, asked.right)
    np.testing.assert_array_equal(loaded.shows, asked.shows)
    for given_ in range(1 << problem.n_messages):
        for table in ("label_probabilities", "answer_probabilities"):
            one, other = (getattr(q.table, table)(len(asked), given_) for q in (asked, loaded))
            np.testing.assert_array_equal(one, other)
    assert [loaded.question(q) for q in range(len(asked))] == [
        asked.question(q) for q in range(len(asked))
    ]


def test_a_belief_shows_its_sentences_in_the_order_given() -> None:
    for right in (0, 1):
        question = make_question(3, "It needs fuel.\nIt needs none.", right)
        assert [words for words, _ in question.replies] == ["It needs fuel.", "It needs none."]
        assert question.replies[right][1] == 1
        assert question.replies[1 - right][1] == 0
        assert "fuel" in str(question)
