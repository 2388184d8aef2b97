"""Measures seconds and memory of a whole run against the number of states of a PDDL task.

    python benchmarks/pddl.py            some minutes
    python benchmarks/pddl.py --quick    a smaller task

In the task a courier on a ring of places with a few short cuts delivers parcels, any number at a
time. People may believe ten facts incorrectly: lengths of roads, roads that exist or not, what
loading and unloading need, and a goal. Each of three random types believes five facts incorrectly
on average. Each size runs in a new process, `python -m xplain domain=pddl … traces=5
certify.traces=0 tracking=none`, with compiled kernels.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from itertools import islice
from pathlib import Path

from rich.console import Console
from rich.table import Table

from xplain.domains.pddl.domain import PDDL

DOMAIN = """(define (domain courier)
  (:requirements :strips :typing :action-costs)
  (:types place parcel)
  (:predicates (at ?l - place) (road ?a ?b - place) (waits ?p - parcel ?l - place)
               (aboard ?p - parcel))
  (:functions (total-cost) (length ?a ?b - place))
  (:action drive :parameters (?a ?b - place)
    :precondition (and (at ?a) (road ?a ?b))
    :effect (and (at ?b) (not (at ?a)) (increase (total-cost) (length ?a ?b))))
  (:action load :parameters (?p - parcel ?l - place)
    :precondition (and (at ?l) (waits ?p ?l))
    :effect (and (aboard ?p) (not (waits ?p ?l)) (increase (total-cost) 1)))
  (:action unload :parameters (?p - parcel ?l - place)
    :precondition (and (at ?l) (aboard ?p))
    :effect (and (waits ?p ?l) (not (aboard ?p)) (increase (total-cost) 1))))
"""


def problem(places: int, parcels: int) -> str:
    """Writes the problem: parcels wait at all places in turn, each for the place across the
    ring."""
    ring = range(places)
    roads = {(i, (i + 1) % places): 2 + i % 3 for i in ring} | {(0, places // 2): 5}
    roads |= {(b, a): length for (a, b), length in roads.items()}
    init = [f"(road l{a} l{b}) (= (length l{a} l{b}) {x})" for (a, b), x in roads.items()]
    init += ["(= (length l1 l3) 3) (= (length l3 l1) 3)"]
    init += [f"(waits p{i} l{(2 * i + 1) % places})" for i in range(parcels)]
    goal = [f"(waits p{i} l{(2 * i + 1 + places // 2) % places})" for i in range(parcels)]
    return f"""(define (problem ring) (:domain courier)
  (:objects {" ".join(f"l{i}" for i in ring)} - place
            {" ".join(f"p{i}" for i in range(parcels))} - parcel)
  (:init (at l0) (= (total-cost) 0) {" ".join(init)})
  (:goal (and {" ".join(goal)})) (:metric minimize (total-cost)))
"""


def facts(places: int) -> dict[str, object]:
    """Makes ten facts; each concerns another part of the task."""

    def length(a: int, b: int, value: float) -> list[dict[str, object]]:
        return [{"function": f"(length l{x} l{y})", "value": value} for x, y in ((a, b), (b, a))]

    across = [f"(road l0 l{places // 2})", f"(road l{places // 2} l0)"]
    changes: list[object] = [
        length(0, 1, 9),
        length(1, 2, 8),
        length(2, 3, 1),
        length(places - 1, 0, 9),
        length(3, 4, 8),
        {"action": "load", "drop_precondition": "(at ?l)"},
        {"action": "unload", "drop_precondition": "(at ?l)"},
        [{"drop_initial": road} for road in across],
        [{"add_initial": "(road l1 l3)"}, {"add_initial": "(road l3 l1)"}],
        {"drop_goal": f"(waits p0 l{(1 + places // 2) % places})"},
    ]
    return {f"fact{i}": {"change": change} for i, change in enumerate(changes)}


def measured(places: int, parcels: int, starts: str, *small: str, count: int = 10) -> list[str]:
    """Measures one size: a row of the table."""
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder, name) for name in ("domain.pddl", "problem.pddl")]
        for file, text in zip(files, (DOMAIN, problem(places, parcels)), strict=True):
            file.write_text(text, encoding="utf-8")
        own = dict(islice(facts(places).items(), count))
        limit = 2_000_000
        began = time.perf_counter()
        made = PDDL(*map(str, files), facts=own, starts=_parse_start(starts), max_states=limit)  # type: ignore[arg-type]
        domain_seconds = time.perf_counter() - began
        overrides = [
            "domain=pddl",
            f"domain.file={files[0]}",
            f"domain.problem={files[1]}",
            "+domain.facts=" + _write_override(own),
            f"domain.starts={starts}",
            f"domain.max_states={limit}",
            "traces=5",
            "certify.traces=0",
            "tracking=none",
            f"outputs={folder}/outputs",
            *small,
        ]
        command = [sys.executable, "-m", "xplain", *overrides]
        began = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, used = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - began
    if status:
        raise SystemExit(f"failed: {' '.join(command)}")
    return [
        f"{len(made.state_features):,}",
        str(len(made.actions)),
        f"{len(made.starts):,}",
        f"{domain_seconds:.1f}",
        f"{seconds:.1f}",
        f"{used.ru_utime + used.ru_stime:.1f}",
        f"{used.ru_maxrss / 2**20:.2f}",
    ]


def _parse_start(text: str) -> str | int:
    return int(text) if text.isdecimal() else text


def _write_override(value: object) -> str:
    """Writes a value as an override of Hydra: strings in quotes, keys without quotes."""
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_write_override(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(_write_override, value)) + "]"
    return json.dumps(value)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    quick = parser.parse_args().quick
    table = Table(
        "states", "actions", "starts", "domain (s)", "first result (s)", "of CPU",
        "peak (GiB)",
        title="PDDL, 10 facts, 3 types",
    )  # fmt: skip
    if quick:
        small = ("traces=1", "max_steps=4", "users.count=2", "points=5")
        table.add_row(*measured(5, 1, "reachable", *small, count=3))
    else:
        for places, parcels, starts in ((6, 4, "reachable"), (6, 5, "8"), (7, 5, "8")):
            table.add_row(*measured(places, parcels, starts))
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
