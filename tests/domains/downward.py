"""The Fast Downward planner, for comparisons."""

import re
import subprocess
import sys
from pathlib import Path

import pytest


def plan_cost(domain: Path, problem: Path, folder: Path) -> int | None:
    """Returns the cost of the planner's best plan; None if there is no plan. A* without a heuristic
    supports conditional effects."""
    installed = pytest.importorskip("up_fast_downward").__file__
    driver = Path(installed).parent / "downward" / "fast-downward.py"
    command = [sys.executable, str(driver), str(domain), str(problem)]
    done = subprocess.run(
        [*command, "--search", "astar(blind())"], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode in (0, 10, 11, 12), done.stdout + done.stderr
    found = re.search(r"Plan cost: (\d+)", done.stdout)
    return int(found[1]) if found else None
