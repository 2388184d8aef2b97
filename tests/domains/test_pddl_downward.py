"""Compares costs of best plans with Fast Downward: of random tasks in PDDL, in all styles that
people use, and of the shipped tasks, also with files that say the same in another way."""

import re
import subprocess
import sys
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.domains.configs import believed, domain_of, given
from tests.domains.test_pddl_input import COST, PRECONDITION, edited
from xplain.domains.pddl.domain import PDDL
from xplain.domains.pddl.task import Source
from xplain.errors import XplainError

pytestmark = pytest.mark.skipif(
    find_spec("up_fast_downward") is None, reason="pip install 'xplain-hri[pddl]'"
)

TYPES = {"thing": "object", "box": "thing", "lid": "thing", "place": "object"}
PREDICATES = {
    "full": ["box"],
    "on": ["lid", "box"],
    "at": ["thing", "place"],
    "seen": ["object"],
    "done": [],
    "near": ["place", "place"],  # no action changes it
}
OBJECTS = {"a": "box", "b": "box", "l": "lid", "p": "place", "q": "place", "any": "object"}


class Writer:
    """Writes one random task."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.metric = self.rng.random() < 0.7

    def chance(self, p: float = 0.5) -> bool:
        return bool(self.rng.random() < p)

    def pick(self, items: list[str]) -> str:
        return items[int(self.rng.integers(len(items)))]

    def is_a(self, kind: str, wanted: str) -> bool:
        return kind == wanted or (kind in TYPES and self.is_a(TYPES[kind], wanted))

    def atom(self, terms: dict[str, str], static: bool = True) -> str:
        """Draws an atom over some terms, {name: type}."""
        for _ in range(50):
            name = self.pick([x for x in PREDICATES if static or x != "near"])
            fit = [[t for t, k in terms.items() if self.is_a(k, w)] for w in PREDICATES[name]]
            if all(fit):
                return f"({' '.join([name, *map(self.pick, fit)])})"
        return "(done)"

    def literal(self, terms: dict[str, str], static: bool = True) -> str:
        atom = self.atom(terms, static)
        return atom if self.chance(0.6) else f"(not {atom})"

    def condition(self, terms: dict[str, str]) -> str:
        kind = self.rng.random()
        if kind < 0.2:
            return f"({self.pick(['or', 'imply'])} {self.literal(terms)} {self.literal(terms)})"
        if kind < 0.3:
            wanted = self.pick(["box", "place", "object"])
            return f"(exists (?e - {wanted}) {self.literal(terms | {'?e': wanted})})"
        return self.literal(terms)

    def effect(self, terms: dict[str, str]) -> str:
        text = self.literal(terms, static=False)
        if self.chance(0.3):
            more = terms | {"?z": self.pick(["box", "place", "object"])}
            text = f"(forall (?z - {more['?z']}) {self.conditional(more, 0.8)})"
        return text if "forall" in text else self.conditional(terms, 0.3)

    def conditional(self, terms: dict[str, str], p: float) -> str:
        text = self.literal(terms, static=False)
        return f"(when {self.condition(terms)} {text})" if self.chance(p) else text

    def action(self, name: str) -> str:
        kinds = [
            self.pick(["box", "lid", "place", "thing", "object"])
            for _ in range(self.rng.integers(1, 3))
        ]
        own = {f"?{x}": kind for x, kind in zip("xy", kinds, strict=False)}
        terms = own | ({"p": "place"} if self.chance(0.3) else {})
        asked = [self.condition(terms) for _ in range(self.rng.integers(2))]
        effects = [self.effect(terms) for _ in range(self.rng.integers(2, 5))]
        if self.chance():  # an atom that is added and deleted at once stays
            both = self.atom(terms, static=False)
            effects += [f"(when {self.literal(terms)} (not {both}))", both]
        places = [term for term, kind in terms.items() if kind == "place"]
        cost = (
            f"(far {places[0]})" if places and self.chance() else str(self.rng.choice([0, 1, 2, 5]))
        )
        if self.chance(0.8):
            effects.append(f"(increase (total-cost) {cost})")
        typed = " ".join(f"{x} - {kind}" if kind != "object" else x for x, kind in own.items())
        if "object" in own.values():  # what has no type stands last
            typed = " ".join(f"{x} - {kind}" for x, kind in own.items())
        if self.chance(0.2):
            asked.append("(= ?x ?y)" if len(own) == 2 and self.chance() else "(and)")
        asks = f":precondition (and {' '.join(asked)})" if self.chance(0.9) else ""
        return f"(:action {name} :parameters ({typed}) {asks} :effect (and {' '.join(effects)}))"

    def task(self) -> tuple[str, str]:
        """Writes a domain and a problem."""
        types = " ".join(f"{x} - {y}" for x, y in TYPES.items())
        one = " ".join(
            f"({name}{' ' * self.chance()}{self.parameters(own)})"
            for name, own in PREDICATES.items()
        )
        tags = self.pick([":strips :typing", ":adl :fluents", ":strips :derived-predicates"])
        actions = "\n ".join(self.action(f"do-{i}") for i in range(self.rng.integers(5, 9)))
        domain = (
            f"; a comment\n(define (domain d) (:requirements {tags})\n (:types {types})\n"
            f" (:constants p - place)\n (:predicates {one})\n"
            f" (:functions (total-cost) - number (far ?p - place) - number)\n {actions})"
        )
        everything = [
            f"({' '.join([name, *chosen])})"
            for name, own in PREDICATES.items()
            for chosen in product(
                *([x for x, k in OBJECTS.items() if self.is_a(k, w)] for w in own)
            )
        ]
        initial = [atom for atom in everything if self.chance(0.3)]
        values = " ".join(f"(= (far {x}) {self.rng.integers(0, 5)})" for x in ("p", "q"))
        total = "(= (total-cost) 0)" if self.chance() else ""
        atoms = {self.atom(OBJECTS, static=False) for _ in range(self.rng.integers(1, 4))}
        goal = [f"(not {atom})" if atom in initial else atom for atom in sorted(atoms)]
        metric = "(:metric minimize (total-cost))" if self.metric else ""
        objects = "a b - box l - lid q - place any"
        problem = (
            f"(define (problem x) (:domain d) (:objects {objects})\n"
            f" (:init {' '.join(initial)} {values} {total})\n"
            f" (:goal (and {' '.join(goal)})) {metric})"
        )
        mark = "\ufeff" if self.chance(0.2) else ""
        return (mark + domain.upper() if self.chance(0.2) else mark + domain), problem

    def parameters(self, kinds: list[str]) -> str:
        """Writes parameters; without a metric their names repeat."""
        numbers = [str(i) if self.metric else "" for i in range(len(kinds))]
        return " ".join(f"?x{i} - {kind}" for i, kind in zip(numbers, kinds, strict=True))


def plan_cost_here(file: str, problem: str) -> float | None:
    """Computes the cost of the robot's best plan with this package."""
    fact = {"x": {"change": {"action": "do-0", "cost": 50}}}
    try:
        return float(PDDL(file, problem, facts=fact).model({"x": []}).to_go[0])
    except XplainError as error:
        if "unsolvable: the robot's" in str(error):
            return None
        if "does not hold yet" in str(error):
            return 0.0
        raise


def plan_cost(texts: list[str], folder: Path) -> int | None:
    """Returns the cost of Fast Downward's best plan for a domain and a problem; None if there is no
    plan. A* without a heuristic supports conditional effects; not all requirements are known."""
    installed = pytest.importorskip("up_fast_downward").__file__
    command = [sys.executable, str(Path(installed).parent / "downward" / "fast-downward.py")]
    for name, text in zip(("d.pddl", "p.pddl"), texts, strict=True):
        command.append(str(folder / name))
        Path(command[-1]).write_text(re.sub(r"\(:requirements.*?\)", "", text), encoding="utf-8")
    done = subprocess.run(
        [*command, "--search", "astar(blind())"], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode in (0, 10, 11, 12), done.stdout + done.stderr
    found = re.search(r"Plan cost: (\d+)", done.stdout)
    return int(found[1]) if found else None


@pytest.mark.parametrize(
    "seed", [*range(15), *(pytest.param(s, marks=pytest.mark.slow) for s in range(15, 60))]
)
def test_a_random_task_is_read_as_fast_downward_reads_it(seed: int, tmp_path: Path) -> None:
    """Its best plan costs what Fast Downward's best plan costs, or both find none."""
    paths = [tmp_path / "domain.pddl", tmp_path / "problem.pddl"]
    for path, text in zip(paths, Writer(seed).task(), strict=True):
        path.write_text(text, encoding="utf-8")
    # Fast Downward itself reads no mark and no upper case.
    plain = [path.read_text(encoding="utf-8-sig").lower() for path in paths]
    assert plan_cost_here(*map(str, paths)) == plan_cost(plain, tmp_path)


def assert_alike(domain: Any, own: dict[str, Any], folder: Path) -> None:
    """Checks that the robot's best plan costs what Fast Downward's costs, with the same files, and
    that each step of Fast Downward's plan is explicable to the robot."""
    texts = [Source.read("", own[key]).text for key in ("file", "problem")]
    model, state = believed(domain), 0
    assert model.to_go[0] == plan_cost(texts, folder)
    names, steps = [name.lower().split() for name in domain.actions], []
    for line in (folder / "sas_plan").read_text().splitlines()[:-1]:  # the last line has the cost
        action = names.index(line.strip("()").split())
        steps.append([state, action, int(model.successor[state, action, 0])])
        state = steps[-1][-1]
    assert model.labels(np.array(steps)).all()
    assert model.terminal[state]


@pytest.mark.parametrize("name", ["blocks", "logistics", "rover", "search_and_rescue"])
def test_the_best_plan_costs_what_fast_downwards_costs(name: str, tmp_path: Path) -> None:
    assert_alike(domain_of(f"domain={name}"), given(name), tmp_path)


EFFECT = f"(not (handempty))\n                 {COST}"
REQUIRES = ":requirements :strips"


@pytest.mark.parametrize(
    ("key", "old", "new"),
    [
        ("file", REQUIRES, f"{REQUIRES} :durative-actions"),  # tags that nothing uses
        ("file", REQUIRES, f"{REQUIRES} :adl :derived-predicates :fluents"),
        ("file", PRECONDITION, "(ontable ?x) (not (and (clear ?x) (holding ?x))) (handempty))"),
        (
            "file",
            PRECONDITION,
            "(clear ?x) (ontable ?x) (exists (?y - block) (not (on ?y ?x))) (handempty))",
        ),
        ("file", EFFECT, f"(forall (?y - block) (not (holding ?y))) (holding ?x) {EFFECT}"),
        ("file", EFFECT, f"(forall (?y - block) (when (on ?x ?y) (clear ?y))) {EFFECT}"),
        ("file", "(holding ?x - block)", "(holding ?x - (either block object))"),
        ("file", "(on ?x - block ?y - block)", "(on ?x - block ?x - block)"),
        ("problem", "a b c d - block", "thing - object a b c d - block spare - object"),
    ],
)
def test_what_fast_downward_reads_costs_what_it_says(
    key: str, old: str, new: str, tmp_path: Path
) -> None:
    own = edited(tmp_path, key, old, new) | {"words": {}}
    assert_alike(PDDL(**own), own, tmp_path)
