"""What programs import: listed, there, and not paid for before it is used."""

from __future__ import annotations

import subprocess
import sys

import pytest

LOOK = """
import sys
import {package} as package
print(*dir(package))
print(*{{"numpy", "numba", "hydra", "pytest"}} & set(sys.modules))
from {package} import *
print(*(name for name in package.__all__ if name in globals()))
"""
NAMES = {
    "xplain": "Explainer GivenTypes Hypotheses LearnedTypes Questionnaire Run Sweep "
    "__version__ load run sweep",
    "xplain.testing": "Chosen ClustererConformance DomainConformance ExplaineeConformance "
    "LabelerConformance PartitionConformance QueriesConformance SolverConformance "
    "TypeSourceConformance",
}


@pytest.mark.parametrize(("package", "names"), NAMES.items())
def test_public_names_are_listed_and_imported_when_asked_for(package: str, names: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", LOOK.format(package=package)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    listed, heavy, imported = done.stdout.splitlines()
    assert (listed, imported) == (names, names)
    assert heavy == ""
    with pytest.raises(ImportError, match="Explainers"):
        exec(f"from {package} import Explainers")
