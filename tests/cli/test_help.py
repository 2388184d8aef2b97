"""The help texts of the command line, and its choices with their options."""

import inspect
import os
import re
import subprocess
import sys
from importlib.metadata import version

import pytest
from hydra.utils import instantiate

from tests.configurations import composed
from tests.conftest import ROOT
from xplain.cli.commands import COMMANDS
from xplain.cli.main import main
from xplain.experiment.config import CONF

HEAVY = ("mlflow", "sklearn", "kneed", "numba", "scipy", "pandas", "matplotlib")


def python(code, folder):
    """Runs code in a new process in this folder."""
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_help_imports_nothing_heavy_and_lists_the_choices(tmp_path):
    code = (
        "import sys, runpy\n"
        "sys.argv = ['xplain', '--help']\n"
        "try:\n    runpy.run_module('xplain', run_name='__main__', alter_sys=True)\n"
        f"finally:\n    print('HEAVY', sorted(set({HEAVY!r}) & set(sys.modules)))\n"
    )
    done = python(code, tmp_path)
    assert done.returncode == 0, done.stderr
    assert "HEAVY []" in done.stdout
    for word in ("solver=pomcp", "rescue", "discover", "--cfg job"):
        assert word in done.stdout


def choices():
    """Lists (group, choice) of every component's config file that ships."""
    groups = ("domain", "users", "observers", "queries", "labeler", "clusterer", "solver", "belief")
    files = [(group, path) for group in groups for path in sorted((CONF / group).glob("*.yaml"))]
    return [(group, path.stem) for group, path in files]


NO_OPTION = {
    "name": "of a domain: the task is what it is called",
    "knows": "of a solver: which problem it is made for; the oracle's file does say it",
    "hypotheses": "of labeler=hypotheses: the observers' domain's, worked out once",
    "answers": "of labeler=hypotheses: how people err, learned with the types",
    "types": "of labeler=hypotheses: which types the answers come from, known with these",
    "evidence": "of labeler=hypotheses: how well hypotheses foretell answers, learned with them",
    "labeler": "of clusterer=…: what the group labeler chooses",
}
"""Parameters of shipped components that a file of conf/ may leave out, and why."""

UNUSED = {"hypotheses": {"confidence"}}
"""Inherited parameters without effect, by choice: hypotheses have their own confidence."""


@pytest.mark.parametrize(("group", "choice"), choices())
def test_a_choice_lists_every_option_and_the_component_takes_it(group, choice):
    if choice in ("gym", "taxi", "cliff_walking", "frozen_lake"):
        pytest.importorskip("gymnasium", reason="pip install 'xplain-hri[gym]'")
    tasks = "pkg://xplain/domains/pddl/tasks/blocks"
    filled = {
        "file": [f"observers.path={__file__}"],
        "explicit": ["users.groups={A: [fire]}"],
        "gym": [
            *("domain.name=lake", "domain.id=FrozenLake-v1", "domain.states={row: 4, column: 4}"),
            "domain.actions=[left, down, right, up]",
            "domain.parameters={ice: {inaccurate: [{add: -1.0}], message: no ice}}",
        ],
        "pddl": [
            f"domain.file={tasks}/domain.pddl",
            f"domain.problem={tasks}/problem.pddl",
            f"domain.believed={tasks}/believed.pddl",
        ],
    }
    chosen = composed(f"{group}={choice}", *filled.get(choice, []))[group]
    options = {key: chosen[key] for key in chosen if not key.startswith("_")}
    component = instantiate(chosen)
    left_out = inspect.signature(type(component)).parameters.keys() - options.keys()
    assert left_out <= NO_OPTION.keys() | UNUSED.get(choice, set())
    for key, value in options.items():
        # None leaves the value to the component; a domain's ``starts`` are states made of it.
        plain = isinstance(value, bool | int | float | str) and key != "starts"
        if plain and hasattr(component, key):
            assert getattr(component, key) == value, key


def test_help_fits_a_screen_and_names_every_command(capsys):
    main(["--help"])
    out = capsys.readouterr().out
    assert len(out.splitlines()) <= 24
    assert max(map(len, out.splitlines())) <= 100
    lines = [line.split() for line in out.replace(",", "").splitlines()]
    for name in COMMANDS:
        group, _, own = name.rpartition(" ")
        assert any(line[:1] == [group or own] and own in line for line in lines), name


def test_the_help_of_a_command_tells_of_those_below_it(capsys):
    main(["study", "--help"])
    out = capsys.readouterr().out
    for name, command in COMMANDS.items():
        shown = re.search(rf"^  {name} +{re.escape(command.meaning)}$", out, re.MULTILINE)
        assert bool(shown) == name.startswith("study "), name


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_of_its_own(name, capsys):
    main([*name.split(), "--help"])
    out = capsys.readouterr().out
    assert f"xplain {name}" in out
    assert "JSON" in out or name not in ("discover", "observe")
    if COMMANDS[name].config:
        assert (CONF / f"{COMMANDS[name].config}.yaml").read_text() in out


def test_the_version_is_ours(capsys):
    main(["--version"])
    assert capsys.readouterr().out == f"xplain {version('xplain-hri')}\n"


def test_other_programs_of_hydra_import_nothing_of_ours(tmp_path):
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "config.yaml").write_text("a: 1\n")
    code = (
        "import sys, hydra\n"
        f"@hydra.main(version_base='1.3', config_path={str(tmp_path / 'conf')!r},"
        " config_name='config')\n"
        "def job(cfg):\n"
        "    assert not [n for n in sys.modules if n.startswith('xplain')]\n"
        "    print('clean', cfg.a)\n"
        "job()\n"
    )
    done = python(code, tmp_path)
    assert done.stdout == "clean 1\n", done.stderr
