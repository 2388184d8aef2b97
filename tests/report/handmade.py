"""Sweeps with known numbers, written to disk like real sweeps."""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from xplain.domains.base import Item, Scene
from xplain.experiment.results import (
    ElbowFigures,
    EpisodeFigures,
    Results,
    TypeNames,
    save_results,
)

TYPES = ("A", "B")
Values = Mapping[str, str]


def episode(solver: str, trace: int, kind: str, cost: float) -> EpisodeFigures:
    return EpisodeFigures(
        solver=solver,
        trace=trace,
        type=kind,
        cost=cost,
        communication=1.0,
        inexplicability=2.0,
        messages=1,
        inexplicable_labels=2,
        steps_until_sure=1,
    )


def line(solver: str, trace: int, kind: str) -> str:
    steps = [
        {"messages": ["fire"], "labels": [1], "belief": [0.5, 0.5]},
        {"messages": [], "labels": [1, 0], "belief": [0.9, 0.1]},
    ]
    return json.dumps(
        {
            "solver": solver,
            "trace": trace,
            "type": kind,
            "cost": 3.5,
            "transitions": ["moves right to (0, 1)", "moves <right> & stops"],
            "positions": [[0, 0], [0, 1], [0, 2]],
            "prior": [0.5, 0.5],
            "steps": steps,
        }
    )


def sweep(
    folder: Path,
    jobs: Iterable[Values],
    regret: Callable[[Values, int], float],
    oracle: Callable[[Values, int], float] = lambda values, trace: 1.0 + trace,
    traces: int = 4,
    index: Callable[[Values], float] = lambda values: 1.0,
    floor: Callable[[Values, int], float] | None = None,
    **about: object,
) -> Path:
    """Writes a finished sweep.

    Args:
        folder: the sweep is written here.
        jobs: the swept keys with their values, for each job.
        regret, oracle: values of a job on a trace, the same for users of both types.
        traces: number of traces.
        index: adjusted Rand index of the types that a job found.
        floor: the clairvoyant's cost of a job on a trace; None if none ran.
        about: other content of ``sweep.json``, such as ``pool``.
    """
    written = []
    for values in jobs:
        name = ",".join(f"{key}={value}" for key, value in values.items())
        job = {"label": name, "values": dict(values), "overrides": name.split(",")}
        written.append({**job, "fingerprint": name})
        own = folder / "results" / name
        own.mkdir(parents=True)
        episodes = [
            episode(solver, trace, kind, oracle(values, trace) + more)
            for trace in range(traces)
            for kind in TYPES
            for solver, more in (("oracle", 0.0), ("solver", regret(values, trace)))
        ]
        if floor is not None:
            episodes += [
                episode("clairvoyant", trace, kind, floor(values, trace))
                for trace in range(traces)
                for kind in TYPES
            ]
        made = results(name, values, tuple(episodes))
        learning = made.learning | {"adjusted_rand_index": index(values)}
        save_results(own, replace(made, learning=learning))
        (own / "episodes.jsonl").write_text("\n".join(line("solver", 0, kind) for kind in TYPES))
    content = {"name": "by hand", "command": "python -m xplain", "code": "c0de", "git": {}}
    content["results"] = "results"
    (folder / "sweep.json").write_text(json.dumps(content | about | {"jobs": written}))
    return folder


def steps(number: float, seed: int) -> dict[str, tuple[float, ...]]:
    """Returns a belief whose last step differs, and is in fewer episodes of a later seed."""
    last = 0.9 - 0.2 * seed - 0.01 * number
    return {"belief_in_true_type": (0.5, 0.8, last), "episodes": (8, 8, 8 / (1 + seed))}


def results(name: str, values: Values, episodes: tuple[EpisodeFigures, ...]) -> Results:
    trade_off = float(values.get("lambda", 1))
    return Results(
        name=name,
        fingerprint=name,
        xplain="0",
        code="0",
        git={},
        worker="here 1",
        started=0.0,
        seconds={},
        choices={
            "domain": values.get("domain", "rescue"),
            "solver": values.get("solver", "qmdp"),
            "explainee": "exact",
            "ask": "never",
        },
        config={"lambda": trade_off, "seed": int(values.get("seed", 0))},
        metrics={},
        bounds={},
        certificates="not asked for",
        learning={"types_found": 2.0, "adjusted_rand_index": 1.0},
        elbow=ElbowFigures("kneedle", (40.0, 3.0, 1.0)),
        messages={"fire": f"The robot of {values.get('domain', 'rescue')} likes <fire>."},
        scene=Scene(1, 3, (), (Item("goal", "G", ((0, 2),)),)),
        types=TypeNames(TYPES, ("1", "2"), (0, 1), (0, 1)),
        steps=steps(float(values.get("users.count", trade_off)), int(values.get("seed", 0))),
        episodes=episodes,
    )
