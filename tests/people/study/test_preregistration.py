"""The registered document follows from the plan."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.people.study.stand_in import CONFIG, street_plan, street_study
from xplain.cli.main import main
from xplain.people.store import Store
from xplain.people.study.analysis import document

RULES = {"per_cell": 7, "max_attempts": 3, "timeout_minutes": 45, "recall": True, "min_width": 900}
CHECK = {"name": "blue", "label": "Choose blue", "kind": "choice", "choices": ["red", "blue"]}


def test_the_document_says_what_the_plan_does() -> None:
    belief = CONFIG["belief"] | {"accept": 0.8}
    plan = street_plan(rules=RULES, before=[CHECK | {"right": "blue"}], belief=belief)
    text = document(plan)
    for part in (
        plan.hash,
        "7 participants finish in each of 6 cells: 21 in each condition, 42 in total",
        "fail the check after the briefing 3 times",
        "45 minutes",
        "less than 900 pixels",
        "answer “Choose blue” before the briefing with anything except “blue”",
        "Before the briefing: “Choose blue” (choice, `blue`).",
        "After the quiz: “Your age” (number, `age`); “Anything else?” (text, `comment`).",
        "QMDP",
        "Conformant",
        "may say a message again",
        "(`messages_again`, secondary)",
        "Holm",
        *plan.trace,
        *(role.name for role in plan.roles),
    ):
        assert part in text, part
    # Without them nothing of them is promised.
    plain = document(street_plan())
    assert "pixels" not in plain
    assert "with anything except" not in plain
    assert "message again" not in plain
    assert "messages_again" not in plain


def test_the_command_reads_a_study_that_was_started(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study = street_study()
    Store(tmp_path / "s.sqlite", study).close()
    main(["study", "preregister", str(tmp_path / "s.sqlite"), "--out", str(tmp_path / "p.md")])
    assert (tmp_path / "p.md").read_text() == document(study.plan)
    with pytest.raises(SystemExit):
        main(["study", "preregister", str(tmp_path / "none.sqlite")])
    assert "a study that was started" in capsys.readouterr().err
