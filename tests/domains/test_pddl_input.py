"""Bad input gives one line that says what to correct."""

from pathlib import Path
from typing import Any

import pytest

from tests.domains.configs import believed, given
from tests.refusals import refused
from xplain.domains.pddl.domain import PDDL
from xplain.domains.pddl.task import Source
from xplain.domains.users.setting import Setting, UserType
from xplain.errors import XplainError

pytest.importorskip("fast_downward", reason="pip install 'xplain-hri[pddl]'")


def edited(tmp_path: Path, key: str, old: str, new: str) -> dict[str, Any]:
    """Writes the blocks world with one text replaced in one of its files."""
    own = given("blocks")
    text = Source.read(key, own[key]).text
    assert old in text
    del own["facts"]["top"]  # goals are edited here
    path = tmp_path / f"{key}.pddl"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return own | {key: str(path)}


ACTIONS = "(:action pick-up"
DERIVED = f"(:derived (above ?x ?y - block) (on ?x ?y))\n{ACTIONS}"
COST = "(increase (total-cost) 1)"
PRECONDITION = "(clear ?x) (ontable ?x) (handempty))"


@pytest.mark.parametrize(
    ("key", "old", "new", "text"),
    [
        ("file", PRECONDITION, "(clear ?x (ontable ?x) (handempty))", "file=.* line 21: brackets"),
        (
            "file",
            "(ontable ?x) (handempty))\n",
            "(ontabel ?x) (handempty))\n",
            "17: .*ontabel",
        ),
        ("file", "(?x - block)\n", "(?x - blok)\n", "line 16: unknown type blok"),
        ("file", "(define", "define", "line 4: .*brackets"),
        ("problem", "(handempty)\n", "(handempty\n", "domain.problem=.* line 10: brackets"),
        ("problem", "(ontable d)", "(ontable z)", "line 7: Undefined object: z"),
        ("problem", "(:goal (and (on a b) (on b c) (on d a)))", "", "goal"),
        ("file", PRECONDITION, "(forall (?y - block) (clear ?y)))", "line 17: .* with forall"),
        ("file", PRECONDITION, "(>= (total-cost) 1))", "line 17: .*>="),
        ("file", COST, "(increase (total-cost) -1)", "line 19: Negative numbers .*-1"),
        ("file", COST, f"(when (handempty) {COST})", "does not read the domain's actions"),
        ("file", COST, "(increase (fuel) 1)", "line 19: 'increase' expects .*fuel"),
        ("file", COST, "(decrease (total-cost) 1)", "line 19: Undefined predicate: decrease"),
        ("file", ACTIONS, "(:durative-action pick-up", "line 15: .*:durative-action pick-up"),
        ("file", ACTIONS, DERIVED, "line 15: derived predicates are not supported"),
        ("file", ":action put-down", ":action pick-up", "line 21: two actions are called pick-up"),
        (
            "file",
            "(?x - block)\n",
            "(?x - (either block object))\n",
            "16: .*either block",
        ),
        (
            "problem",
            "a b c d - block",
            "a b c d - (either block object)",
            "line 4: .*either",
        ),
        ("problem", "(on d a)", "(preference top (on d a))", "line 10: .*preference"),
        (
            "problem",
            "(:metric",
            "(:length (:serial 9))\n(:metric",
            "line 11: After the goal .*length",
        ),
        ("problem", "minimize", "maximize", "line 11: Invalid metric definition: .*maximize"),
        ("problem", "(on a b) (on b c) (on d a)", "(on a b) (on b a)", "unsolvable: the robot's"),
        ("problem", "(and (on a b) (on b c) (on d a))", "(clear c)", "does not hold yet"),
    ],
)
def test_a_bad_file_is_one_line(key: str, old: str, new: str, text: str, tmp_path: Path) -> None:
    with refused(text, kind=XplainError):
        PDDL(**edited(tmp_path, key, old, new))


def change(**fields: Any) -> dict[str, Any]:
    return {"facts": {"x": {"change": fields}}}


HANDS = {"action": "pick-up", "drop_precondition": "(handempty)"}


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"file": "nowhere.pddl"}, "domain.file='nowhere.pddl': cannot be read: No such file"),
        ({"file": None}, "the path of a PDDL file"),
        ({"problem": "pkg://nowhere/x.pddl"}, "domain.problem=.*cannot be read"),
        ({"facts": {}}, "at least one fact"),
        ({"facts": 3}, "domain.facts=3: {name: {change"),
        ({"words": 3}, "domain.words=3: {predicate"),
        ({"features": 3}, "domain.features=3: {name: pattern"),
        ({"facts": {"x": {}}}, "lacks change"),
        (
            {"facts": {"x": {"change": HANDS, "why": "so"}}},
            "unknown field; known: change, join, message",
        ),
        ({"facts": {"x": {"change": HANDS, "message": ""}}}, "facts.x.message='': a sentence"),
        ({"facts": {"x": {"change": []}}}, "a change or a list of changes"),
        ({"facts": {"x": {"join": ["y"]}}}, "join='y': unknown difference; known: none"),
        (change(action="pick-up"), "action with one of drop_precondition"),
        (change(action="jump", cost=3), "unknown action; known: pick-up"),
        (change(action="pick-up", cost=-1), "a number (≥|>=) 0"),
        (
            change(action="pick-up", cost="(weight ?x)"),
            "name: weight; known: total",
        ),
        (change(action="pick-up", drop_precondition="(holding ?x)"), r"does not exist; known: \("),
        (change(action="pick-up", add_precondition="(clear ?x)"), "exists already"),
        (change(action="pick-up", add_precondition="(clear ?y)"), "Undefined variable: .y"),
        (
            change(action="pick-up", add_precondition="(clean ?x)"),
            "name: clean; known: on",
        ),
        (change(action="pick-up", add_precondition="(on ?x)"), "'on' of arity 2 used with 1"),
        (change(action="pick-up", add_precondition="clear ?x"), "in brackets"),
        (change(action="pick-up", add_precondition="(clear ?x"), "Missing '\\)'"),
        (
            change(action="pick-up", add_precondition="(not (clear ?x) (on ?x a))"),
            "exactly one",
        ),
        (
            change(action="pick-up", add_effect="(when (clear a))"),
            "'when' .*exactly two",
        ),
        (change(add_initial="(not (clear a))"), "an atom such as"),
        (change(function="(weight a)", value=3), "predicate name: weight"),
        (change(drop_goal="(on c d)"), "does not exist"),
        (change(drop_action="jump"), "unknown action"),
        (
            change(action="pick-up", drop_effect="(holding ?x)"),
            "facts.x=.*unsolvable: somebody who believes x",
        ),
        (change(add_goal="(on b a)"), "facts.x=.*unsolvable: somebody who believes x"),
        ({"believed": 3}, "a domain file, or"),
        ({"words": {"jump": "jumps"}}, "unknown name; known: .*pick-up"),
        ({"words": {"pick-up": "picks up {y}"}}, "y is none of x"),
        ({"words": {"pick-up": ""}}, "a line of text"),
        ({"features": {"n": "(on ?x)"}}, "'on' of arity 2 used with 1"),
        ({"features": {"n": "(off ?x)"}}, "predicate name: off; known: on"),
        ({"features": {"n": []}}, "an atom such as"),
        ({"features": {"n": "(on ?x z)"}}, "Undefined object: z"),
        ({"features": {"clear a": "(clear a)"}}, "names that no atom has"),
        ({"starts": "somewhere"}, "initial, reachable, or a number"),
        ({"starts": -1}, "initial, reachable, or a number"),
        ({"dead_end_cost": 0}, "a number > 0"),
        ({"dead_end_cost": 8}, "unsolvable: the robot's model has no plan .*dead_end_cost=8"),
        ({"max_states": 50}, r"domain.max_states=50: .* reach more states"),
        ({"max_states": 0}, "a whole number"),
    ],
)
def test_a_bad_value_is_one_line(changes: dict[str, Any], text: str) -> None:
    with refused(text, kind=XplainError):
        PDDL(**given("blocks") | changes)


def test_an_action_without_a_cost_does_not_exist(tmp_path: Path) -> None:
    """This is Fast Downward's rule. People who believe that a road has a length believe that it
    exists."""
    own = given("logistics")
    path = tmp_path / "problem.pddl"
    text = Source.read("", own["problem"]).text
    path.write_text(text.replace("(= (length office north) 5)", ""), encoding="utf-8")
    made = PDDL(**own | {"problem": str(path)})
    drive = made.actions.index("drive truck1 office north")
    assert not believed(made).probability[:, drive].any()
    assert believed(made, "new_road").probability[:, drive].any()


def test_a_type_whose_beliefs_leave_no_plan_is_named() -> None:
    """Each of two facts alone leaves a plan below the cost of a dead end, 1000."""
    facts = {
        "dear": {"change": {"action": "unstack", "cost": 300}},
        "far": {"change": {"action": "stack", "cost": 250}},
    }
    made = PDDL(**given("blocks") | {"facts": facts})
    wrong = {p.name: p.inaccurate for p in made.parameters}
    with pytest.raises(XplainError, match=r"type A \(believes dear, far incorrectly\) has no plan"):
        Setting.build(made, (UserType("A", wrong),))
    with pytest.raises(XplainError, match="the change in the configuration, or none"):
        made.model({"dear": [], "far": [{"action": "stack", "cost": 3}]})


def test_without_the_translator_the_error_names_the_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("xplain.domains.pddl.task.lifted", None)
    with pytest.raises(XplainError, match=r"pip install 'xplain-hri\[pddl\]'"):
        PDDL(**given("blocks"))
