"""Tests differences of two tasks, the sentences of facts, changes in YAML, and facts without
effect."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.domains.configs import believed, given
from xplain.domains.pddl.domain import PDDL
from xplain.domains.pddl.facts import Words, describe, find_differences, read_changes
from xplain.domains.pddl.task import Source, apply_changes, read_task, texts
from xplain.errors import InputError

pytest.importorskip("fast_downward", reason="pip install 'xplain-hri[pddl]'")

KEYS = ("domain.file", "domain.problem")
Edit = tuple[str, str]


def pair(tmp_path: Path, name: str, domain: list[Edit], problem: list[Edit]) -> tuple[Any, Any]:
    """Reads the task of this name, and the task of the same files with texts replaced."""
    own = given(name)
    paths = []
    for key, edits in (("file", domain), ("problem", problem)):
        text = Source.read(key, own[key]).text
        for old, new in edits:
            assert text.count(old) == 1, f"{old} occurs {text.count(old)} times"
            text = text.replace(old, new)
        paths.append(tmp_path / f"{key}.pddl")
        paths[-1].write_text(text, encoding="utf-8")
    robot = read_task(own["file"], own["problem"], KEYS)
    return robot, read_task(str(paths[0]), str(paths[1]), KEYS)


PAIRS: list[tuple[str, list[Edit], list[Edit], dict[str, Any]]] = [
    ("blocks", [], [], {}),
    (
        "blocks",
        [("(clear ?x) (ontable ?x) (handempty))", "(ontable ?x) (clear ?x))")],
        [],
        {"pick_up_needs_handempty": {"action": "pick-up", "drop_precondition": "(handempty)"}},
    ),
    (
        "blocks",
        [("(ontable ?x) (clear ?x) (handempty) (not (holding ?x))", "(ontable ?x) (handempty)")],
        [],
        {
            "put_down_makes_clear_x": {"action": "put-down", "drop_effect": "(clear ?x)"},
            "put_down_makes_not_holding_x": {
                "action": "put-down",
                "drop_effect": "(not (holding ?x))",
            },
        },
    ),
    (
        "blocks",
        [],
        [("(on c b) (clear c)", "(ontable c) (clear b) (clear c)"), (" (on d a)", "")],
        {
            "goal_on_d_a": {"drop_goal": "(on d a)"},
            "start_on_c_b": {"drop_initial": "(on c b)"},
            "start_ontable_c": {"add_initial": "(ontable c)"},
            "start_clear_b": {"add_initial": "(clear b)"},
        },
    ),
    (
        "logistics",
        [],
        [("(length office market) 2", "(length office market) 7")],
        {"value_length_office_market": {"function": "(length office market)", "value": 7.0}},
    ),
    (
        "logistics",
        [
            (
                "(increase (total-cost) (length ?from ?to))))\n\n  (:action fly",
                "(increase (total-cost) 3)))\n\n  (:action fly",
            )
        ],
        [],
        {"drive_cost": {"action": "drive", "cost": 3.0}},
    ),
    (
        "rover",
        [
            (
                "(when (have-picture) (sent-picture))",
                "(when (and (charged) (have-picture)) (sent-picture))",
            )
        ],
        [],
        {
            "send_makes_have_picture_sent_picture": {
                "action": "send",
                "drop_effect": "(when (have-picture) (sent-picture))",
            },
            "send_makes_and_charged_have_picture_sent_picture": {
                "action": "send",
                "add_effect": "(when (and (charged) (have-picture)) (sent-picture))",
            },
        },
    ),
    (
        "rover",
        [
            (
                "\n  (:action clean\n    :parameters ()\n    :precondition (and (dusty))\n"
                "    :effect (and (not (dusty)) (increase (total-cost) 1)))\n",
                "\n  (:action wipe\n    :parameters (?w - waypoint)\n"
                "    :precondition (and (at ?w))\n"
                "    :effect (and (not (dusty)) (increase (total-cost) 1)))\n",
            )
        ],
        [],
        {"can_clean": {"drop_action": "clean"}, "can_wipe": {"add_action": "wipe"}},
    ),
    (
        "search_and_rescue",
        [
            ("(rubble ?from ?to) (not (carrying)))", "(rubble ?from ?to))"),
            ("(victim ?r) (treated))", "(victim ?r) (treated) (not (smoke ?r)))"),
        ],
        [("(medkit store)", "(medkit office)"), ("(safe))))", "(safe))))")][:1],
        {
            "climb_over_needs_not_carrying": {
                "action": "climb-over",
                "drop_precondition": "(not (carrying))",
            },
            "lift_needs_not_smoke_r": {"action": "lift", "add_precondition": "(not (smoke ?r))"},
            "start_medkit_office": {"add_initial": "(medkit office)"},
            "start_medkit_store": {"drop_initial": "(medkit store)"},
        },
    ),
]


@pytest.mark.parametrize(("name", "domain", "problem", "expected"), PAIRS)
def test_two_tasks_differ_in_what_was_edited_no_more_and_no_less(
    name: str, domain: list[Edit], problem: list[Edit], expected: dict[str, Any], tmp_path: Path
) -> None:
    robot, believed = pair(tmp_path, name, domain, problem)
    found = find_differences(robot, believed, "domain.believed")
    written = {name: read_changes("", one, robot, believed.items) for name, one in expected.items()}
    assert found == written
    # They lead from one task to the other, and back.
    back = find_differences(believed, robot, "domain.believed")
    made = replace(robot, items=apply_changes(robot.items, *found.values()))
    again = replace(believed, items=apply_changes(believed.items, *back.values()))
    assert not find_differences(made, believed, "")
    assert not find_differences(again, robot, "")


def test_an_action_with_other_parameters_is_refused(tmp_path: Path) -> None:
    edit = ":parameters (?x - block ?y - block)\n    :precondition (and (holding ?x)"
    robot, believed = pair(
        tmp_path, "blocks", [(edit, edit.replace("block)", "block ?z - block)"))], []
    )
    with pytest.raises(InputError, match=r"believed\.stack=.*robot's parameters: \?x - block \?y"):
        find_differences(robot, believed, "domain.believed")


def test_believed_files_make_a_domain_with_their_differences_as_facts(tmp_path: Path) -> None:
    """People who believe all of them incorrectly give the same labels as people with the believed
    task."""
    pair(
        tmp_path,
        "search_and_rescue",
        [("(victim ?r) (treated))", "(victim ?r))")],
        [("(medkit store)", "(medkit office)")],
    )
    paths = {key: str(tmp_path / f"{key}.pddl") for key in ("file", "problem")}
    own = given("search_and_rescue")
    facts: dict[str, Any] = {"lift_needs_treated": {"message": "First treat, then lift."}}
    with pytest.raises(ValueError, match=r"start_medkit_store=.*unsolvable: somebody who believes"):
        PDDL(**own | {"believed": paths, "facts": facts})
    facts["medkit"] = {"join": ["start_medkit_office", "start_medkit_store"]}
    made = PDDL(**own | {"believed": paths, "facts": facts})
    assert [(p.name, p.message) for p in made.parameters] == [
        ("lift_needs_treated", "First treat, then lift."),
        ("medkit", "At the start: not a medkit in office. At the start: a medkit in store."),
    ]
    assert made.parameters[0].belief == "The action lift does not need: the victim treated."
    wrong = believed(made, "lift_needs_treated", "medkit")
    other = {"top": {"change": {"action": "treat", "cost": 2}}}
    theirs = PDDL(**own | paths | {"facts": other})
    task = believed(theirs)
    assert wrong.to_go[wrong.imagined[0]] == task.to_go[0]
    number = {theirs.state(s): s for s in range(len(theirs.state_features))}
    action = {name: a for a, name in enumerate(theirs.actions)}
    robot = believed(made)
    seen = 0
    for s, a, after in robot.on_policy(made.starts).tolist():
        before, then = (made.state(int(wrong.imagined[x])) for x in (s, after))
        if before in number and then in number and made.actions[a] in action:
            same = np.array([[number[before], action[made.actions[a]], number[then]]])
            mine = wrong.labels(np.array([[s, a, after]]))
            assert mine.tolist() == task.labels(same).tolist(), made.actions[a]
            seen += 1
    assert seen > 20


def test_a_fact_without_effect_is_named(caplog: pytest.LogCaptureFixture) -> None:
    """Nobody ever drives from the crater to the ridge, so a fact about this way has no effect."""
    own = given("rover")
    silent = {"change": {"action": "photograph", "drop_precondition": "(view ?w)"}}
    facts = {
        "battery": own["facts"]["battery"],
        "silent": {"change": {"action": "charge", "cost": 900}},
    }
    PDDL(**own | {"facts": {"battery": own["facts"]["battery"], "view": silent}})
    assert not caplog.messages
    PDDL(**own | {"facts": facts, "starts": "initial"})
    (message,) = caplog.messages
    assert message.startswith("domain.facts.silent has no effect")


def test_a_fact_that_matters_only_with_another_is_not_said_to_have_no_effect(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Two roads are too long: a wrong length of one has no effect unless people believe that the
    other is short."""
    own = given("logistics")
    long = {"function": "(length office north)"}
    facts = {
        "longer": {"change": [long | {"value": 30}]},
        "jam": own["facts"]["jam"],
        "letter": own["facts"]["letter"],
    }
    made = PDDL(**own | {"facts": facts})
    transitions = believed(made).on_policy(made.starts)
    assert believed(made, "longer").labels(transitions).all()
    jam = believed(made, "jam").labels(transitions)
    assert not np.array_equal(jam, believed(made, "longer", "jam").labels(transitions))
    assert not caplog.messages


CHANGES: list[tuple[str, Any, Callable[[Any, Any], bool], str]] = [
    (
        "blocks",
        {"action": "Pick-Up", "add_precondition": "(not (on ?x a))"},
        lambda a, b: len([*texts(b, "precondition", "pick-up")]) == 4,
        "The action pick up does not need: not the block on a.",
    ),
    (
        "blocks",
        {"action": "stack", "add_effect": "(when (clear a) (not (ontable ?y)))"},
        lambda a, b: len([*texts(b, "effect", "stack")]) == 6,
        "The action stack does not lead to: not block y on the table (if nothing on a).",
    ),
    (
        "logistics",
        {"action": "load", "cost": "(length ?l north)"},
        lambda a, b: b["cost", "load", ""] == "(length ?l north)",
        "The action load costs 1.",
    ),
    (
        "blocks",
        {"add_goal": "(not (holding a))"},
        lambda a, b: len([*texts(b, "goal")]) == len([*texts(a, "goal")]) + 1,
        "The goal does not need: not holding a.",
    ),
    (
        "rover",
        {"drop_action": "clean"},
        lambda a, b: ("action", "clean", "") in {*a} - {*b},
        "The robot can clean.",
    ),
]


@pytest.mark.parametrize(("name", "change", "holds", "message"), CHANGES)
def test_changes_do_and_say_what_they_say(name: str, change: Any, holds: Any, message: str) -> None:
    own = given(name)
    task = read_task(own["file"], own["problem"], KEYS)
    made = read_changes("", change, task, {})
    assert holds(task.items, apply_changes(task.items, made))
    assert describe(task, made, Words(task, own["words"]))[0] == message
