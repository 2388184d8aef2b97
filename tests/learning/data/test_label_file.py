import gzip
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from xplain.errors import InputError
from xplain.learning.data.label_file import read_table

ROWS = {
    "observer": ["a", "a", "a", "b", "b", "b"],
    "messages": ["", "m1", "m1;m0", "", "m0", "m0"],
    "row": [1, 2, 2, 1, 2, 1],
    "action": ["up", "left", "left", "up", "left", "up"],
    "label": [0, 1, 1, 0, 0, 1],
}


def table(tmp_path: Path, **changes: object) -> Path:
    path = tmp_path / "labels.csv"
    rows = {**ROWS, **changes}
    pd.DataFrame({k: v for k, v in rows.items() if v is not None}).to_csv(path, index=False)
    return path


def test_columns_become_a_dataset(tmp_path: Path) -> None:
    dataset = read_table(table(tmp_path))
    assert dataset.observers == ("a", "b")
    assert dataset.messages == ("m0", "m1")
    assert dataset.feature_names == ("row", "action=left", "action=up")
    assert dataset.message_set.tolist() == [0, 2, 3, 0, 1, 1]
    assert dataset.label.tolist() == ROWS["label"]
    shown = dataset.features[dataset.transition]
    assert shown.tolist() == [
        [r, float(a == "left"), float(a == "up")]
        for r, a in zip(ROWS["row"], ROWS["action"], strict=True)
    ]
    # Equal features are the same transition.
    assert len(dataset.features) == 2


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"label": None}, "lacks the column label"),
        ({"observer": None}, "lacks the column observer"),
        ({"row": None, "action": None}, "describes the transition"),
        ({"label": [0, 1, 2, 0, 1, 1]}, "row 3; a label is 0 or 1"),
        ({"label": ["yes", 1, 1, 0, 1, 1]}, "data='yes'"),
        (
            {"label": [0.5, 1, 1, 0, 1, 1]},
            "^data='0.5': no label in 1 rows of label, first in row 1",
        ),
        ({"label": [0, 1, None, 0, 1, 1]}, "missing in 1 rows of label, first in row 3"),
        ({"label": [1] * 6}, "all labels are equal"),
        ({"observer": ["a"] * 6}, "one observer; types need"),
        (
            {"observer": ["a", "", "", "b", "b", "b"]},
            "missing in 2 rows of observer, first in row 2",
        ),
        ({"row": [1, 2, None, 1, 2, 1]}, "ignore=\\[row\\]"),
        ({"row": [1, 2, np.inf, 1, 2, 1]}, "infinite in 1 rows of row, first in row 3"),
        ({"messages": ["m0"] * 6, "row": [1, 1, 2, 1, 2, 2], "action": None}, "at least 4"),
        ({"messages": [f"x{i}" for i in range(5)] + [";".join(f"y{i}" for i in range(60))]}, "62"),
    ],
)
def test_bad_tables_are_named_in_a_line(
    tmp_path: Path, changes: dict[str, object], said: str
) -> None:
    with pytest.raises(InputError, match=said) as caught:
        read_table(table(tmp_path, **changes))
    assert "\n" not in str(caught.value)


def test_unknown_messages_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"='m1': unknown message .* row 2; known: m0, m9"):
        read_table(table(tmp_path), messages=("m0", "m9"))
    with pytest.raises(
        InputError, match="data='m1;m0': unknown message in 1 rows of messages, first in row 3"
    ):
        read_table(table(tmp_path, messages=["", "", "m1;m0", *[""] * 3]), messages=("m9",))


@pytest.mark.parametrize("name", ["nowhere.csv", "labels.xlsx"])
def test_files_that_cannot_be_read(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=name):
        read_table(tmp_path / name)


@pytest.mark.parametrize("name", ["bad.csv", "bad.parquet"])
def test_files_that_are_no_tables(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"\x00\x01\xff" * 9)
    with pytest.raises(InputError):
        read_table(tmp_path / name)
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match="not a readable table"):
        read_table(tmp_path / name)
    written = table(tmp_path).read_text()
    (tmp_path / "cut.csv.gz").write_bytes(gzip.compress(written.encode())[:-12])
    (tmp_path / "twice.csv").write_text(written.replace("row,action", "label,action", 1))
    (tmp_path / "header.csv").write_text(written.splitlines()[0] + "\n")
    for broken, said in (
        ("cut.csv.gz", "not a readable table"),
        ("twice.csv", "data='label': two columns"),
        ("header.csv", "has no rows"),
    ):
        with pytest.raises(InputError, match=said):
            read_table(tmp_path / broken)


def test_a_feature_may_have_thousands_of_values(tmp_path: Path, rng: np.random.Generator) -> None:
    """Rows that differ are told apart, and equal ones are one, in whatever columns they differ."""
    count = 4000
    rows = pd.DataFrame(
        {
            "observer": np.arange(count) % 3,
            "messages": np.array(["", "m0"])[np.arange(count) % 2],
            "near": rng.integers(1500, size=count),
            "far": rng.integers(3, size=count),
            "farther": rng.integers(1500, size=count) / 7,
            "label": rng.integers(2, size=count),
        }
    )
    rows = pd.concat([rows, rows.iloc[:50]])
    rows.to_parquet(tmp_path / "many.parquet", index=False)
    dataset = read_table(tmp_path / "many.parquet")
    told = rows[["near", "far", "farther"]].to_numpy(dtype=float)
    assert np.array_equal(dataset.features[dataset.transition], told)
    assert len(dataset.features) == len(np.unique(told, axis=0))


def test_spaces_around_names_are_none_of_them(tmp_path: Path) -> None:
    path = table(
        tmp_path,
        observer=["a", "a ", " a", "b", "b", "b"],
        messages=["", " m1", "m1 ; m0", "", "m0;", " m0"],
    )
    dataset = read_table(path)
    assert dataset.observers == ("a", "b")
    assert dataset.messages == ("m0", "m1")
    assert dataset.message_set.tolist() == [0, 2, 3, 0, 1, 1]


def test_yes_and_no_are_numbers(tmp_path: Path) -> None:
    wet = [True, False, False, True, False, True]
    pd.DataFrame({**ROWS, "wet": wet}).to_parquet(tmp_path / "labels.parquet", index=False)
    for path in (table(tmp_path, wet=wet), tmp_path / "labels.parquet"):
        dataset = read_table(path)
        assert dataset.feature_names == ("row", "action=left", "action=up", "wet")
        assert dataset.features[dataset.transition][:, 3].tolist() == wet


def test_columns_that_are_asked_for_or_left_out_must_be_there_once(tmp_path: Path) -> None:
    path = table(tmp_path, age=[30, 30, None, 40, 40, 40])
    assert read_table(path, features=["row", "action"]).feature_names[0] == "row"
    with pytest.raises(InputError, match="age"):
        read_table(path)
    with pytest.raises(InputError, match="lacks the column height"):
        read_table(path, ignore=["height"])
    with pytest.raises(InputError, match="each column once"):
        read_table(path, features=["row", "row"])
    # Who is asked what is always read.
    assert read_table(path, ignore=["age", "label", "observer"]).observers == ("a", "b")


def test_features_are_put_in_the_order_of_a_domain(tmp_path: Path) -> None:
    path, names = table(tmp_path), ("action=down", "action=left", "action=up", "row")
    aligned = read_table(path, like=names)
    assert aligned.feature_names == names
    assert aligned.features[aligned.transition][:, 3].tolist() == ROWS["row"]
    assert not aligned.features[:, 0].any()
    with pytest.raises(InputError, match="data='column': this column is missing"):
        read_table(path, like=(*names, "column"))
    with pytest.raises(InputError, match="data='row': unknown feature"):
        read_table(path, like=names[:3])
    with pytest.raises(InputError, match="data='up': unknown value in 3 rows of action"):
        read_table(path, like=("action=down", "action=left", "row"))
