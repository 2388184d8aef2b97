"""The command that lists questions."""

import csv
import json
import re

import numpy as np
import pytest

from tests.refusals import refused
from xplain import Hypotheses
from xplain.experiment.config import compose_config
from xplain.runs.labels import write_questions


def questions(words):
    """Writes the list of questions; returns the printed summary."""
    return write_questions(compose_config("questions", words, with_hydra=True))[1]


TABLE = """text,image,inexplicable_if
Drives over the cable,cable.jpg,cable
Takes the lift,,lift;queue
Waits at the door,door.jpg,queue
"""


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_domains_list_is_written_in_words(run, tmp_path):
    code, out, err = run("questions", "domain=rescue", "save=h.npz", "queries.redundancy=1")
    assert code == 0, err
    said = json.loads(out.splitlines()[-1])
    rows = rows_of(tmp_path / "questions.csv")
    assert said["questions"] == len(rows) <= 10
    shown = re.findall(r"^│ +(\d+) +│ ", out, re.MULTILINE)
    assert (said["candidates"], shown) == (64, [row["question"] for row in rows])
    known = Hypotheses.load(tmp_path / "h.npz")
    for row in rows:
        assert row["text"] == known.phrases[int(row["transition"])]
        for name in filter(None, row["messages"].split(";")):
            assert name in known.messages
        assert bool(row["told"]) == bool(row["messages"])


def test_a_table_of_ones_own_transitions_is_enough(tmp_path):
    (tmp_path / "own.csv").write_text(TABLE)
    output = tmp_path / "q.csv"
    said = questions(
        [f"transitions={tmp_path}/own.csv", f"output={output}", "queries.redundancy=1"]
    )
    assert said["candidates"] == 8
    rows = rows_of(output)
    assert {row["text"] for row in rows} == {line.split(",")[0] for line in TABLE.split("\n")[1:4]}
    assert {row["image"] for row in rows} == {"cable.jpg", "", "door.jpg"}
    # Only after the message about the queue can the lift be distinguished from the queue.
    (lift,) = [row for row in rows if row["text"] == "Takes the lift"]
    assert lift["messages"] == "queue"


def test_a_file_of_hypotheses_takes_the_domains_place(tmp_path):
    np.savez(tmp_path / "h.npz", labels=[[1, 1], [0, 1], [1, 0], [0, 0]])
    output = tmp_path / "a" / "folder" / "q.csv"  # made where it is missing
    said = questions([f"hypotheses={tmp_path}/h.npz", f"output={output}"])
    assert (said["transitions"], said["candidates"]) == (2, 4)
    assert [row["text"][:-1] for row in rows_of(output)] == ["transition "] * 4


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("text\nhello\n", "inexplicable_if"),
        ("text,inexplicable_if\n,cable\n", "missing in row 1"),
        ("text,inexplicable_if\n", "no rows"),
        ("text,inexplicable_if\nhello,\n", "a fact in some row"),
    ],
)
def test_bad_tables_are_one_line(tmp_path, text, said):
    (tmp_path / "own.csv").write_text(text)
    with refused(said):
        questions([f"transitions={tmp_path}/own.csv", f"output={tmp_path}/q.csv"])


def test_questions_that_depend_on_answers_make_no_list(tmp_path):
    with refused("Questionnaire"):
        questions(["queries=adaptive", f"output={tmp_path}/q.csv"])
