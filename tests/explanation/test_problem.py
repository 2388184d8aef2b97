"""Problems keep their values, in memory and in files; tables by type say what dense tables say."""

import re
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.explanation.problems import plain, random_pair
from tests.handmade import a_file
from tests.refusals import refused
from xplain import InputError, Problem, TooLargeError
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.belief import update
from xplain.explanation.files import load, save
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable, join_steps, stack_types
from xplain.testing.problems import random_problem, with_questions

HALF = np.full((1, 1, 2), 0.5)


def unusual() -> Problem:
    """Makes a problem in which no field has its default."""
    rng = np.random.default_rng(0)
    problem = Problem(
        table=LabelTable.dense(*rng.random((2, 2, 3, 4))),
        message_cost=np.array([0.5, 3.0, 1.0]),  # the last message has no effect
        inexplicability_cost=2.5,
        trade_off=0.7,
        discount=0.8,
        prior=np.array([0.3, 0.7]),
        discount_per="step",
        message_names=("fuel", "fire", "sun"),
        type_names=("novice", "expert"),
        copies=np.array([0, 0, 2]),
    )
    asked = LabelTable.dense(*rng.random((2, 2, 3, 4)))
    limits = Limits(cost=0.3, most=2, when="first")
    shows = np.array([[True, False, False], [False] * 3, [False, False, True]])
    texts, right = ("It needs fuel.\nIt needs none.", "goes right", "waits"), np.array([1, -1, -1])
    problem = replace(problem, questions=Questions(asked, limits, shows, texts, right))
    habits = Habits(*np.array([[0.1, 0.3], [1.0, 0.8], [0.0, 0.1], [0.4, 0.6]]))
    as_found = np.array([True, False, True, False])
    return replace(problem.with_habits(habits), as_found=as_found)


def test_every_field_comes_back_from_a_file(tmp_path: Path) -> None:
    """Also sixty messages, in a small file, and questions without texts."""
    problem, path, rng = unusual(), tmp_path / "problem.npz", np.random.default_rng(1)
    default = Problem(problem.p_explicable, np.ones(3))
    for field in fields(problem):
        if field.default is not MISSING or field.default_factory is not MISSING:
            assert plain(problem)[field.name] != plain(default)[field.name], field.name
    for one in (problem, with_questions(rng, random_problem(rng)), large()):
        save(one, path)
        assert plain(load(path)) == plain(one)
    assert large().table.relevant.tolist() == [[3, 59], [2, 40], [17, -1]]
    assert path.stat().st_size < 20_000


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
    cost, prior = np.ones(3), np.full(4, 0.25)
    made = Problem(problem.p_explicable, cost, prior=prior)
    cost[0] = prior[0] = 9
    assert (made.message_cost[0], made.prior[0]) == (1, 0.25)


def test_a_mixture_by_hand() -> None:
    p = np.array([[[0.2, 0.9]], [[0.6, 0.5]]])
    problem = Problem(p, np.ones(1), prior=np.array([0.25, 0.75]))
    mixed = problem.mixture(problem.prior)
    assert mixed.p_explicable.tolist() == [[pytest.approx([0.5, 0.6])]]
    assert (mixed.prior.tolist(), mixed.n_types) == ([1], 1)
    sure = LabelTable.dense(np.ones((3, 1, 2)))  # with weights that sum to more than 1
    assert sure.mix_types(np.array([0.5, 0.3, 0.2 + 1e-9])).p.max() == 1


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
        *(
            ("wrong", {"p_explicable": HALF, "message_cost": np.ones(1)} | changes, said)
            for changes, said in (
                ({"p_explicable": np.full((1, 1, 3), 0.5)}, "power of two"),
                ({"p_explicable": np.full((1, 1, 1 << 21), 0.5)}, r"at most 2\*\*20"),
                ({"p_explicable": np.array([[["a", "b"]]])}, "numbers"),
                ({"discount": np.nan}, "discount"),
                ({"trade_off": -1.0}, r"lambda \(trade_off\)=-1.0"),
                ({"discount_per": "minute"}, "discount_per='minute'"),
            )
        ),
        ("one.npy", np.ones(3), "not a readable .npz"),
        ("text", b"hello", "not a readable .npz"),
        ("absent", None, "No such file"),
    ],
)
def test_a_file_of_anything_else_is_refused_in_a_line(
    tmp_path: Path, name: str, content: Any, said: str
) -> None:
    with refused(said):
        load(a_file(tmp_path / name, content))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("p_explicable", np.full((2, 3, 3), 0.5)),
        ("p_explicable", np.full((2, 3), 0.5)),
        ("p_explicable", np.empty((0, 3, 4))),
        ("p_explicable", np.empty((2, 0, 4))),
        ("p_explicable", np.empty((2, 3, 0))),
        ("p_explicable", np.full((1, 1, 1 << 21), 0.5)),
        ("p_explicable", np.array([[["a", "b"]]])),
        ("p_explicable", np.full((2, 3, 4), 1.1)),
        ("p_explicable", np.full((2, 3, 4), -0.1)),
        ("p_explicable", np.full((2, 3, 4), np.nan)),
        ("message_cost", np.array([1.0, -1.0, 1.0])),
        ("message_cost", np.ones(2)),
        ("prior", np.array([0.5, 0.4])),
        ("prior", np.array([0.5, 0.5 + 1e-5])),
        ("prior", np.array([0.5, np.nan])),
        ("message_cost", np.array([1.0, np.inf, 1.0])),
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
        ("habits", Habits(*np.full((4, 3), 1 / 3))),  # of four hidden types
        ("copies", np.array([0, 1])),
        ("copies", np.array([0, 2, 1])),
        ("copies", np.array([0, -1, 0])),
        ("whose", np.zeros(3, np.int64)),
        ("as_found", np.ones(5, np.bool_)),
    ],
)
def test_a_bad_field_is_named(key: str, value: Any) -> None:
    values = {field.name: getattr(unusual(), field.name) for field in fields(Problem)}
    values["table"] = unusual().p_explicable
    name = {"lambda (trade_off)": "trade_off", "p_explicable": "table"}.get(key, key)
    with refused(f"^{re.escape(key.replace('as_found', 'whose'))}="):
        Problem(**values | {name: value})


def test_it_says_what_the_dense_table_says(rng_of_the_day: np.random.Generator) -> None:
    """Labels, beliefs, relevant messages, and problems of the table are the same."""
    rng = rng_of_the_day
    for _ in range(60):
        by_type, dense = random_pair(rng)
        assert np.array_equal(by_type.p_explicable, dense.p_explicable)
        for shown in range(1 << dense.n_messages):
            count = int(rng.integers(1, dense.n_steps + 1))
            labels = rng.integers(0, 2, count).astype(np.uint8)
            tables = [one.table.label_probabilities(count, shown) for one in (by_type, dense)]
            assert np.array_equal(*tables)
            assert update(by_type, by_type.prior, shown, labels) == pytest.approx(
                update(dense, dense.prior, shown, labels), abs=1e-12
            )
        found = dense.table.select_messages(dense.table.effective())
        assert found.rows == [list(row) for row in by_type.table.effective()]
        every = by_type.table.effective_of_any()
        assert every == dense.table.effective_of_any() == tuple(sorted(set().union(*found.rows)))
        whole = found.select_messages([range(dense.n_messages)] * dense.n_types)
        assert np.array_equal(whole.p, dense.table.p)
        last = dense.n_types - 1
        made = [
            (one.with_types(one.table.of_types([last]), ("last",)), one.mixture(one.prior))
            for one in (by_type, dense)
        ]
        for mine, other in zip(*made, strict=True):
            assert (mine.p_explicable, mine.message_names) == (
                pytest.approx(other.p_explicable, abs=1e-12),
                other.message_names,
            )
            assert mine.message_cost.tolist() == other.message_cost.tolist()
            assert (mine.type_names, mine.prior.tolist()) == (
                other.type_names,
                other.prior.tolist(),
            )


def large(n: int = 60) -> Problem:
    """Makes a table of 60 messages; each of three types tests one or two of them."""
    rng = np.random.default_rng(1)
    relevant = np.array([[3, 59], [40, 2], [17, -1]])
    return Problem(LabelTable.by_type(relevant, rng.random((3, 4, 4))), np.ones(n))


@pytest.mark.parametrize("many", [20, 21])
def test_twenty_relevant_messages_are_the_most(many: int) -> None:
    """The limit holds for one type, for all types together, and for one type over the parts of a
    trace."""
    half = many // 2
    table = np.arange(many)[None], np.broadcast_to(0.5, (1, 1, 1 << many))
    parts = [
        LabelTable.by_type([own], np.random.default_rng(0).random((1, 1, 1 << len(own))))
        for own in ([*range(half)], [*range(half, many)])
    ]
    both = Problem(stack_types(parts), np.ones(many))
    if many == 20:
        assert LabelTable.by_type(*table).p.shape[1] == 1 << 20
        whole = join_steps(parts)
        for given in (0, 5, 1 << half, (1 << many) - 1):
            each = [part.label_probabilities(1, given)[0, 0] for part in parts]
            assert whole.label_probabilities(2, given)[0].tolist() == each
    else:
        with pytest.raises(InputError, match=r"at most 2\*\*20"):
            LabelTable.by_type(*table)
        with pytest.raises(TooLargeError, match="at most 20"):
            join_steps(parts)
        for refused in (lambda: both.mixture(both.prior), lambda: both.p_explicable):
            with pytest.raises(TooLargeError, match="at most 20"):
                refused()


HALVES = np.full((2, 3, 4), 0.5)


@pytest.mark.parametrize(
    ("key", "changes"),
    [
        ("relevant", {"relevant": [[0, 5], [1, 2]]}),
        ("relevant", {"relevant": [[0, -2], [1, 2]]}),
        ("relevant", {"relevant": [[0, 0], [1, 2]]}),
        ("relevant", {"relevant": [[0.5, 1], [1, 2]]}),
        ("relevant", {"relevant": [0, 1]}),
        ("p_relevant", {"relevant": [[0], [1]]}),
        ("relevant", {"relevant": [[0, 1]]}),
        ("p_relevant", {"p_relevant": np.full((2, 3, 8), 0.5)}),
        ("p_relevant", {"p_relevant": np.full((2, 12), 0.5)}),
        ("p_relevant", {"p_relevant": np.where(np.arange(4) == 2, 1.5, HALVES)}),
        ("p_relevant", {"p_relevant": np.where(np.arange(4) == 2, np.nan, HALVES)}),
        ("message_cost", {"message_cost": np.ones(63)}),
        ("message_cost", {"message_cost": 1.0}),
        ("message_cost", {"message_names": ("one",)}),
    ],
)
def test_bad_tables_are_named(key: str, changes: dict[str, Any]) -> None:
    def problem(relevant: Any = ((0, 1), (1, 2)), p_relevant: Any = HALVES, **rest: Any) -> Problem:
        table = LabelTable.by_type(relevant, p_relevant)
        return Problem(table, **{"message_cost": np.ones(5)} | rest)

    problem()
    with refused(f"^{key}="):
        problem(**changes)
