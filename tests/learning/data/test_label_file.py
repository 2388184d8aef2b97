"""People's own tables are read as written, or one line says what to do."""

import gzip
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.refusals import refused
from xplain.errors import InputError
from xplain.learning.data.label_file import (
    option,
    read_cells,
    read_questions,
    read_table,
    write_table,
)

ROWS = {
    "observer": ["a", "a", "a", "b", "b", "b"],
    "messages": ["", "m1", "m1;m0", "", "m0", "m0"],
    "row": [1, 2, 2, 1, 2, 1],
    "action": ["up", "left", "left", "up", "left", "up"],
    "label": [0, 1, 1, 0, 0, 1],
}


TEXT = pd.DataFrame(ROWS).to_csv(index=False)


def table(tmp_path: Path, **changes: object) -> Path:
    path = tmp_path / "labels.csv"
    rows = {**ROWS, **changes}
    pd.DataFrame({k: v for k, v in rows.items() if v is not None}).to_csv(path, index=False)
    return path


def followed(text: str, advice: str) -> list[str]:
    """Returns the value that the advice in a text gives to its key."""
    (word,) = shlex.split(text.partition(advice)[2].partition("\n")[0] if advice else text)
    (override,) = OverridesParser.create().parse_overrides([word])
    value = override.value()
    assert isinstance(value, list)
    return value


def quoted(cell: str) -> str:
    return '"' + cell.replace('"', '""') + '"'


def numbered(text: str) -> str:
    """Writes the number of each row before its first cell, as if by a name of the row."""
    header, *rows = text.splitlines()
    return "\n".join([header, *(f"{i},{row}" for i, row in enumerate(rows))])


QUALTRICS = ",".join(["Who?"] * 5) + "\n" + ",".join([quoted('{"ImportId":"QID1"}')] * 5) + "\n"
"""What Qualtrics writes below the header."""
SPACED = {
    "observer": ["a", "a ", " a", "b", "b", "b"],
    "messages": ["", " m1", "m1 ; m0", "", "m0;", " m0"],
}


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({}, lambda text: text),
        (SPACED, lambda text: text),
        ({}, lambda text: f"\n\n{text}"),
        ({}, lambda text: text.replace("\n", f"\n{QUALTRICS}", 1)),
        ({}, lambda text: f",{numbered(text)}"),  # rows with names
        ({}, lambda text: text.replace(",", " ,", 4)),
    ],
)
def test_columns_become_a_dataset(tmp_path: Path, changes: dict[str, object], text: Any) -> None:
    path = table(tmp_path, **changes)
    path.write_text(text(path.read_text()))
    dataset = read_table(path)
    assert (dataset.observers, dataset.messages, dataset.feature_names) == (
        ("a", "b"),
        ("m0", "m1"),
        ("row", "action=left", "action=up"),
    )
    assert dataset.message_set.tolist() == [0, 2, 3, 0, 1, 1]
    assert dataset.label.tolist() == ROWS["label"]
    shown = dataset.features[dataset.transition]
    assert shown.tolist() == [
        [r, float(a == "left"), float(a == "up")]
        for r, a in zip(ROWS["row"], ROWS["action"], strict=True)
    ]
    # Equal features are the same transition.
    assert len(dataset.features) == 2


ORDERED = ("action=down", "action=left", "action=up", "row")


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
        ({"age": [30, 30, None, 40, 40, 40]}, "age"),
    ],
)
def test_bad_tables_are_named_in_a_line(
    tmp_path: Path, changes: dict[str, object], said: str
) -> None:
    with refused(said):
        read_table(table(tmp_path, **changes))


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (
            {"messages": ("m0", "m9")},
            r"data='m1': unknown message in 2 rows .* row 2; known: m0, m9",
        ),
        ({"ignore": ["height"]}, "lacks the column height"),
        ({"features": ["row", "row"]}, "each column once"),
        ({"like": (*ORDERED, "column")}, "data='column': this column is missing"),
        ({"like": ORDERED[:3]}, "data='row': unknown feature"),
        (
            {"like": ("action=down", "action=left", "row")},
            "data='up': unknown value in 3 rows of action",
        ),
    ],
)
def test_what_is_asked_for_and_not_there_is_named(
    tmp_path: Path, asked: dict[str, Any], said: str
) -> None:
    with refused(said):
        read_table(table(tmp_path), **asked)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("nowhere.csv", None, "nowhere.csv"),
        ("labels.xlsx", None, "labels.xlsx"),
        ("bad.csv", b"\x00\x01\xff" * 9, "not in UTF-8"),
        ("bad.parquet", b"\x00\x01\xff" * 9, "not a readable table"),
        ("empty.csv", b"", "not a readable table"),
        ("empty.parquet", b"", "not a readable table"),
        ("cut.csv.gz", gzip.compress(b"observer,label,row\na,1,2\n")[:-12], "not a readable table"),
        ("twice.csv", b"observer,label,label\na,1,2\n", "data='label': two columns"),
        ("header.csv", b"observer,label,row\n", "has no rows"),
        ("short.csv", f"{TEXT}a,m0,1\n".encode(), "line 8 has 3 cells, the header has 5"),
        ("long.csv", f"{TEXT}a,,1,up,0,9\n".encode(), "line 8 has 6 cells, the header has 5"),
        ("numbers.csv", numbered(TEXT).encode(), "begin the header with a comma"),
        (
            "above.csv",
            f"My experiment\n{TEXT}".encode(),
            "'My experiment', is no header; delete it",
        ),
        # A comma before the header would shift every column.
        (
            "behind.csv",
            TEXT.replace("\n", ",\n").replace("label,", "label").encode(),
            "line 2 has 6 cells(?!.*begin the header)",
        ),
        *(
            (
                "nearly.csv",
                TEXT.replace(meant, header, 1).encode(),
                f"data='{header}': rename this column",
            )
            for meant, header in [
                ("observer", "Observer"),
                ("messages", "MESSAGES"),
                ("messages", "message"),
                ("label", "Label"),
                ("row", "zone=river"),
            ]
        ),
    ],
)
def test_files_that_are_no_tables(
    name: str, content: bytes | None, said: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=said):
        read_table(tmp_path / name)


def test_a_feature_may_have_thousands_of_values(tmp_path: Path, rng: np.random.Generator) -> None:
    """Different rows are different steps, and equal rows are one step, whatever columns differ."""
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


def test_yes_and_no_are_numbers(tmp_path: Path) -> None:
    wet = [True, False, False, True, False, True]
    pd.DataFrame({**ROWS, "wet": wet}).to_parquet(tmp_path / "labels.parquet", index=False)
    for path in (table(tmp_path, wet=wet), tmp_path / "labels.parquet"):
        dataset = read_table(path)
        assert dataset.feature_names == ("row", "action=left", "action=up", "wet")
        assert dataset.features[dataset.transition][:, 3].tolist() == wet


def test_columns_are_asked_for_or_left_out(tmp_path: Path) -> None:
    path = table(tmp_path, age=[30, 30, None, 40, 40, 40])
    assert read_table(path, features=["row", "action"]).feature_names[0] == "row"
    # The columns of observers and labels are always read.
    assert read_table(path, ignore=["age", "label", "observer"]).observers == ("a", "b")


def test_features_are_put_in_the_order_of_a_domain(tmp_path: Path) -> None:
    aligned = read_table(table(tmp_path), like=ORDERED)
    assert aligned.feature_names == ORDERED
    assert aligned.features[aligned.transition][:, 3].tolist() == ROWS["row"]
    assert not aligned.features[:, 0].any()


def test_a_domains_features_may_be_columns_of_their_own(tmp_path: Path) -> None:
    path, names = table(tmp_path), ("action=left", "action=up", "row")
    expected, written = read_table(path, like=names), pd.read_csv(path, dtype=str)
    one_hot = pd.get_dummies(written, columns=["action"], prefix_sep="=", dtype=int)
    one_hot.to_csv(path, index=False)
    found = read_table(path, like=names)
    assert found.feature_names == names
    assert (found.features[found.transition] == expected.features[expected.transition]).all()


WORDS = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs", "Zl", "Zp")))
TEXTS = st.lists(st.tuples(WORDS, WORDS, WORDS), min_size=1, max_size=12)


@settings(max_examples=25)
@given(
    rows=TEXTS,
    separator=st.sampled_from(",;\t|"),
    first=st.sampled_from(["", "sep={}"]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16"]),
    end=st.sampled_from(["\n", "\r\n"]),
)
def test_cells_come_out_as_they_went_in(
    rows: list[tuple[str, ...]],
    separator: str,
    first: str,
    encoding: str,
    end: str,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    path = tmp_path_factory.mktemp("cells") / "table.csv"
    rows += [("", "", "x")]
    table_ = ["one", "two", "three"], *[map(quoted, row) for row in rows], ["", "", ""]
    lines = [first.format(separator)] * bool(first) + [separator.join(row) for row in table_]
    path.write_bytes(end.join(lines).encode(encoding))
    read = read_cells(path, "data").to_numpy().tolist()
    assert read == [[*row] for row in rows if any(row)]


NAMES = ["007", "7", "1.10", "1.1", "1E2", "NA", "null", "true", "a=b", "ü, ö", "x"]


@settings(max_examples=25)
@given(
    items=st.lists(st.sampled_from(NAMES), min_size=6, max_size=6),
    loads=st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=6, max_size=6),
    people=st.lists(st.sampled_from(["01", "1", "NA", "1e3"]), min_size=6, max_size=6),
    told=st.lists(st.sets(st.sampled_from(["m0", "m1", "Fire, run"])), min_size=6, max_size=6),
    ending=st.sampled_from([".csv", ".csv.gz", ".parquet", ".PARQUET"]),
)
def test_a_random_table_is_the_same_after_writing_and_reading(
    items: list[str],
    loads: list[float],
    people: list[str],
    told: list[set[str]],
    ending: str,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    folder = tmp_path_factory.mktemp("tables")
    own: dict[str, Any] = {
        "observer": people,
        "messages": [";".join(sorted(names)) for names in told],
        "item": items,
        "load": loads,
        "label": [0, 1] * 3,
        "row": None,
        "action": None,
    }
    how: dict[str, Any] = {"features": ["item", "load"], "under_way": True}
    how["messages"] = ["m0", "m1", "Fire, run"]
    given_ = {*items} - {"NA", "null"}
    are_numbers = given_ <= {"7", "1.10", "1.1"} and not given_ >= {"1.10", "1.1"}
    if (are_numbers or given_ <= {"true"}) and given_ != {*items}:  # a number is missing
        with pytest.raises(InputError, match=r"missing in .* of item"):
            read_table(table(folder, **own), **how)
        return
    dataset = read_table(table(folder, **own), **how)
    assert [dataset.observers[i] for i in dataset.observer] == people
    write_table(dataset, folder / f"again{ending}")
    again = read_table(folder / f"again{ending}", like=dataset.feature_names, **how)
    assert (again.feature_names, again.observers) == (dataset.feature_names, dataset.observers)
    shown, expected = again.features[again.transition], dataset.features[dataset.transition]
    assert np.array_equal(shown, expected)
    for field in ("observer", "message_set", "label"):
        assert np.array_equal(getattr(again, field), getattr(dataset, field))


@given(st.lists(st.text(st.characters(exclude_categories=("Cc", "Cs"))), min_size=1))
def test_what_to_write_reaches_the_configuration_as_it_is(values: list[str]) -> None:
    assert followed(option("data", "ignore", *values), "") == values


ONE_EACH = "age (the same in all rows of a person)"
NEW_EACH = "Duration (s) (another value in nearly every row)"


@pytest.mark.parametrize(
    ("changes", "asked", "said", "advice", "taken"),
    [
        (
            {"age": [30] * 3 + [40] * 3, "Duration (s)": [7, 9, 2, 4, 5, 8]},
            None,
            ["steps by the features row, action", ONE_EACH, NEW_EACH],
            "to take all: ",
            ("row", "action=left", "action=up", "age", "Duration (s)"),
        ),
        (
            {"age": [1, 2, 3, 3, 1, 2], "load": [4, 4, 5, 4, 5, 5], "label": [0, 1] * 3},
            ["age", "row", "load"],
            ["nearly every answer is about another step"],
            "; try ",
            ("row", "load"),
        ),
        (
            {"row": [1, 1, 1, 2, 2, 2], "action": None},
            None,
            ["the same in all rows of a person"],
            "if it is a feature: ",
            ("row",),
        ),
    ],
)
def test_columns_that_can_hardly_be_features_are_named_and_the_advice_works(
    changes: dict[str, object],
    asked: list[str] | None,
    said: list[str],
    advice: str,
    taken: tuple[str, ...],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A line of the log names them, or an error if there are no others."""
    caplog.set_level("INFO")
    path = table(tmp_path, **changes)
    try:
        read_table(path, features=asked)
        text = caplog.text
    except InputError as error:
        text = str(error)
    assert all(words in text for words in said)
    assert ("nearly every answer" in text) == (said[0].startswith("nearly"))
    assert {*read_table(path, features=followed(text, advice)).feature_names} == {*taken}


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("shuffled", [True, False])
def test_a_number_of_the_row_is_no_feature_however_it_counts(
    told: bool,
    shuffled: bool,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    rng_of_the_day: np.random.Generator,
) -> None:
    """Examples are columns of an experiment's log: trials of each person from 0, and seconds since
    the start. If all people get the same questions without messages, the number of a trial also
    identifies its step."""
    rows: dict[str, list[Any]] = {x: [] for x in ("observer", "messages", "step", "trial", "date")}
    queries = [(h, s) for h in (("", "m0", "m1") if told else ("",)) for s in "abcdef"]
    for observer in "pqrstuvw":
        order = rng_of_the_day.permutation(len(queries)) if shuffled else range(len(queries))
        for trial, i in enumerate(order):
            own = observer, *queries[i], trial, f"2026-11-{1 + trial % 2:02d} 10:{trial:02d}"
            for column, value in zip(rows.values(), own, strict=True):
                column.append(value)
    label = rng_of_the_day.integers(2, size=len(rows["step"])).tolist()
    path = table(tmp_path, row=None, action=None, label=label, **rows)
    dataset = read_table(path)
    if told or shuffled:
        assert dataset.feature_names == tuple(f"step={s}" for s in "abcdef")
        assert "trial (it counts the rows of each person), date" not in caplog.text
        assert "it counts the rows of each person" in caplog.text
        again = read_table(path, features=followed(caplog.text, "to take all: "))
        assert {"trial", "step=a"} < {*again.feature_names}
    assert len(dataset.features) == 6
    assert "date (dates or times)" in caplog.text


def test_numbers_that_name_the_steps_are_features(tmp_path: Path) -> None:
    """The numbers rise from row to row of each person, but each number is one step, asked about
    with different messages."""
    people = ["a", "b", "c"]
    path = table(
        tmp_path,
        observer=[x for x in people for _ in range(4)],
        messages=["", "m0", "", "m0", "m0", "", "m0", "", "", "", "m0", "m0"],
        row=[1, 2, 3, 4] * 3,
        action=["up", "up", "left", "left"] * 3,
        label=[0, 1] * 6,
    )
    assert "row" in read_table(path).feature_names


@pytest.mark.parametrize("column", ["action", "observer"])
@pytest.mark.parametrize("alike", ["P0", "p0\u200b", "\uff500", "p0.0"])
def test_values_that_look_alike_are_named(
    column: str, alike: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    dataset = read_table(table(tmp_path, **{column: ["p0", alike, "p1", "p0", alike, "p1"]}))
    names = dataset.feature_names[1:] if column == "action" else dataset.observers
    assert len(names) == 3
    assert f"in the column {column} look alike; they count as two" in caplog.text


@pytest.mark.parametrize(
    ("told", "said"),
    [
        (["", "m0", "m1", "m0,m1", "", "m0"], "data='m0,m1': looks like messages joined"),
        (
            ["", "go on", "m1", "go on + m1", "", ""],
            "data='go on . m1': looks like messages",
        ),
        (
            ["", "go on/turn left", "turn left/wait here", "", "", ""],
            "data='go on/turn left': looks like messages",
        ),
        *(
            (["", "m0", "m1", f"m0{joint}m1", "", "m0"], "looks like messages joined")
            for joint in (" ", "\n", " and ", ":", "-", "_", "', '")
        ),
        (["", "m0", "m1", "None", "", "m0"], "data='None': leave the cell empty"),
        (["", "m0", "m1", "m0;NA", "", "m0"], "data='NA': leave the cell empty"),
        (["", "m0", "M0", "m1", "", "m0"], "differs from m0 by case alone"),
        *(
            ([no, "m0", "m1", no, "m0", ""], "leave the cell empty")
            for no in ("0", "–", "n/a", ".")
        ),
        (["'m0;m1'", "m0", "m1", "", "", "m0"], "looks like messages joined"),
        (["{m0}", "{m1}", "{m1}", "", "", "{m0}"], "looks like messages joined"),
    ],
)
def test_odd_messages_are_asked_about_and_the_advice_works(
    told: list[str], said: str, tmp_path: Path
) -> None:
    path = table(tmp_path, messages=told)
    with pytest.raises(InputError, match=said) as caught:
        read_table(path)
    advised = followed(str(caught.value), "if it is one message: ")
    written = {name for cell in told for name in cell.split(";")} - {""}
    written = {" ".join(name.split()) for name in written}
    assert set(read_table(path, messages=advised).messages) == written
    assert "\n" not in str(caught.value)


BAD_LINE = "p2,,1,a, comma,1"


@pytest.mark.parametrize(
    ("bad", "advice", "followed"),
    [
        (BAD_LINE, r"holds a comma in double quotes", 'p2,,1,"a, comma",1'),
        ("p2,None,1,up,1", r"leave the cell empty", "p2,,1,up,1"),
        ("p2,,NA,up,1", r"leave those rows out", ""),
        ("p2,,1,hill \xfc,1", r"save it as .CSV UTF-8", "p2,,1,hill \u00fc,1"),
        ("p2,,'1',up,2", r"a label is 0 or 1", "p2,,1,up,1"),
    ],
)
def test_what_an_error_says_to_write_is_read(
    bad: str, advice: str, followed: str, tmp_path: Path
) -> None:
    path = table(tmp_path)
    written = path.read_text()
    path.write_bytes(f"{written}{bad}\n".encode("latin-1"))
    with pytest.raises(InputError, match=advice):
        read_table(path)
    path.write_text(f"{written}{followed}\n", encoding="utf-8")
    assert len(read_table(path)) == 6 + bool(followed)


def test_a_column_that_lacks_values_or_has_decimal_commas_is_mended_as_advised(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = table(tmp_path, load=[1.5, None, 2.5, 1.5, 2.5, 3.5])
    with pytest.raises(InputError, match=r"or the column by 'ignore=\[load\]'"):
        read_table(path)
    assert "load" not in read_table(path, ignore=["load"]).feature_names
    commas = table(tmp_path, load=["1,5", "2,5", "2,5", "1,5", "2,5", "3,5"])
    assert "load=1,5" in read_table(commas).feature_names
    assert "a number is written 1.5, not 1,5" in caplog.text
    assert "load" in read_table(table(tmp_path, load=[1.5, 2.5, 2.5, 1.5, 2.5, 3.5])).feature_names


def test_missing_messages_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    dataset = read_table(table(tmp_path, messages=["NA", "m0", "N/A", "null", "", "m0"]))
    assert dataset.messages == ("m0",)
    assert "4 of 6 rows have no messages" in caplog.text


def test_questions_keep_their_cells(tmp_path: Path) -> None:
    like = read_table(table(tmp_path, observer=["001", "1", "NA"] * 2))
    asked = tmp_path / "asked.csv"
    asked.write_text("observer,row,action,note\n001,1,up,007\nNA,2,left,1.10\n")
    rows, questions = read_questions(asked, like)
    assert rows.to_numpy().tolist() == [["001", "1", "up", "007"], ["NA", "2", "left", "1.10"]]
    assert questions.feature_names == like.feature_names
