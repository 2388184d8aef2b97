"""The examples as their users have them: installed beside the built wheel, far from this folder."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

EXAMPLES = sorted(path.parent.name for path in (ROOT / "examples").glob("*/pyproject.toml"))


@pytest.fixture(scope="session")
def installed(tmp_path_factory):
    """A folder with xplain and all examples, installed from wheels that were built here."""
    pytest.importorskip("hatchling", reason="pip install 'xplain-hri[test]'")
    wheels, site = tmp_path_factory.mktemp("wheels"), tmp_path_factory.mktemp("site")
    sources = [ROOT, *(ROOT / "examples" / name for name in EXAMPLES)]
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(wheels)]
    ran(*build, *map(str, sources))
    ran(*pip, "install", "--no-deps", "--no-index", "--target", str(site),
        *map(str, wheels.glob("*.whl")))  # fmt: skip
    return site


def ran(*command, **options):
    """What the command printed; its errors are ours."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def elsewhere(site, folder):
    """Runs with the installed packages alone, in a folder of its own."""
    env = {key: value for key, value in os.environ.items() if key != "MLFLOW_TRACKING_URI"}
    return {"cwd": folder, "env": env | {"PYTHONPATH": str(site), "PYTHONDONTWRITEBYTECODE": "1"}}


@pytest.mark.slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_conforms_and_runs_against_the_wheel(installed, tmp_path, name):
    shutil.copytree(ROOT / "examples" / name / "conf", tmp_path / "conf")
    shutil.copytree(ROOT / "examples" / name / "tests", tmp_path / "tests")
    where = elsewhere(installed, tmp_path)
    found = ran(sys.executable, "-c", "import xplain; print(xplain.__file__)", **where)
    assert Path(found.strip()).is_relative_to(installed)
    tested = ran(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests", **where)
    assert "passed" in tested
    (choice,) = (tmp_path / "conf").rglob("*.yaml")
    said = ran(
        *(sys.executable, "-m", "xplain", "--config-dir", "conf", "tracking=none", "traces=2"),
        f"{choice.parent.name}={choice.stem}",
        **where,
    )
    assert "cost" in said
    assert list((tmp_path / "outputs" / "runs").rglob("results.json"))


@pytest.mark.slow
def test_the_wheel_carries_what_the_commands_need(installed, tmp_path):
    for folder in ("conf", "sweeps"):
        shipped = {path.name for path in (installed / "xplain" / folder).rglob("*.yaml")}
        assert shipped == {path.name for path in (ROOT / folder).rglob("*.yaml")}
        assert shipped
    for page in (ROOT / "xplain").rglob("*.html"):
        assert (installed / page.relative_to(ROOT)).exists()
    where = elsewhere(installed, tmp_path)
    assert "lambda: 1.0" in ran(sys.executable, "-m", "xplain", "--cfg", "job", **where)
    said = ran(
        *(sys.executable, "-m", "xplain", "sweeps=smoke", "traces=1", "certify.traces=0"),
        "hydra.sweeper.settings=null",
        **where,
    )
    assert "QHR" in said


def test_examples_test_themselves_in_three_lines():
    for name in EXAMPLES:
        (test,) = (ROOT / "examples" / name / "tests").glob("test_*.py")
        lines = [line for line in test.read_text().splitlines() if line.strip()]
        assert len(lines) == 3
        (choice,) = (ROOT / "examples" / name / "conf").rglob("*.yaml")
        assert "# " in choice.read_text()
