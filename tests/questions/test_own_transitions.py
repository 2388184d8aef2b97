"""A designer's table of transitions: facts, features, pictures, and errors."""

from pathlib import Path

import pytest

from tests.refusals import refused
from xplain.questions.own_transitions import read_transitions, with_features

TABLE = """text,image,inexplicable_if,load,zone
Drives over the cable, cable.jpg ,cable,2.5,river
Takes the lift,,lift; queue ,0,hill
 Waits at the door ,door.jpg,,1e1,river
"""


def written(tmp_path: Path, text: str, encoding: str = "utf-8") -> Path:
    path = tmp_path / "own.csv"
    path.write_text(text, encoding=encoding)
    return path


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])  # spreadsheets mark their files
def test_every_column_is_read_as_it_is_meant(tmp_path: Path, encoding: str) -> None:
    own = read_transitions(written(tmp_path, TABLE, encoding))
    assert (own.texts, own.images, own.facts, own.feature_names) == (
        ("Drives over the cable", "Takes the lift", "Waits at the door"),
        ("cable.jpg", "", "door.jpg"),
        (("cable",), ("lift", "queue"), ()),
        ("load", "zone=hill", "zone=river"),
    )
    assert own.features.tolist() == [[2.5, 0, 1], [0, 1, 0], [10, 0, 1]]


def test_a_transition_puzzles_whoever_holds_one_of_its_facts_wrong(tmp_path: Path) -> None:
    known = read_transitions(written(tmp_path, TABLE)).hypotheses
    assert known.messages == ("cable", "lift", "queue")
    own = [{"cable"}, {"lift", "queue"}, set()]
    for held, row in enumerate(known.labels.tolist()):
        wrong = {name for j, name in enumerate(known.messages) if held >> j & 1}
        assert row == [int(not wrong & facts) for facts in own]


def test_without_features_the_text_is_one(tmp_path: Path) -> None:
    """Transitions with equal texts are one transition for a labeler."""
    own = read_transitions(written(tmp_path, "text,inexplicable_if\nb,x\na,y\nb,x\n"))
    known = with_features(own.hypotheses)
    assert known.feature_names == ("text=a", "text=b")
    assert known.features.tolist() == [[0, 1], [1, 0], [0, 1]]
    assert with_features(known) is known


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("image\na.jpg\n", "lacks the column text"),
        ("text,load\na,1\n ,2\n", "a text in every row; missing in row 2"),
        ("text,load\na,1\nb,\n", "missing in 1 rows of load, first in row 2"),
        ("text,load\na,1\nb\n", "line 3 has 1 cells, the header has 2"),
        ("text,load\na,1\nb,inf\n", "infinite in 1 rows of load, first in row 2"),
        ("text,load\n", "has no rows"),
        ('text,inexplicable_if\na,x\nb,y\nc,"x,y"\n', "='x,y': .* joined .*, give it another name"),
        ("text,inexplicable_if\na,x\nb,X\n", "differs from x by case alone"),
        ("text,inexplicable_if\na,x\nb,none\n", "leave the cell empty"),
        ("", "it is empty"),
    ],
)
def test_bad_tables_are_one_line(tmp_path: Path, text: str, said: str) -> None:
    with refused(said):
        read_transitions(written(tmp_path, text))
