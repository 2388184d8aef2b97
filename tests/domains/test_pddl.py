"""Compares PDDL tasks with unified-planning's simulator, and tests their words."""

import warnings
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.domains.configs import believed, domain_of, given
from xplain.domains.pddl.domain import PDDL
from xplain.domains.pddl.task import Source

pytestmark = pytest.mark.skipif(
    find_spec("unified_planning") is None, reason="pip install 'xplain-hri[pddl]'"
)


@pytest.mark.parametrize("name", ["blocks", "logistics", "rover", "search_and_rescue"])
def test_the_robots_model_is_what_the_simulator_does(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On random walks the same actions are applicable, and lead to the same atoms."""
    from unified_planning.engines import UPSequentialSimulator
    from unified_planning.environment import get_environment
    from unified_planning.io import PDDLReader

    environment = get_environment()
    monkeypatch.setattr(environment, "error_used_name", False)
    monkeypatch.setattr(environment, "credits_stream", None)
    texts = [Source.read("", given(name)[key]).text for key in ("file", "problem")]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an object may share its name with a type
        problem = PDDLReader().parse_problem_string(*texts)
    made: Any = domain_of(f"domain={name}")
    robot = believed(made)
    rng = np.random.default_rng(0)
    fluents = {
        " ".join([f.name, *(str(o) for o in objects)]).lower(): f(*objects)
        for f in problem.fluents
        if f.type.is_bool_type()
        for objects in product(*(list(problem.objects(p.type)) for p in f.signature))
    }
    states = range(len(made.state_features))
    atoms = {x.strip("()") for s in states for x in made.state(s)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # lengths are given for roads alone
        simulator = UPSequentialSimulator(problem, error_on_failed_checks=False)
    with simulator:
        for _ in range(3):
            real, state = simulator.get_initial_state(), 0
            for _ in range(12):
                holds = {
                    text for text, node in fluents.items()
                    if text in atoms and real.get_value(node).is_true()
                }  # fmt: skip
                assert holds == {atom.strip("()") for atom in made.state(state)}
                assert simulator.is_goal(real) == robot.terminal[state]
                if robot.terminal[state]:
                    break
                possible = {
                    " ".join([a.name, *(str(x) for x in objects)]).lower(): (a, objects)
                    for a, objects in simulator.get_applicable_actions(real)
                }
                own = np.flatnonzero(robot.probability[state, :, 0])
                assert set(possible) == {made.actions[a] for a in own}
                a = int(rng.choice(own))
                real = simulator.apply(real, *possible[made.actions[a]])
                state = int(robot.successor[state, a, 0])


def test_a_pattern_counts_the_ways_in_which_it_holds() -> None:
    arguments = given("blocks") | {
        "features": {"towers": ["(on ?x ?y)", "(ontable ?y)"], "under a": "(on a ?y)"}
    }
    made = PDDL(**arguments)
    names = list(made.feature_names)
    for s in range(len(made.state_features)):
        atoms = [atom.strip("()").split() for atom in made.state(s)]
        on = {(x[1], x[2]) for x in atoms if x[0] == "on"}
        table = {x[1] for x in atoms if x[0] == "ontable"}
        row = made.state_features[s]
        assert row[names.index("towers")] == sum(y in table for _, y in on)
        assert row[names.index("under a")] == sum(x == "a" for x, _ in on)
    assert np.ptp(made.state_features, axis=0).all()  # what is the same in all states tells nothing


def test_starts_are_where_they_are_said_to_be() -> None:
    arguments = given("search_and_rescue")
    assert PDDL(**arguments | {"starts": "initial"}).starts.tolist() == [0]
    made = PDDL(**arguments | {"starts": 2})
    robot = believed(made)
    within = {0}
    for _ in range(2):
        within |= {
            int(robot.successor[s, a, 0])
            for s in within
            for a in np.flatnonzero(robot.probability[s, :, 0])
        }
    alive = {s for s in within if np.isfinite(robot.to_go[s]) and not robot.terminal[s]}
    assert set(made.starts.tolist()) == alive
    assert len(PDDL(**arguments | {"starts": "reachable"}).starts) > len(alive)


def test_who_believes_in_another_start_holds_on_to_it_until_the_robot_touches_it() -> None:
    """Fetching the medkit from the store makes no sense to people who believe that it is in the
    office; later steps make sense."""
    made: Any = domain_of("domain=search_and_rescue")
    robot, wrong = believed(made), believed(made, "medkit")
    before = []
    for transition in robot.on_policy(made.starts):
        state = int(transition[0])
        own = set(made.state(state))
        elsewhere = own - {"(medkit store)"} | {"(medkit office)"}
        seen = set(made.state(int(wrong.imagined[state])))
        assert seen == (elsewhere if "(medkit store)" in own else own)
        if "(medkit store)" not in own:
            assert wrong.labels(transition[None])[0], made.describe(transition)
        else:
            before.append(bool(wrong.labels(transition[None])[0]))
    assert not all(before)


def test_phrases_come_from_names_and_templates(tmp_path: Path) -> None:
    arguments = given("blocks")
    plain = PDDL(**{k: v for k, v in arguments.items() if k != "words"})
    robot = believed(plain)
    a = plain.actions.index("unstack c b")
    transition = np.array([0, a, int(robot.successor[0, a, 0])])
    assert plain.describe(transition) == "unstack block c block b"
    told = {"now clear b", "now holding c", "no longer clear c", "no longer handempty"}
    assert set(plain.changes(transition)) == told | {"no longer c on b"}
    assert domain_of("domain=blocks").describe(transition) == "takes c off b"
    told = {p.name: (p.message, p.belief) for p in plain.parameters}
    assert told["top"] == ("The goal needs: d on a.", "The goal does not need: d on a.")


@pytest.mark.parametrize("facts", [2, 8])
def test_any_number_of_goals_may_be_held_wrong(facts: int, tmp_path: Path) -> None:
    """The goal needs one lamp, and people may believe that it needs others: a plan turns on the
    believed lamps and no others."""
    (tmp_path / "d.pddl").write_text(
        """(define (domain lamps)
          (:requirements :strips :typing :negative-preconditions)
          (:types lamp)
          (:predicates (on ?x - lamp))
          (:action turn :parameters (?x - lamp) :precondition (not (on ?x)) :effect (on ?x)))"""
    )
    lamps = " ".join(f"l{i}" for i in range(facts + 1))
    (tmp_path / "p.pddl").write_text(
        f"(define (problem p) (:domain lamps) (:objects {lamps} - lamp) (:init) (:goal (on l0)))"
    )
    wrong = {f"f{i}": {"change": {"add_goal": f"(on l{i})"}} for i in range(1, facts + 1)}
    made = PDDL(str(tmp_path / "d.pddl"), str(tmp_path / "p.pddl"), facts=wrong)
    first = {name: a for a, name in enumerate(made.actions)}
    for held in ([], [1], [facts], [1, facts], range(1, facts + 1)):
        model = believed(made, *(f"f{i}" for i in held))
        assert model.to_go[0] == 1 + len(held)
        for i in range(facts + 1):
            after = int(model.successor[0, first[f"turn l{i}"], 0])
            step = np.array([[0, first[f"turn l{i}"], after]])
            assert model.labels(step)[0] == (i == 0 or i in held)
