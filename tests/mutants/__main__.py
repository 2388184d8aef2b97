"""Adds random mistakes, one at a time, and reports those that no test notices.

    python -m tests.mutants --each 8 --seed 1                  as many of each folder of xplain/
    python -m tests.mutants --each 8 --seed 1 --areas solvers  of these folders alone

A mistake is one of cosmic-ray's, or a statement that is left out (:mod:`tests.mutants.operators`).
The tests that import its module run first, then all tests of the mirrored folder in tests/ and
those that import a module that imports it. What a test's helpers import counts as the test's.
Outcomes are in outputs/mutants-SEED.jsonl: an interrupted campaign goes on from there. The tests
must pass without a mistake (`make mutants` runs them before).
"""

import argparse
import ast
import difflib
import json
import os
import random
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from tests.mutants import operators

ROOT = Path(__file__).parents[2]
SECONDS = 1800.0
"""That a mutant's tests may take: a mistake can make a loop endless."""
MEMORY = 8 << 30
"""Bytes that they may take: an endless loop can fill the machine before its time is over."""
LEFT_OUT = (".*", "outputs", "build", "dist", "__pycache__")


class Mutant(NamedTuple):
    """A mistake: the file, the operator, the number of its occurrence there, and the changed
    lines."""

    area: str
    path: str
    operator: str
    occurrence: int
    change: str


def areas() -> dict[str, list[Path]]:
    """Lists the modules of each folder of the package; single modules are one area."""
    found = defaultdict(list)
    for path in sorted((ROOT / "xplain").rglob("*.py")):
        inside = path.relative_to(ROOT / "xplain").parts
        if path.stem not in ("__init__", "__main__"):
            found[inside[0] if len(inside) > 1 else "modules"].append(path)
    return dict(found)


def draw(area: str, paths: list[Path], seed: int) -> Iterator[Mutant]:
    """Yields all mutants of an area in random order: a place in the source, then one mistake
    there."""
    places = defaultdict(list)
    for path in paths:
        for operator, occurrence, span in operators.places(path.read_text("utf-8")):
            places[path, span].append((operator, occurrence))
    rng = random.Random(f"{seed} {area}")
    for path, span in rng.sample(sorted(places), len(places)):
        operator, occurrence = rng.choice(places[path, span])
        source = path.read_text("utf-8")
        mutated = operators.mutate(source, operator, occurrence)
        if mutated is not None:
            lines = difflib.unified_diff(
                source.splitlines(), mutated.splitlines(), n=0, lineterm=""
            )
            change = "\n".join(list(lines)[2:])
            yield Mutant(area, str(path.relative_to(ROOT)), operator, occurrence, change)


PUBLIC = {
    f"{stub.parent.relative_to(ROOT)}.{name}".replace("/", "."): module
    for stub in (ROOT / "xplain").rglob("__init__.pyi")
    for module, name in re.findall(
        r"^from (\S+) import (\w+)", stub.read_text("utf-8"), re.MULTILINE
    )
}
"""The module of each public name."""


@cache
def imported(path: Path) -> set[str]:
    """Lists the modules that a file, or a helper in tests/ that it imports, imports or imports a
    name from."""
    text, found = path.read_text("utf-8"), set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            found |= {str(node.module), *(PUBLIC.get(name, name) for name in names)}
    if "tests" in path.relative_to(ROOT).parts and re.search(r"\brun\(", text):
        found.add("tests.conftest")  # the commands
    helpers = [ROOT / f"{name.replace('.', '/')}.py" for name in found if name.startswith("tests.")]
    return found.union(*(imported(one) for one in helpers if one.is_file() and one != path))


def name_module(path: Path) -> str:
    """Returns the name by which a file is imported."""
    return str(path.relative_to(ROOT)).removesuffix(".py").replace("/", ".")


def stages(mutant: Mutant) -> list[list[str]]:
    """Lists the test files for a mutant: files that import its module; then the files of the
    mirrored folder, and files that import a module that imports it."""
    module = name_module(ROOT / mutant.path)
    users = {name_module(p) for own in areas().values() for p in own if module in imported(p)}
    near, far = [], []
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        folder, test = path.relative_to(ROOT / "tests").parts[0], str(path.relative_to(ROOT))
        if module in imported(path):
            near.append(test)
        elif folder == mutant.area or users & imported(path):
            far.append(test)
    return [tests for tests in (near, far) if tests]


def noticed(mutant: Mutant, copy: Path, scratch: Path) -> str:
    """Returns the first test that fails with the mistake; "" if all pass, "time" if the tests never
    end."""
    path = copy / mutant.path
    source = path.read_text("utf-8")
    mutated = operators.mutate(source, mutant.operator, mutant.occurrence)
    assert mutated is not None
    kernels = scratch / "kernels"
    if "numba" in source:  # numba does not see edits of what a compiled function calls
        kernels = Path(tempfile.mkdtemp(dir=scratch))
    environment = os.environ | {"PYTHONPATH": str(copy), "NUMBA_CACHE_DIR": str(kernels)}
    command = [sys.executable, "-B", "-m", "pytest", "-qx"]
    path.write_text(mutated, "utf-8")
    try:
        for tests in stages(mutant):
            done = subprocess.run(
                [*command, "-p", "no:cacheprovider", *tests],
                cwd=copy,
                env=environment,
                capture_output=True,
                text=True,
                timeout=SECONDS,
                preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY)),
                check=False,
            )
            if done.returncode not in (0, 5):  # 5: all tests of these files are slow
                failed = [line for line in done.stdout.splitlines() if line.startswith("FAILED")]
                return failed[0].split()[1] if failed else f"pytest ends with {done.returncode}"
    except subprocess.TimeoutExpired:
        return "time"
    finally:
        path.write_text(source, "utf-8")
    return ""


def report(outcomes: dict[Mutant, str]) -> str:
    """Prints the share of noticed mistakes by area, and every other mistake as a difference."""
    lines = []
    for area in [*dict.fromkeys(mutant.area for mutant in outcomes), ""]:
        own = [killer for mutant, killer in outcomes.items() if area in ("", mutant.area)]
        share = sum(map(bool, own)) / max(1, len(own))
        lines.append(f"{area or 'all':14}{sum(map(bool, own)):4} of {len(own):4}{share:7.0%}")
    for mutant, killer in outcomes.items():
        if not killer:
            lines.append(f"\n{mutant.path}  ({mutant.operator})\n{mutant.change}")
    return "\n".join(lines)


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--each", type=int, default=8, help="mutants of an area (8)")
    parser.add_argument("--seed", type=int, default=1, help="of the draw (1)")
    parser.add_argument("--areas", nargs="+", default=[], help="folders of xplain/ (all)")
    given = parser.parse_args()
    file = ROOT / f"outputs/mutants-{given.seed}.jsonl"
    known: dict[Mutant, str] = {}
    for line in file.read_text("utf-8").splitlines() if file.exists() else ():
        *mutant, killer = json.loads(line)
        known[Mutant(*mutant)] = killer
    drawn: list[Mutant] = []
    for area, paths in areas().items():
        if not given.areas or area in given.areas:
            drawn += islice(draw(area, paths, given.seed), given.each)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "copy")
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*LEFT_OUT), symlinks=True)
        (copy / "outputs").mkdir()
        for mutant in drawn:
            if mutant not in known:
                known[mutant] = noticed(mutant, copy, Path(folder))
                with file.open("a", encoding="utf-8") as outcomes:
                    outcomes.write(json.dumps([*mutant, known[mutant]]) + "\n")
                print(f"{known[mutant] or 'SURVIVED'}: {mutant.path} {mutant.operator}", flush=True)
    print(report({mutant: known[mutant] for mutant in drawn}))


if __name__ == "__main__":
    main()
