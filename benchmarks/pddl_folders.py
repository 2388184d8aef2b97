"""Measures the share of PDDL tasks that xplain reads: the smallest problem of each folder of a
collection.

    python benchmarks/pddl_folders.py COLLECTION            an hour for 150 folders
    python benchmarks/pddl_folders.py COLLECTION --only blocks gripper
    python benchmarks/pddl_folders.py --quick       two of the tasks of this package

COLLECTION has one folder of files for each domain, as the benchmarks of the planning competitions
(https://github.com/aibasel/downward-benchmarks). A problem's domain is in `domain.pddl`, or in a
file named after the problem. Each task gets one fact: its first action has another cost. Each task
is built in a separate process, with at most `--states` states, `--seconds` of CPU time and `--gib`
of memory. The cost of the best plan is compared with the cost of Fast Downward's A* plan, if
`up-fast-downward` is installed.
"""

import argparse
import json
import re
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console
from rich.table import Table

from xplain.domains.pddl import domain as pddl_domain
from xplain.domains.pddl.domain import PDDL
from xplain.domains.pddl.task import read_task
from xplain.errors import TooLargeError, XplainError

SHIPPED = Path(pddl_domain.__file__).parent / "tasks"
UNSUPPORTED = r"a condition with \w+ is not|derived predicates"
"""Reasons to refuse tasks with more than STRIPS with types, negation, conditional effects and
costs."""


def find_task(folder: Path) -> tuple[Path, Path] | None:
    """Finds the domain and the smallest problem of a folder, by the size of the files."""
    problems = []
    for file in folder.glob("*.pddl"):
        text = file.read_bytes().decode("utf-8-sig", errors="replace").lower()
        if re.search(r"\(\s*define\s*\(\s*problem", text):
            problems.append((len(text), file))
    for _, file in sorted(problems):
        stems = file.stem, file.stem.split("-")[0], file.stem.split("_")[0]
        names = [f"{x}-domain" for x in stems] + [f"domain{y}{x}" for x in stems for y in "-_"]
        for name in (*names, "domain"):
            if (domain := folder / f"{name}.pddl").exists() and domain != file:
                return domain, file
    return None


def build(domain: str, problem: str, states: int) -> str:
    """Builds a task. Returns its numbers of states and ground actions and its plan cost, or the
    reason why it was not built, as JSON."""
    try:
        read = read_task(domain, problem, ("domain", "problem"))
    except XplainError as error:
        return json.dumps({"refused": str(error)})
    first = next(item.owner for item in read.items if item.kind == "action")
    facts = {"first": {"change": {"action": first, "cost": 12345}}}
    try:
        made = PDDL(domain, problem, facts=facts, dead_end_cost=1e9, max_states=states)
    except TooLargeError as error:
        return json.dumps({"large": str(error)})
    except XplainError as error:
        return json.dumps({"read": str(error)})
    cost = float(made.model({"first": []}).to_go[0])
    return json.dumps(
        {"states": len(made.state_features), "actions": len(made.actions), "cost": cost}
    )


def plan_cost(domain: Path, problem: Path) -> float | None:
    """Computes the cost of Fast Downward's best plan; None without a plan."""
    found = find_spec("up_fast_downward")
    if found is None or found.origin is None:
        return None
    driver = Path(found.origin).parent / "downward" / "fast-downward.py"
    command = [sys.executable, str(driver), str(domain), str(problem)]
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [*command, "--search", "astar(blind())"], cwd=folder, capture_output=True, text=True
        )
    cost = re.search(r"Plan cost: (\d+)", done.stdout)
    return float(cost[1]) if cost else None


def measure(domain: Path, problem: Path, options: argparse.Namespace) -> dict[str, object]:
    """Returns the result of a task within the limits."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (options.seconds, options.seconds))
        resource.setrlimit(resource.RLIMIT_AS, (int(options.gib * 2**30),) * 2)

    command = [sys.executable, __file__, "--build", str(domain), str(problem)]
    command += ["--states", str(options.states), "--", "."]
    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=limit)
    lines = done.stdout.splitlines()
    if not lines:
        wrong = (done.stderr.splitlines() or [""])[-1]
        memory, killed = "MemoryError" in done.stderr, done.returncode < 0
        why = "memory" if memory else f"{options.seconds} s" if killed else ""
        return {"large": f"more than {why}"} if why else {"failed": wrong}
    result: dict[str, object] = json.loads(lines[-1])
    if "cost" in result:
        result["downward"] = plan_cost(domain, problem)
    return result


def classify(result: dict[str, object]) -> str:
    """Returns the task's row of the summary."""
    if "refused" in result:
        more = re.search(UNSUPPORTED, str(result["refused"]))
        return f"refused: {more[0].removesuffix(' is not')}" if more else "refused: another reason"
    if "cost" in result:
        same = find_spec("up_fast_downward") is None or result["downward"] == result["cost"]
        return "read and built" if same else "another plan cost than Fast Downward's"
    return {"large": "read, but larger than the limits", "read": "read, not built"}.get(
        next(iter(result)), "failed"
    )


def main() -> None:
    """Prints a row for each folder and a summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("collection", type=Path, nargs="?", default=SHIPPED)
    parser.add_argument("--quick", action="store_true", help="two of the tasks of this package")
    parser.add_argument("--only", nargs="+", help="names of folders")
    parser.add_argument("--states", type=int, default=10_000)
    parser.add_argument("--seconds", type=int, default=120)
    parser.add_argument("--gib", type=float, default=6)
    parser.add_argument("--build", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.quick:
        options.collection, options.only = SHIPPED, ["blocks", "rover"]
    if options.build:
        domain, problem = options.build
        print(build(domain, problem, options.states))
        return
    table = Table("folder", "problem", "result", "states", "actions", "plan cost", "why")
    count: Counter[str] = Counter()
    console = Console(width=200)
    folders = sorted(x for x in options.collection.iterdir() if x.is_dir() and x.name[0] != ".")
    for folder in folders:
        task = find_task(folder)
        if task is None or (options.only and folder.name not in options.only):
            continue
        result = measure(*task, options)
        count[classify(result)] += 1
        shown = (str(result.get(key, "")) for key in ("states", "actions", "cost"))
        reasons = ("refused", "large", "read", "failed")
        why = next((str(result[key]) for key in reasons if key in result), "")
        row = (folder.name, task[1].name, classify(result), *shown, why)
        table.add_row(*row)
        print(*row, sep=" | ", file=sys.stderr, flush=True)
    console.print(table)
    for name, number in count.most_common():
        print(f"{number:4} {name}")
    print(f"{count.total():4} folders")


if __name__ == "__main__":
    main()
