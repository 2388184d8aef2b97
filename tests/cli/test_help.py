"""The help texts of the command line, and its choices with their options."""

import os
import re
import subprocess
import sys
from importlib.metadata import version

import pytest

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
