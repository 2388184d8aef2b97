"""Public names are listed, exist, and are imported only when they are used."""

import re
import subprocess
import sys

import pytest

import xplain
import xplain.testing
from tests.conftest import ROOT

LOOK = """
import sys
import {package} as package
print(*dir(package))
print(*{{"numpy", "numba", "hydra", "pytest"}} & set(sys.modules))
from {package} import *
print(*(name for name in package.__all__ if name in globals()))
"""


@pytest.mark.parametrize("package", [xplain, xplain.testing])
def test_public_names_are_imported_when_they_are_asked_for(package) -> None:
    done = subprocess.run(
        [sys.executable, "-c", LOOK.format(package=package.__name__)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    listed, heavy, imported = done.stdout.splitlines()
    assert listed.split() == imported.split() == sorted(package.__all__)
    assert heavy == ""
    with pytest.raises(ImportError, match="Explainers"):
        exec(f"from {package.__name__} import Explainers")


def test_a_suite_without_pytest_says_what_to_install() -> None:
    code = "import sys; sys.modules['pytest'] = None\nfrom xplain.testing import SolverConformance"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr.strip().endswith(
        "ImportError: xplain.testing.SolverConformance needs pytest: pip install pytest"
    )


def test_at_most_forty_public_names_are_all_on_their_page() -> None:
    assert len(xplain.__all__) <= 40
    page = (ROOT / "docs/api.rst").read_text()
    shown = set(re.findall(r"^\.\. auto\w+:: xplain\.((?:testing\.)?\w+)$", page, re.MULTILINE))
    assert shown - {"testing"} == {
        *xplain.__all__,
        *(f"testing.{name}" for name in xplain.testing.__all__),
    }


def test_type_checkers_find_each_public_name_where_it_is() -> None:
    stub = (ROOT / "xplain/__init__.pyi").read_text()
    for module, name in re.findall(r"^from (\S+) import (\w+) as", stub, re.MULTILINE):
        assert getattr(xplain, name) is getattr(sys.modules[module], name)
    assert set(re.findall(r" as (\w+)$", stub, re.MULTILINE)) == {*xplain.__all__}
