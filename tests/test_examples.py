"""The examples as users have them: installed beside the built wheel, outside this folder."""

import os
import re
import shutil
import subprocess
import sys
import venv
from importlib.metadata import distribution
from pathlib import Path

import pytest

from tests import forked
from tests.conftest import ROOT

EXAMPLES = sorted(path.parent.name for path in (ROOT / "examples").glob("*/pyproject.toml"))


PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check")


@pytest.fixture(scope="session")
def wheels(tmp_path_factory):
    """Builds the wheels of xplain and all examples; returns their folder."""
    pytest.importorskip("hatchling", reason="pip install 'xplain-hri[test]'")
    folder = tmp_path_factory.mktemp("wheels")
    sources = [ROOT, *(ROOT / "examples" / name for name in EXAMPLES)]
    build = [*PIP, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder)]
    ran(*build, *map(str, sources))
    return folder


@pytest.fixture(scope="session")
def installed(wheels, tmp_path_factory):
    """Installs xplain and all examples from the wheels; returns the folder."""
    site = tmp_path_factory.mktemp("site")
    install(site, *wheels.glob("*.whl"))
    return site


@pytest.fixture
def bare(wheels, tmp_path):
    """Makes an environment with xplain's wheel, numpy, scipy, numba, and nothing else; returns its
    interpreter."""
    venv.create(tmp_path / "bare", with_pip=False, symlinks=True)
    python = tmp_path / "bare" / "bin" / "python"
    site = Path(ran(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    for name in ("numpy", "scipy", "numba", "llvmlite"):  # numba is no numba without llvmlite
        package = distribution(name)
        for top in {file.parts[0] for file in package.files} - {".."}:
            (site / top).symlink_to(package.locate_file(top))
    install(site, *wheels.glob("xplain_hri-*.whl"))
    return python


def install(site, *files):
    """Installs wheels into a folder, without a network."""
    ran(*PIP, "install", "--no-deps", "--no-index", "--target", str(site), *map(str, files))


def ran(*command, **options):
    """Runs a command; returns its output."""
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
    choice = min((tmp_path / "conf").rglob("*.yaml"))
    said = ran(
        *(sys.executable, "-m", "xplain", "--config-dir", "conf", "tracking=none", "traces=2"),
        f"{choice.parent.name}={choice.stem}",
        **where,
    )
    assert "cost" in said
    assert list((tmp_path / "outputs" / "runs").rglob("results.json"))


@pytest.mark.slow
def test_the_wheel_carries_what_the_commands_need(installed, tmp_path):
    shipped = {path.name for path in (installed / "xplain" / "conf").rglob("*.yaml")}
    assert shipped == {
        path.name for of in ("conf", "sweeps") for path in (ROOT / of).rglob("*.yaml")
    }
    for page in (ROOT / "xplain").rglob("*.html"):
        assert (installed / page.relative_to(ROOT)).exists()
    assert (installed / "xplain" / "py.typed").exists()
    where = elsewhere(installed, tmp_path)
    assert "lambda: 1.0" in ran(sys.executable, "-m", "xplain", "--cfg", "job", **where)
    said = ran(
        *(sys.executable, "-m", "xplain", "sweeps=smoke", "traces=1", "certify.traces=0"),
        "hydra.sweeper.settings=null",
        **where,
    )
    assert "QHR" in said


SMOKE = ("sweeps=smoke", "traces=1", "hydra.sweeper.settings=null", "tracking=none")


def test_a_prepared_sweep_is_found_in_the_repository_and_from_another_folder(tmp_path):
    words = (*SMOKE, "dry_run=true", f"outputs={tmp_path}")
    here, elsewhere = (forked.captured(folder, *words).stdout for folder in (ROOT, tmp_path))
    assert here == elsewhere
    assert "λ=0.5" in here
    assert {path.name for path in (ROOT / "sweeps").iterdir()} >= {"smoke.yaml", "table1.yaml"}


@pytest.mark.slow
def test_a_prepared_sweep_runs_from_a_wheel_in_an_empty_environment(wheels, tmp_path):
    """Its dependencies are those of this environment, whose own xplain it does not see."""
    venv.create(tmp_path / "empty", with_pip=False, symlinks=True)
    python = tmp_path / "empty" / "bin" / "python"
    paths = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(ran(python, "-c", paths).strip())
    (site / "dependencies.pth").write_text(ran(sys.executable, "-c", paths))
    install(site, *wheels.glob("xplain_hri-*.whl"))
    where = elsewhere("", tmp_path)
    found = ran(python, "-c", "import xplain; print(xplain.__file__)", **where)
    assert Path(found.strip()).is_relative_to(site)
    ran(python, "-m", "xplain", *SMOKE, **where)
    (results,) = tmp_path.glob("outputs/sweeps/smoke-*/report/regret.csv")
    assert "qhr" in results.read_text()
    words = ("-m", "xplain", "sweeps=table1_paper", "dry_run=true")
    assert "rescue qmdp" in ran(python, *words, **where)


@pytest.mark.slow
def test_the_explainer_needs_numpy_scipy_and_numba_alone(bare, tmp_path):
    page = (ROOT / "docs" / "explainer.md").read_text(encoding="utf-8")
    program, said = (
        re.search(rf"^```{kind}\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)[1]
        for kind in ("python", "text")
    )
    assert "from xplain import Explainer, GivenTypes" in program
    where = elsewhere("", tmp_path)
    assert ran(bare, "-c", program, **where) == said
    others = "from importlib.util import find_spec; print(*map(find_spec, {}))"
    absent = ["hydra", "omegaconf", "pandas", "sklearn", "mlflow", "pytest"]
    assert set(ran(bare, "-c", others.format(absent), **where).split()) == {"None"}


@pytest.mark.slow
def test_a_questionnaire_needs_the_wheel_alone(bare, tmp_path):
    """A questionnaire about an own table asks, receives answers, and continues from its text, in an
    empty folder with numpy, scipy and numba."""
    program = """
from xplain import Hypotheses, Questionnaire

wrong = 0b101
facts = Hypotheses.of([[held >> j & 1 ^ 1 for j in range(3)] for held in range(8)])
q = Questionnaire(facts, error=0.05)
while not q.done:
    transition, told = q.next()
    q.answer(wrong >> transition & ~told >> transition & 1 ^ 1)
    q = Questionnaire.from_json(q.to_json(), facts)
print(q.best, q.none < 0.05, abs(q.posterior.sum() + q.none - 1) < 1e-9)
"""
    where = elsewhere("", tmp_path)
    assert ran(bare, "-c", program, **where).split() == ["5", "True", "True"]
