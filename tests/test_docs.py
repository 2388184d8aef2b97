"""The docs show what really happens."""

import importlib.util
import os
import pkgutil
import re
import shlex
import subprocess
import sys
import tomllib
from contextlib import suppress
from importlib.util import find_spec

import pytest

from tests import configurations
from tests.conftest import ROOT
from tests.people.server_process import free_port
from xplain.cli.main import COMMANDS
from xplain.experiment.config import require_usable


def module(name):
    """Loads a script of docs/, which is no package."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[name] = loaded
    spec.loader.exec_module(loaded)
    return loaded


run, config_reference = module("run"), module("config_reference")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SHOWING = [page for page in PAGES if run.blocks_of(page.read_text(encoding="utf-8"))]
TEXTS = [
    *PAGES,
    *(ROOT / name for name in ("benchmarks/README.md", "Makefile", "pyproject.toml")),
    *(
        file
        for folder in ("xplain", "conf", "examples", "benchmarks", "docs")
        for ending in ("py", "yaml", "html", "js")
        for file in sorted((ROOT / folder).rglob(f"*.{ending}"))
    ),
]
ELSEWHERE = ("xplain/conf", "xplain/kernels")
"""Folders in a wheel, and below the user's cache folder."""
WITH_KEYS = {command.config for command in COMMANDS.values() if command.config}
OURS = (
    *(f"{name}.yaml" for name in ("config", *sorted(WITH_KEYS))),
    "observers",
    "queries",
    "labeler",
    "clusterer",
    "solver",
    "belief",
    "tracking",
)


def test_the_readme_s_commands_do_what_is_shown_with_smaller_runs(tmp_path):
    """Digits are not compared."""
    text, ours = PAGES[0].read_text(encoding="utf-8"), "solver=pomcp "
    assert ours in text
    smaller = f"{ours}solver.simulations=500 traces=4 tracking=none "
    run.ran(text.replace(ours, smaller), tmp_path, compare=True)


@pytest.mark.slow
@pytest.mark.parametrize("page", SHOWING, ids=lambda page: page.name)
def test_every_command_and_program_does_what_is_shown(page, tmp_path):
    run.ran(page.read_text(encoding="utf-8"), tmp_path, compare=True)


def test_files_are_shown_as_they_are():
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert text == run.with_files(text), f"python docs/run.py --write {page.name}"


def composed():
    """Lists commands of `sh` blocks: they take too long for a test, or need a cluster."""
    for page in PAGES:
        for fence in run.FENCE.finditer(page.read_text(encoding="utf-8")):
            if fence[1] == "sh":
                for line in fence[2].replace("\\\n", " ").splitlines():
                    words = shlex.split(line, comments=True)
                    if words[:3] == ["python", "-m", "xplain"]:
                        yield page.name, [one_of(word) for word in words[3:] if word != "-m"]


def one_of(word):
    """Returns `key=value` of the first job of a sweep."""
    key, _, value = word.partition("=")
    if value.startswith("range("):
        value = "0"
    return f"{key}={value if value[:1] in '[{' else value.split(',')[0]}"


@pytest.mark.parametrize(("page", "words"), composed())
def test_commands_that_are_not_run_are_configurations_all_the_same(page, words):
    for launcher in ("ray", "submitit"):
        if any(launcher in word for word in words) and not find_spec(
            f"hydra_plugins.hydra_{launcher}_launcher"
        ):
            pytest.skip(f"pip install 'xplain-hri[{launcher}]'")
    require_usable(configurations.composed(*words))


def test_no_command_hides_in_a_block_that_no_test_reads():
    """Commands are in `console` blocks (which are run) or `sh` blocks (which are composed)."""
    for page in PAGES:
        if page.name not in ("study.md", "collect.md"):  # they have tests of their own
            for fence in run.FENCE.finditer(page.read_text(encoding="utf-8")):
                if fence[1] not in ("console", "sh", "python", "yaml"):
                    assert "python -m xplain" not in fence[2], f"{page.name}: {fence[2][:60]}"


def test_the_reference_of_all_keys_is_up_to_date():
    assert {*config_reference.COMMANDS, "study"} == WITH_KEYS
    assert (ROOT / "docs" / "config.md").read_text(encoding="utf-8") == config_reference.page()


def test_every_key_says_what_it_means():
    silent = []
    for place in OURS:
        files = [ROOT / "conf" / place] if "." in place else (ROOT / "conf" / place).glob("*.yaml")
        for file in files:
            lines = file.read_text(encoding="utf-8").splitlines()
            silent += [
                f"{file.name}: {key.path}"
                for key in config_reference.keys(lines, "")
                if not key.meaning
            ]
    assert silent == []


def test_links_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            if not re.match(r"https?:", target):
                assert (page.parent / target).exists(), f"{page.name} → {target}"


def named(pattern):
    """Yields ``(file, name)`` of the pattern's matches in the repository's own texts."""
    for file in TEXTS:
        for name in sorted(set(re.findall(pattern, file.read_text(encoding="utf-8")))):
            yield file.relative_to(ROOT), name


def resolves(name):
    """Returns True if a dotted name is a module, or something in a module; fields of a class
    count."""
    owner, _, last = name.rpartition(".")
    for found in (lambda: pkgutil.resolve_name(name), lambda: annotations(owner)[last]):
        with suppress(ImportError, AttributeError, KeyError):
            found()
            return True
    return False


def annotations(name):
    return pkgutil.resolve_name(name).__annotations__


def test_files_that_are_named_exist():
    folders = "xplain|conf|examples|benchmarks|tests|docs"
    paths = rf"(?<![\w./-])((?:{folders})/[\w./-]*\w)"
    missing = [
        f"{file}: {path}"
        for file, path in named(paths)
        if not (ROOT / path).exists() and path not in ELSEWHERE
    ]
    assert missing == []


def test_modules_classes_and_targets_that_are_named_exist():
    missing = [
        f"{file}: {name}"
        for file, name in named(r"(?<![\w.\"'/-])(xplain(?:\.\w+)+)")
        if name not in ("xplain.log", "xplain.sweep") and not resolves(name)
    ]
    assert missing == []


def test_sections_of_the_method_that_are_named_exist():
    sections = set(
        re.findall(r"^## (\d+)\.", (ROOT / "docs" / "method.md").read_text(encoding="utf-8"), re.M)
    )
    found = list(named(r"docs/method\.md,\s+sections?\s+(\d+(?: and \d+)?)"))
    missing = [f"{file}: {n}" for file, n in found if not set(n.split(" and ")) <= sections]
    assert found
    assert missing == []
    assert list(named(r"SPEC §")) == []  # a page that is not in the repository


def test_every_command_goes_through_the_one_door():
    gone = [f"{file}: {name}" for file, name in named(r"python -m xplain\.\w+")]
    words = named(r"(?<![\w/])python -m xplain ([a-z]\w*)(?![\w/=.])")
    unknown = [f"{file}: {word}" for file, word in words if word not in COMMANDS]
    study = named(r"python -m xplain (study [a-z]+)(?![\w/=.])")
    unknown += [f"{file}: {words}" for file, words in study if words not in COMMANDS]
    assert gone + unknown == []


def test_no_command_fetches_another_project_of_this_name():
    """``xplain`` on the package index is not ours; ``xplain-hri`` is."""
    wrong = r"""pip install +(?:-[\w-]+ +)*['"]?xplain(?!-hri)[^\n]*"""
    assert [f"{file}: {command}" for file, command in named(wrong)] == []
    for project in (ROOT / "examples").glob("*/pyproject.toml"):
        wanted = tomllib.loads(project.read_text(encoding="utf-8"))["project"]["dependencies"]
        assert wanted == ["xplain-hri"], project


@pytest.mark.parametrize(
    ("shown", "real", "same"),
    [
        (["cost 1.25 (3 of 4)"], ["cost  17 (9 of 12)"], True),
        (["cost 1.25"], ["price 1.25"], False),
        (["QMDP_805c, QHR_63c5"], ["QMDP_c0a1, QHR_beef"], True),
        (["QMDP_805c"], ["QHR_805c"], False),
        (["a", "...", "z"], ["a", "b", "c", "z"], True),
        (["a", "...", "z"], ["a", "b", "c"], False),
        (["a"], ["a", "b"], False),
        (["...", "b"], ["a", "b"], True),
        ([], ["a"], False),
        (["..."], ["a"], True),
    ],
)
def test_outputs_are_compared_in_words_not_in_figures(shown, real, same):
    assert (run.differs(shown, real) == "") == same


@pytest.mark.parametrize(
    "false",
    [
        "```console\n$ false\n```",
        "```console\n$ echo one\ntwo\n```",
        "```python\nprint(1)\n```\n\n```text\nx\n```",
        "```python\n1 / 0\n```",
    ],
)
def test_a_false_command_or_output_is_found(tmp_path, false):
    with pytest.raises(run.DocsError):
        run.ran(false + "\n", tmp_path, compare=True)


def test_a_false_output_is_written_anew(tmp_path):
    text = "```console\n$ echo one\ntwo\n```\n"
    rewritten = run.rewritten(text, run.ran(text, tmp_path, compare=False))
    assert rewritten == "```console\n$ echo one\none\n```\n"


@pytest.mark.slow
def test_the_study_runs_as_its_page_says(tmp_path):
    """Every command of docs/study.md runs in its order, with smaller settings, except `make` and a
    real browser."""
    text = (ROOT / "docs" / "study.md").read_text(encoding="utf-8")
    lines = [line.strip().split("   ")[0] for line in text.splitlines()]
    start, *others = [line for line in lines if line.startswith("python -m xplain")]
    others = [line for line in others if "--chromium" not in line]
    assert start.startswith("python -m xplain study ")
    port = str(free_port())
    words = start.replace("8080", port).split()[1:]
    env = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    where = {"cwd": tmp_path, "env": env, "text": True}
    server = subprocess.Popen(
        [sys.executable, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **where
    )
    try:
        said = ""
        while "plan " not in said:  # the last line of a start
            line = server.stdout.readline()
            assert line, said
            said += line
        key = re.search(r"key (\w+)", said).group(1)
        for command in others:
            if "bots" in command:
                command = command.replace("--count 40", "--count 20")
                command += f" --url http://127.0.0.1:{port}"
            elif server.poll() is None:  # the commands after the dry run want no server
                server.terminate()
                server.wait(60)
            if "analyse" in command:
                command += " --stream bot"
            words = command.replace("6f6c…", key).split()[1:]
            done = subprocess.run([sys.executable, *words], capture_output=True, **where)
            assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    finally:
        if server.poll() is None:
            server.terminate()
        server.wait(60)
        server.stdout.close()


@pytest.mark.slow
def test_a_lab_goes_the_whole_way_of_its_page(tmp_path):
    """The blocks of docs/collect.md run as one script, in an empty folder."""
    text = (ROOT / "docs" / "collect.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 1200
    port = str(free_port())
    script = "\n".join(re.findall(r"^```bash\n(.*?)^```$", text, re.MULTILINE | re.DOTALL))
    script = script.replace("8080", port).replace("bots ", f"bots --url http://127.0.0.1:{port} ")
    path = f"{os.path.dirname(sys.executable)}:{os.environ['PATH']}"
    env = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "-ec", script],
        cwd=tmp_path,
        env=env,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=900,
    )
    assert done.returncode == 0, done.stdout
    assert re.search(r"^say \(.*\) and show \d+$", done.stdout, re.MULTILINE)  # the robot
    assert [*(tmp_path / "study").rglob("table2.csv")]
