"""The command as a person meets it: help, one-line errors, nothing half-written."""

from __future__ import annotations

import errno
import inspect
import os
import re
import subprocess
import sys
from importlib.metadata import version

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import instantiate

from tests.configurations import composed
from tests.conftest import ROOT
from xplain.cli.commands import COMMANDS
from xplain.cli.completion import completions
from xplain.cli.main import main
from xplain.experiment.config import CONF, report_errors
from xplain.report import stages

HEAVY = ("mlflow", "sklearn", "kneed", "numba", "scipy", "pandas", "matplotlib")


@pytest.fixture
def xplain(tmp_path, monkeypatch, capsys):
    """``xplain("lambda=2")`` runs the command in this process, in an empty folder; returns
    (exit code, standard output, standard error)."""

    def run(*arguments: str):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(stages, "EVERY", 600.0)  # a slow machine's stages say nothing here
        own = () if arguments[0] in COMMANDS else (f"outputs={tmp_path / 'outputs'}",)
        monkeypatch.setattr(sys, "argv", ["xplain", *own, *arguments])
        GlobalHydra.instance().clear()
        code = 0
        try:
            main()
        except SystemExit as error:
            code = error.code if isinstance(error.code, int) else 1
        out = capsys.readouterr()
        return code, out.out, out.err

    return run


def test_help_imports_nothing_heavy_and_lists_the_choices(tmp_path):
    code = (
        "import sys, runpy\n"
        "sys.argv = ['xplain', '--help']\n"
        "try:\n    runpy.run_module('xplain', run_name='__main__', alter_sys=True)\n"
        f"finally:\n    print('HEAVY', sorted(set({HEAVY!r}) & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert "HEAVY []" in done.stdout
    for word in ("solver=pomcp", "rescue", "discover", "--keys"):
        assert word in done.stdout


def test_the_list_of_keys_names_choices_and_keys(capsys):
    GlobalHydra.instance().clear()
    with pytest.raises(SystemExit, match="0"):  # so Hydra ends its help
        main(["--keys"])
    out = capsys.readouterr().out
    for word in ("qmdp", "pomcp", "rescue", "four_rooms", "lambda: 1.0", "table1"):
        assert word in out


RAGGED = "domain.map='S..V\n...'"

SIX = ("first_aid", "fire", "refuel", "rubble", "puddle", "fence")
BAD = [
    (["solver=nonsense"], ["solver", "nonsense", "qmdp"]),
    (["lamda=2"], ["lamda", "lambda"]),
    (["solver.memory=5"], ["solver.memory"]),
    (["lambda=-1"], ["lambda", "-1", "≥ 0"]),
    (["lambda=nan"], ["lambda", "nan"]),
    (["lambda=much"], ["lambda", "much"]),
    (["discount=0"], ["discount", "0", "(0, 1]"]),
    (["discount=1.01"], ["discount", "1.01", "(0, 1]"]),
    (["discount_per=week"], ["discount_per", "week", "action"]),
    (["prior=mine"], ["prior", "mine", "uniform"]),
    (["traces=0"], ["traces", "0"]),
    (["seed=-3"], ["seed", "-3"]),
    (["message_cost=-1"], ["message_cost", "-1"]),
    (["message_cost=much"], ["message_cost", "much"]),
    (["message_cost={fire: 2}"], ["message_cost", "fire", "fence missing"]),
    (["message_cost={lava: 2}"], ["message_cost", "lava", "first_aid"]),
    ([f"message_cost={{{', '.join(f'{m}: -2' for m in SIX)}}}"], ["message_cost.first_aid", "-2"]),
    (["inexplicability_cost=-2"], ["inexplicability_cost", "-2"]),
    ([RAGGED], ["domain.map"]),
    (["domain.map='SVSAFUrpfs'"], ["domain.map", "shelter"]),
    (["domain.map='SV?'"], ["domain.map", "?"]),
    (["domain.map='SVAFUrpf#s'"], ["domain.map", "path"]),
    (["domain.discount=1"], ["domain.discount", "1"]),
    (["observers.points=1", "queries=shared"], ["points: too few", "two"]),
    (["observers.queries=shared"], ["observers.queries", "queries=shared"]),
    (["observers.trace_length=4"], ["queries.trace_length"]),
    (["observers.message_probability=0.3"], ["queries.message_probability"]),
    (["solver=true"], ["solver", "true", "qmdp"]),
    (["observers=file", "observers.path=absent.csv"], ["absent.csv"]),
    (["resume=maybe"], ["resume", "maybe", "missing, failed, none"]),
    (["sweeps=tabel1"], ["sweeps=tabel1", "did you mean table1?", "type_counts"]),
]


@pytest.mark.parametrize(("arguments", "words"), BAD, ids=[" ".join(b[0])[:40] for b in BAD])
def test_bad_input_is_one_line_and_leaves_nothing_behind(xplain, tmp_path, arguments, words):
    code, out, err = xplain(*arguments)
    assert code == 2
    assert out == ""
    lines = err.strip().splitlines()
    assert len(lines) == 1, err
    for word in words:
        assert word in lines[0]
    assert_nothing_written(tmp_path)


def assert_nothing_written(folder):
    """No file, but for locks: they hold nothing, and to remove one would race."""
    assert not [path for path in folder.rglob("*") if path.is_file() and path.suffix != ".lock"]


def test_a_misspelt_key_lists_every_key_that_there_is(xplain):
    _, _, err = xplain("lamda=2")
    assert "did you mean lambda?" in err
    listed = {word.strip() for word in err.partition("allowed:")[2].split(",")}
    assert listed == set(composed()) | {"sweeps"}


def test_a_key_of_another_choice_says_which(xplain):
    _, _, err = xplain("domain=rescue", "users.count=3")
    assert (
        err == "xplain: users.count: no such key; it needs users=few_facts or users=random_cover\n"
    )
    _, _, err = xplain("solver=pomcp", "solver.simulation=3")
    assert "did you mean solver.simulations?" in err
    _, _, err = xplain("certify.trace=3")
    assert "did you mean certify.traces?" in err


def test_a_key_within_a_components_key_says_what_there_is_and_how_to_add_one(xplain):
    _, _, err = xplain("domain=blocks", "domain.facts={jam: {change: {action: stack, cost: 2}}}")
    assert err.startswith("xplain: domain.facts.jam: no such key; domain.facts has one_hand, tower")
    assert err.endswith("+domain.facts.jam=… adds this one\n")
    _, _, err = xplain("domain=blocks", "domain.facts.towr.message=Yes")
    assert "did you mean domain.facts.tower?" in err


def test_prices_of_messages_come_all_by_name(xplain):
    _, _, err = xplain("message_cost.fire=2")
    assert err.startswith("xplain: message_cost.fire: no such key; ")
    assert "message_cost={fire: 2, …}" in err


@pytest.mark.parametrize("wrong", ["domain.map='SVAFUrpf#s'", "message_cost={fire: 2}"])
def test_a_sweep_finds_what_a_domain_refuses_before_any_job(xplain, tmp_path, wrong):
    code, _, err = xplain("-m", wrong, "lambda=1,2")
    assert code == 2
    assert wrong.partition("=")[0] in err
    assert_nothing_written(tmp_path)


def test_the_group_of_sweeps_is_near_to_its_misspelling(xplain):
    _, _, err = xplain("sweep=table1")
    assert "did you mean sweeps?" in err


@pytest.mark.parametrize("words", [["--lambda", "1.5"], ["--lambda=1.5"]])
def test_a_key_written_as_a_flag_is_told_how_keys_are_written(xplain, words):
    code, _, err = xplain(*words)
    assert code == 2
    assert err.startswith(f"xplain: {words[0]}: no such flag")
    assert err.rstrip().endswith("without dashes: lambda=1.5")


def test_too_few_points_are_not_called_by_another_number(xplain):
    _, _, err = xplain("points=1", "queries=shared")
    assert err.startswith("xplain: points: too few")
    assert "points=15" not in err


def test_a_file_of_labels_is_called_by_its_key(xplain):
    _, _, err = xplain("observers=file", "observers.path=nowhere.csv")
    assert err == "xplain: observers.path='nowhere.csv': no such file\n"


@pytest.mark.parametrize("overrides", [True, False])
def test_a_domain_file_without_its_package_is_told_the_line(xplain, tmp_path, overrides):
    folder = tmp_path / "mine" / "domain"
    folder.mkdir(parents=True)
    text = (CONF / "domain" / "four_rooms.yaml").read_text().replace("# @package _global_\n", "")
    if not overrides:
        text = text.replace("defaults:\n  - override /users: random_cover\n", "")
    (folder / "my_rooms.yaml").write_text(text)
    code, _, err = xplain(f"--config-dir={tmp_path / 'mine'}", "domain=my_rooms")
    assert code == 2
    assert len(err.splitlines()) == 1
    assert "# @package _global_" in err


@pytest.mark.parametrize("sweep", [(), ("-m", "lambda=1,2")])
def test_malformed_yaml_is_one_line_with_its_place(xplain, tmp_path, sweep):
    folder = tmp_path / "mine" / "solver"
    folder.mkdir(parents=True)
    (folder / "broken.yaml").write_text("depth: [1\nwidth: }\n")
    code, _, err = xplain(f"--config-dir={tmp_path / 'mine'}", *sweep, "solver=broken")
    assert code == 2
    assert err.startswith(f"xplain: {folder / 'broken.yaml'}: line 2: ")
    assert len(err.splitlines()) == 1
    code, _, err = xplain("--config-dir=absent", "solver=broken")
    assert (code, err) == (
        2,
        "xplain: --config-dir='absent': a folder with choices of your own\n",
    )


def test_every_command_knows_choices_of_ones_own(xplain, tmp_path):
    folder = tmp_path / "mine" / "domain"
    folder.mkdir(parents=True)
    (folder / "my_rooms.yaml").write_text((CONF / "domain" / "four_rooms.yaml").read_text())
    for command in ("demo", "questions"):
        for flag in (("--config-dir", str(folder.parent)), (f"-cd={folder.parent}",)):
            code, out, err = xplain(command, *flag, "domain=my_room")
            assert code == 2, out
            assert "did you mean my_rooms?" in err
        code, _, err = xplain(command, "--config-dir", "absent", "domain=my_rooms")
        assert (code, "a folder with choices of your own" in err) == (2, True)


@pytest.mark.parametrize("name", [None, "run/trace.png"])
def test_a_full_disk_is_one_line(name, capsys):
    with pytest.raises(SystemExit), report_errors():
        raise OSError(errno.ENOSPC, "No space left on device", name)
    where = "" if name is None else f"{name}: "
    assert capsys.readouterr().err == f"xplain: {where}No space left on device\n"


def test_an_interruption_that_an_import_made_another_error_of_is_told_as_one(capsys):
    half = ImportError("half of a module")
    half.__cause__ = KeyboardInterrupt()
    with pytest.raises(SystemExit) as ended, report_errors():
        raise half
    assert ended.value.code == 130
    assert capsys.readouterr().err == "xplain: interrupted\n"


HEAD = "observer,messages,label,row,column"
TABLES = {
    "missing column": ("observer,label,row\na,1,0\nb,0,0\n", ["messages"]),
    "unknown message": (f"{HEAD}\na,lava,1,0,0\nb,,0,0,0\n", ["lava"]),
    "label 2": (f"{HEAD}\na,,2,0,0\nb,,0,0,0\n", ["label", "2"]),
    "one observer": (f"{HEAD}\na,,1,0,0\na,fire,0,0,0\n", ["observer"]),
    "labels all equal": (f"{HEAD}\na,,1,0,0\nb,fire,1,0,0\n", ["label"]),
    "no rows": (f"{HEAD}\n", ["labels.csv"]),
    "not a table": ("\x00\x01", ["labels.csv"]),
    "other features": (
        f"{HEAD}\na,,1,0,0\na,,1,0,1\nb,fire,0,0,0\nb,fire,0,0,1\n",
        ["action=up", "missing"],
    ),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_bad_file_of_labels_is_one_line(xplain, tmp_path, name):
    text, words = TABLES[name]
    (tmp_path / "labels.csv").write_text(text)
    code, _, err = xplain("observers=file", "observers.path=labels.csv")
    assert code == 2
    assert len(err.strip().splitlines()) == 1, err
    for word in words:
        assert word in err
    (tmp_path / "labels.csv").unlink()
    assert_nothing_written(tmp_path)


def test_a_type_that_names_an_unknown_parameter_and_no_types(xplain):
    for users, words in [
        ("users.groups={}", ["users", "at least one"]),
        ("users.groups={A: [lava]}", ["lava", "first_aid"]),
    ]:
        code, _, err = xplain("users=explicit", users)
        assert code == 2
        assert len(err.strip().splitlines()) == 1
        for word in words:
            assert word in err


def test_an_output_folder_that_cannot_be_written_is_one_line(tmp_path, xplain):
    (tmp_path / "outputs").write_text("a file, where a folder is wanted")
    code, _, err = xplain("tracking=none")
    assert code == 2
    assert len(err.strip().splitlines()) == 1
    assert "outputs" in err


def choices():
    """(group, choice) of every component's config file that ships."""
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
}
"""Parameters of shipped components that a file of conf/ may leave out, and why."""

UNUSED = {"hypotheses": {"confidence", "refit"}}
"""By choice, inherited parameters that say nothing of the component: its hypotheses say how sure
they are, and are fitted to all labels."""


@pytest.mark.parametrize(("group", "choice"), choices())
def test_a_choice_lists_every_option_and_the_component_takes_it(group, choice):
    if choice in ("taxi", "cliff_walking", "frozen_lake"):
        pytest.importorskip("gymnasium", reason="pip install 'xplain-hri[gym]'")
    tasks = "pkg://xplain/domains/pddl/tasks/blocks"
    filled = {
        "file": [f"observers.path={__file__}"],
        "explicit": ["users.groups={A: [fire]}"],
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
    if COMMANDS[name].config:
        assert (CONF / f"{COMMANDS[name].config}.yaml").read_text() in out


def test_the_version_is_ours(capsys):
    main(["--version"])
    assert capsys.readouterr().out == f"xplain {version('xplain-hri')}\n"


@pytest.mark.parametrize(
    ("line", "among", "not_among"),
    [
        ("xplain dis", {"discover", "discount=", "discount_per="}, {"observe"}),
        ("xplain solver=q", {"solver=qmdp", "solver=qhr"}, {"solver=pomcp"}),
        ("xplain sweeps=table1_", {"sweeps=table1_many"}, {"sweeps=smoke"}),
        ("xplain solver=pomcp solver.simu", {"solver.simulations="}, {"simulations="}),
        ("xplain discover held", {"held_out="}, {"lambda="}),
        ("xplain plan solver=cert", {"solver=certified"}, {"solver=qmdp"}),
        ("xplain study re", {"replay"}, {"report", "bots"}),
        ("xplain study po", {"power", "port=", "points="}, {"bots"}),
        ("xplain report ", set(), {"lambda="}),
    ],
)
def test_completion_knows_commands_keys_and_choices(line, among, not_among):
    GlobalHydra.instance().clear()
    found = {word.partition("=")[0] + "=" if "=" in word and word.count("=") == 1
             and not line.rpartition(" ")[2].count("=") else word
             for word in completions(line)}  # fmt: skip
    assert among <= found
    assert not not_among & found


def test_other_programs_of_hydra_get_none_of_our_plugins(tmp_path):
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "config.yaml").write_text("a: 1\n")
    code = (
        "import sys, hydra\n"
        "from hydra.core.plugins import Plugins\n"
        f"@hydra.main(version_base='1.3', config_path={str(tmp_path / 'conf')!r},"
        " config_name='config')\n"
        "def job(cfg):\n"
        "    assert not [n for n in Plugins.instance().class_name_to_class if 'xplain' in n]\n"
        "    assert not [n for n in sys.modules if n.startswith('xplain')]\n"
        "    print('clean', cfg.a)\n"
        "job()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stdout == "clean 1\n", done.stderr
