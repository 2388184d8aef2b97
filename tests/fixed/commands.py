"""The reference runs: commands in an empty folder, and the part of their output that is stored."""

import csv
import json
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tests import forked
from tests.people.server_process import ServerProcess
from xplain.learning.saved import LearnedTypes

Kept = dict[str, Any]


def xplain(folder: Path, *words: str) -> str:
    """Runs a command; returns its standard output."""
    done = forked.captured(folder, *words)
    assert done.returncode == 0, f"{words}: {done.stderr}"
    return done.stdout


SMALL = ("traces=3", "certify.traces=1", "certify.episodes=10", "tracking=none")
SOLVERS = ("qmdp", "pomcp", "certified", "qhr")


def explanations(folder: Path, domain: str) -> Kept:
    """Explains the same traces of one domain with four solvers."""
    return jobs(folder, f"domain={domain}", f"solver={','.join(SOLVERS)}", *SMALL)


def paper(folder: Path) -> Kept:
    """Runs a sweep as in the paper: its learner, its baselines, two λ."""
    learner = ("clusterer=kmeans", "labeler=tree", "queries=shared", "domain=four_rooms")
    solvers = "solver=baseline,conformant,lookahead,pomcp_paper"
    return jobs(folder, *learner, solvers, "lambda=0.5,2", "belief=persistent", *SMALL)


def jobs(folder: Path, *words: str) -> Kept:
    """Returns decisions and costs of a sweep's jobs. It uses one process, because two would both
    compile the same kernels."""
    xplain(folder, "-m", *words, "hydra/launcher=basic")
    kept = {}
    for path in sorted(folder.glob("outputs/results/*/results.json")):
        results = json.loads(path.read_text(encoding="utf-8"))
        lines = (path.parent / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
        name = f"{results['choices']['solver']} λ={results['config']['lambda']:g}"
        kept[name] = {
            "bounds": results["bounds"],
            "learning": results["learning"],
            "episodes": [episode(json.loads(line)) for line in lines],
        }
    return dict(sorted(kept.items()))


def episode(line: Kept) -> Kept:
    """Returns decisions, beliefs and cost of one explanation."""
    return {
        "of": f"{line['solver']}, trace {line['trace']}, {line['type']}",
        "cost": line["cost"],
        "messages": [step["messages"] for step in line["steps"]],
        "beliefs": [step["belief"] for step in line["steps"]],
    }


def discovery(folder: Path) -> Kept:
    """Asks adaptive questions with one wrong answer in twenty, and finds the types."""
    options = ("queries=adaptive", "points=20", "observers.label_noise=0.05")
    xplain(folder, "observe", "domain=rescue", *options, "output=labels.csv")
    xplain(folder, "questions", "domain=rescue", "points=6", "save=hypotheses.npz")
    known = ("hypotheses=hypotheses.npz", "labeler=hypotheses")
    said = json.loads(xplain(folder, "discover", "data=labels.csv", *known).splitlines()[-1])
    del said["seconds"]
    return {
        "labels": table(folder / "labels.csv"),
        "questions": table(folder / "questions.csv"),
        "found": said,
        "types": numbers(folder / "outputs/discover/types.npz"),
    }


def numbers(path: Path) -> Kept:
    """Returns the numbers of saved types; tables are replaced by their means over message sets."""
    types = LearnedTypes.load(path)
    labelers, habits = [*types.labelers, types.about_everything], types.habits
    values = {
        "prior": types.prior,
        **{f"habits/{key}": getattr(habits, key) for key in ("error", "accept", "forget", "prior")},
        "wrong": types.wrong,
        "new": types.new,
        **{f"{t}/{key}": own for t, x in enumerate(labelers) for key, own in x.arrays().items()},
        **{
            key: [getattr(labeler, key) for labeler in labelers]
            for key in ("confidence", "accuracy", "n_train", "n_test")
        },
    }
    arrays = {name: np.asarray(own) for name, own in values.items()}
    return {name: (a.mean(axis=-1) if a.ndim > 1 else a).tolist() for name, a in arrays.items()}


def collection(folder: Path) -> Kept:
    """Runs a collection with simulated people over HTTP: questions, and posteriors."""
    out = served(folder, "collect", 5, "domain=rescue", "points=10")
    return {"clips": table(out / "clips.csv"), "observers": table(out / "observers.csv")}


def study(folder: Path) -> Kept:
    """Runs a study with simulated people over HTTP: steps, messages and beliefs."""
    out = served(folder, "study", 10, "seed=0", "rules.per_cell=1", "points=300")
    came = read(out / "participants.csv")
    entered = came[0].index("entered")
    order = {row[0]: i for i, row in enumerate(sorted(came[1:], key=lambda row: row[entered]))}
    return {name: table(out / f"{name}.csv", order) for name in ("steps", "participants")}


def served(folder: Path, command: str, people: int, *words: str) -> Path:
    """Runs a server that simulated people visit, one after the other, replays its log, and returns
    the export."""
    with ServerProcess(folder / "d.sqlite", *words, command=command) as server:
        where = ("--url", server.url, "--key", server.key, "--save", "out.zip")
        xplain(folder, command, "bots", *where, "--count", str(people), "--at-once", "1")
    xplain(folder, command, "replay", "d.sqlite")
    with zipfile.ZipFile(folder / "out.zip") as archive:
        archive.extractall(folder)
    return folder / "study"


CHANCE = re.compile(r"(^|_)(s|seconds|time|entered|seen|hash|code)$")
"""Columns that differ between any two runs, or depend on texts: times, codes, hashes."""


def read(path: Path) -> list[list[str]]:
    """Reads a CSV file's head and rows."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file))


def table(path: Path, order: Mapping[str, int] | None = None) -> list[list[Any]]:
    """Reads a CSV file's head and rows, without columns that always differ. Cells with lists
    (beliefs, values) are read as JSON.

    Args:
        path: the path of the file.
        order: the order of people's visits, by their (random) names; None keeps the order of the
            file.
    """
    head, *rows = read(path)
    kept = [i for i, name in enumerate(head) if not CHANCE.search(name)]
    if head[0] in ("observer", "participant"):
        order = order or {name: i for i, name in enumerate(dict.fromkeys(row[0] for row in rows))}
        rows.sort(key=lambda row: order[row[0]])
        rows = [[f"person {order[row[0]]}", *row[1:]] for row in rows]
    return [[read_cell(row[i]) for i in kept] for row in (head, *rows)]


def read_cell(cell: str) -> Any:
    """Reads lists and mappings from JSON; all else is text."""
    return json.loads(cell) if cell[:1] in ("[", "{") else cell


RUNS: dict[str, Callable[[Path], Kept]] = {
    "discovery": discovery,
    "collection": collection,
    "study": study,
    "four_rooms": lambda folder: explanations(folder, "four_rooms"),
    "rescue": lambda folder: explanations(folder, "rescue"),
    "paper": paper,
}
