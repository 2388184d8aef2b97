"""Exported tables: no column without a meaning, no meaning without a column, no formula."""

from __future__ import annotations

import pytest

from xplain.people.export import defuse, order_columns

CODEBOOK = ["who", "stated_…", "number"]


def test_columns_are_those_of_the_codebook_in_its_order_and_others_last() -> None:
    rows = [{"number": n, "stated_b": 1, "who": name, "stated_a": 0} for n, name in enumerate("xy")]
    table = order_columns("people", rows, CODEBOOK)
    assert list(table.columns) == ["who", "number", "stated_b", "stated_a"]
    assert table.to_dict("records") == rows


@pytest.mark.parametrize(
    ("row", "named"),
    [
        ({"who": "x", "number": 1, "age": 3}, "age"),  # nobody would know what it means
        ({"who": "x"}, "number"),  # it would be lost
        ({"who": "x", "number": 1, "stated": 1}, "stated"),
        ({"who": "x", "number": 1, "stated_…": 1}, "stated_…"),
    ],
)
def test_a_row_that_is_not_as_its_codebook_says_is_refused(
    row: dict[str, object], named: str
) -> None:
    with pytest.raises(ValueError, match=f"^people: .*'{named}'"):
        order_columns("people", [row], CODEBOOK)


def test_no_cell_is_a_formula() -> None:
    for text in (
        "=1+1",
        "+A1",
        "-A1",
        "@SUM(A1)",
        "\t=1",
        "\r=1",
        "\uff1d1+1",
        "\uff0b1",
        "\uff0d1",
        "\uff20A1",
    ):
        assert defuse(text) == f"'{text}"
    for harmless in ("1 + 1", "a=b", "", -1, -1.5, None, "[1, 0]"):
        assert defuse(harmless) == harmless
