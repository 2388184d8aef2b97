"""The command that says what to ask."""

import csv
import json

import numpy as np
import pytest

from xplain import Hypotheses, LearnedTypes
from xplain.cli.questions import main as questions
from xplain.errors import InputError
from xplain.questions.committee import next_screen_of

TABLE = """text,image,inexplicable_if
Drives over the cable,cable.jpg,cable
Takes the lift,,lift;queue
Waits at the door,door.jpg,queue
"""


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_domains_list_is_written_in_words(command, tmp_path):
    done = command("xplain questions", "domain=rescue", "save=h.npz", "queries.redundancy=1")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])
    rows = rows_of(tmp_path / "questions.csv")
    assert said["questions"] == len(rows) <= 10
    assert said["candidates"] == 64
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
    # The lift alone is not to be told from the queue unless the queue is told before.
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
        ("text,inexplicable_if\n,cable\n", "row 2"),
        ("text,inexplicable_if\n", "no rows"),
        ("text,inexplicable_if\nhello,\n", "a fact in some row"),
    ],
)
def test_bad_tables_are_one_line(tmp_path, text, said):
    (tmp_path / "own.csv").write_text(text)
    with pytest.raises(InputError, match=said) as caught:
        questions([f"transitions={tmp_path}/own.csv", f"output={tmp_path}/q.csv"])
    assert "\n" not in str(caught.value)


def test_questions_that_depend_on_answers_make_no_list(tmp_path):
    with pytest.raises(InputError, match="Questionnaire"):
        questions(["queries=adaptive", f"output={tmp_path}/q.csv"])


def test_answers_to_chosen_questions_find_types_that_a_file_keeps(tmp_path, command):
    """observe → discover with hypotheses → types.npz, which loads without the hypotheses."""
    made = command("xplain questions", "domain=rescue", "save=h.npz")
    assert made.returncode == 0, made.stderr
    asked = ("points=20", "queries=adaptive", "observers.label_noise=0.05", "output=labels.csv")
    assert command("xplain observe", "domain=rescue", *asked).returncode == 0
    done = command(
        "xplain discover",
        "data=labels.csv",
        "labeler=hypotheses",
        "hypotheses=h.npz",
        "held_out=false",
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])
    assert said["rule"] == "hypotheses"
    assert said["n_types"] == 5
    types = LearnedTypes.load(tmp_path / "outputs/discover/types.npz")
    known = Hypotheses.load(tmp_path / "h.npz").told_apart_by_features()
    table = types.label_table(known.features).array(known.n_messages)
    held = [["fire", "rubble"], ["first_aid", "fence"]]  # of the shipped types, two
    for facts in held:
        mask = sum(1 << known.messages.index(name) for name in facts)
        truth = known.labels[known.row(mask & ~np.arange(64))].T
        assert ((table > 0.5) == truth).mean(axis=(1, 2)).max() > 0.98


STEPS = "text\n" + "".join(f"step {t}\n" for t in range(6))
WITHOUT = ("queries=adaptive", "queries.hypotheses=none", "messages=[m0,m1]")


def next_form(tmp_path, *changes):
    """The next screen for bob, as it is written."""
    (tmp_path / "own.csv").write_text(STEPS)
    table, output = f"transitions={tmp_path}/own.csv", f"output={tmp_path}/form.csv"
    said = questions([table, output, "observer=bob", *WITHOUT, *changes])
    return said, rows_of(tmp_path / "form.csv")


def answers_file(tmp_path, rows):
    lines = [f"{who},{told},step {t},{label}" for who, t, told, label in rows]
    path = tmp_path / "answers.csv"
    path.write_text("\n".join(["observer,messages,text,label", *lines]) + "\n")
    return f"data={path}"


def test_without_hypotheses_the_answers_so_far_say_what_to_ask(tmp_path):
    """Steps 0 to 4 were explicable whatever was told, step 5 not when nothing was."""
    told = ("", "m0", "m1", "m0;m1")
    rows = [(who, t, m, 1) for who in ("ann", "bob") for t in range(5) for m in told] * 3
    rows += [(who, 5, "", 0) for who in ("ann", "bob")] * 3
    data, firsts = answers_file(tmp_path, rows), []
    for seed in range(20):
        said, form = next_form(tmp_path, data, "queries.screen=1", f"seed={seed}")
        assert said["answers"] == len(rows)
        firsts += [(row["text"], row["messages"]) for row in form]
    odd = [messages for text, messages in firsts if text == "step 5"]
    assert len(odd) > 14
    assert sum(messages != "" for messages in odd) > 0.7 * len(odd)


def test_a_screen_is_a_form_whose_answers_go_back(tmp_path):
    said, form = next_form(tmp_path, "queries.screen=4")
    assert (said["questions"], said["answers"]) == (4, 0)
    assert len({row["text"] for row in form}) == 4
    rows = [(who, int(r["text"][-1]), r["messages"], 1) for who in ("ann", "bob") for r in form]
    said, again = next_form(tmp_path, answers_file(tmp_path, rows), "observer=new")
    assert said["answers"] == 8
    assert {row["observer"] for row in again} == {"new"}
    assert {row["label"] for row in again} == {""}
    assert len(again) == 6  # a screen asks about each transition once


def test_every_screen_draws_from_a_stream_of_its_own(tmp_path, monkeypatch):
    """Seeds, observers, and the screens of one observer; asked again, the same."""
    drawn = {}

    def noted(pool, answers, observer, count, rng):
        drawn.setdefault(case, set()).add(rng.bit_generator.state["state"]["state"])
        return next_screen_of(pool, answers, observer, count, rng)

    monkeypatch.setattr("xplain.cli.questions.next_screen_of", noted)
    cases = [("bob", 0, 0), ("bob", 1, 0), ("bob", 4, 0), ("ann", 1, 0), ("bob", 1, 1)]
    for case in [*cases, cases[1]]:
        who, answers, seed = case
        rows = [("bob", t, "m0", 1) for t in range(answers)]
        data = (answers_file(tmp_path, rows),) if rows else ()
        next_form(tmp_path, *data, f"observer={who}", f"seed={seed}")
    assert [len(own) for own in drawn.values()] == [1] * len(cases)
    assert len(set().union(*drawn.values())) == len(cases)


def test_a_domains_screen_is_a_table_that_discover_reads(tmp_path):
    form = tmp_path / "form.csv"
    asked = ("domain=rescue", "queries=adaptive", "queries.hypotheses=none", f"output={form}")
    questions([*asked, "observer=ann"])
    filled = [{**row, "label": int(row["told"] == "")} for row in rows_of(form)]
    filled += [{**row, "observer": "bob"} for row in filled]
    answers = tmp_path / "answers.csv"
    with answers.open("w", newline="") as file:
        writer = csv.DictWriter(file, filled[0])
        writer.writeheader()
        writer.writerows(filled)
    assert questions([*asked, "observer=cleo", f"data={answers}"])["answers"] == len(filled)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (("observer=null",), "observer=None"),
        (("messages=null",), "names of what people can be told"),
        (("save=h.npz",), "save="),
        (("ROWS", ("bob", 7, "m0", 1)), "step 7"),
        (("ROWS", ("bob", 1, "m7", 1)), "m7"),
        (("ROWS", ("bob", 1, "m0", 2)), "label"),
    ],
)
def test_what_no_screen_can_be_made_from_is_one_line(tmp_path, changes, said):
    if changes[0] == "ROWS":
        changes = (answers_file(tmp_path, [changes[1]]),)
    with pytest.raises(InputError, match=said) as caught:
        next_form(tmp_path, *changes)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "form.csv").exists()
