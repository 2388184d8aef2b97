"""A table over the messages relevant to each type gives the same numbers as the dense table."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.explanation.problems import plain, random_pair
from tests.refusals import refused
from xplain.errors import InputError, TooLargeError
from xplain.explanation.belief import update
from xplain.explanation.files import load, save
from xplain.explanation.label_table import LabelTable, join_steps, stack_types
from xplain.explanation.problem import Problem


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
            assert mine.p_explicable == pytest.approx(other.p_explicable, abs=1e-12)
            assert mine.message_names == other.message_names
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


def test_sixty_messages_come_back_from_a_file(tmp_path: Path) -> None:
    problem = large()
    assert problem.table.relevant.tolist() == [[3, 59], [2, 40], [17, -1]]
    save(problem, tmp_path / "problem.npz")
    assert plain(load(tmp_path / "problem.npz")) == plain(problem)
    assert (tmp_path / "problem.npz").stat().st_size < 20_000


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


HALF = np.full((2, 3, 4), 0.5)


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
        ("p_relevant", {"p_relevant": np.where(np.arange(4) == 2, 1.5, HALF)}),
        ("p_relevant", {"p_relevant": np.where(np.arange(4) == 2, np.nan, HALF)}),
        ("message_cost", {"message_cost": np.ones(63)}),
        ("message_cost", {"message_cost": 1.0}),
        ("message_cost", {"message_names": ("one",)}),
    ],
)
def test_bad_tables_are_named(key: str, changes: dict[str, Any]) -> None:
    def problem(relevant: Any = ((0, 1), (1, 2)), p_relevant: Any = HALF, **rest: Any) -> Problem:
        table = LabelTable.by_type(relevant, p_relevant)
        return Problem(table, **{"message_cost": np.ones(5)} | rest)

    problem()
    with refused(f"^{key}="):
        problem(**changes)
