"""A fingerprint changes exactly if something may change a number."""

import importlib
import py_compile
import sys
from importlib import metadata
from types import SimpleNamespace

import pytest

from tests.configurations import CHOICES, composed, dotted, each_changed
from xplain.experiment import fingerprint as fingerprints
from xplain.experiment.cache import source_fingerprint
from xplain.experiment.fingerprint import (
    NOT_IN_NUMBERS,
    clear_caches,
    component_code,
    configuration,
    fingerprint,
    require_as_loaded,
)


def installed_in(folder):
    """Returns ``{top-level name: distributions}`` of the folder alone, because a list of all
    libraries takes long."""
    found = {}
    for one in metadata.distributions(path=[str(folder)]):
        for name in (one.read_text("top_level.txt") or "").split():
            found.setdefault(name, []).append(one.metadata["Name"])
    return found


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """Writes another author's package, which imports a module beside it."""
    (tmp_path / "their_solver").mkdir()
    (tmp_path / "their_solver" / "__init__.py").write_text("from .best import Best\n")
    (tmp_path / "their_solver" / "best.py").write_text("import their_helper\nclass Best: ...\n")
    (tmp_path / "their_helper.py").write_text("ANSWER = 42\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(metadata, "packages_distributions", lambda: installed_in(tmp_path))
    clear_caches()
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("their_")]:
        del sys.modules[name]
    clear_caches()


CONFIG = {"solver": {"_target_": "their_solver.best.Best"}, "lambda": 1.0}


def fresh(config):
    """Returns the fingerprint of a new process."""
    clear_caches()
    return fingerprint(config)


def assert_counts(config, file, *contents):
    """Checks that each content of a file gives another fingerprint in a new process."""
    found = set()
    for content in contents:
        file.write_text(content)
        found.add(fresh(config))
    assert len(found) == len(contents)


NO_NUMBER = {
    "hydra": "where and how jobs run; only what a sweep is planned with has it",
    "outputs": "where files are written",
    "tracking": "where results go besides the disk",
    "dry_run": "lists jobs and runs none",
    "resume": "which jobs of a sweep run again, not what they give",
}
"""Top-level keys of a run that change no number, with reasons. All other keys must count."""


NOT_OF_THE_SOURCE = {
    "lambda": "a price, met when explaining",
    "message_cost": "a price",
    "inexplicability_cost": "a price",
    "discount": "of plans; the task's own is the domain's",
    "discount_per": "of plans",
    "prior": "of plans; the observers' shares are kept beside the cases",
    "solver": "explains what is there",
    "belief": "of the explanation",
    "explainee": "who it is explained to",
    "ask.cost": "a price",
    "ask.most": "of the explanation",
    "ask.when": "of the explanation",
    "certify": "judges the explanation",
    "points": "reaches the data through observers.points alone",
    "outputs": "where files are written",
    "tracking": "where results go besides the disk",
    "resume": "which jobs of a sweep run again",
    "dry_run": "which jobs a sweep would run",
}
"""Keys that data, types and traces do not depend on, and why. All others must count."""


def both(cfg):
    """Returns the fingerprint of a run, and that of its data, types and traces."""
    config = configuration(cfg)
    return fingerprint(config), source_fingerprint(config)


@pytest.mark.parametrize("choices", CHOICES, ids=" ".join)
def test_every_key_counts_but_those_without_a_number(choices):
    cfg = composed(*choices)
    (run, source), paths = both(cfg), []
    for path in each_changed(cfg):
        paths.append(path)
        run_now, source_now = both(cfg)
        assert (run_now != run) == (path[0] not in NO_NUMBER), dotted(path)
        # Simulated observers answer as many questions as ``points`` says.
        asked = path == ("points",) and "observers=file" not in choices
        apart = {path[0], ".".join(map(str, path[:2]))} & NOT_OF_THE_SOURCE.keys()
        assert (source_now != source) == (asked or not apart), dotted(path)
    assert {path[0] for path in paths} == set(cfg)
    assert set(NOT_IN_NUMBERS) == NO_NUMBER.keys() <= {*cfg, "hydra"}  # no dead one
    assert both(cfg) == (run, source)  # all was put back
    assert fingerprint(configuration(cfg) | {"new": 1}) != run


def test_values_count_and_order_does_not():
    assert fingerprint({"a": 1, "b": [1, 2]}) == fingerprint({"b": [1, 2], "a": 1})
    assert fingerprint({"a": [1, 2]}) != fingerprint({"a": [2, 1]})


def keep(compiled):
    compiled.parent.mkdir(exist_ok=True)
    compiled.write_bytes(b"compiled")


EDITS = {
    "the module": lambda at: (at / "their_solver/best.py").write_text("import their_helper\n"),
    "its package": lambda at: (at / "their_solver/__init__.py").write_text("# edited"),
    "what it imports": lambda at: (at / "their_helper.py").write_text("ANSWER = 43"),
    "a file beside it": lambda at: (at / "their_solver/map.txt").write_text("#..#"),
    "none": lambda at: None,
    "what Python keeps": lambda at: keep(at / "their_solver/__pycache__/best.cpython-399.pyc"),
    "a file elsewhere": lambda at: (at / "notes.txt").write_text("of the tests, say"),
    "its name": lambda at: (at / "their_solver/best.py").rename(at / "their_solver/better.py"),
}


def test_code_plugged_in_counts_with_its_data_and_all_that_it_imports(plugin):
    seen = [fresh(CONFIG)]
    assert set(component_code(CONFIG)) == {"their_solver", "their_helper"}
    for name, edit in EDITS.items():
        edit(plugin)
        counts = name not in ("none", "what Python keeps", "a file elsewhere")
        assert (fresh(CONFIG) not in seen) == counts, name
        seen.append(fresh(CONFIG))


def test_an_installed_plugin_counts_by_the_hashes_of_its_files(plugin):
    installed = plugin / "their_solver-1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: their-solver\nVersion: 1.0\n")
    (installed / "top_level.txt").write_text("their_solver\n")
    records = [f"their_solver/__init__.py,sha256={own},23\n" for own in ("aaa", "bbb")]
    assert_counts(CONFIG, installed / "RECORD", *records)
    assert component_code(CONFIG).keys() == {"their_solver"}


def test_the_script_that_runs_counts_by_its_source(tmp_path, monkeypatch):
    script, config = tmp_path / "script.py", {"solver": {"_target_": "__main__.Mine"}}
    monkeypatch.setitem(sys.modules, "__main__", SimpleNamespace(__file__=str(script)))
    assert_counts(config, script, "class Mine: ...\n", "class Mine: ...\n# edited\n")


def test_plugged_in_code_is_not_run(plugin):
    (plugin / "their_solver" / "__init__.py").write_text("raise SystemExit('ran')\n")
    assert set(component_code(CONFIG)) == {"their_solver", "their_helper"}
    assert "their_solver" not in sys.modules


def test_what_a_package_imports_of_its_own_is_no_other_package(plugin):
    own = "from .filelock import app\nfrom ..filelock import app\nfrom . import filelock\n"
    for code, counts in ((own, False), ("from filelock import app\n", True)):
        (plugin / "their_solver" / "best.py").write_text(code)
        clear_caches()
        assert ("filelock" in component_code(CONFIG)) == counts


def test_what_a_component_declares_counts(plugin):
    """Examples are a file beside the code that no key names, a server's version, a licence."""
    weights = plugin / "weights.bin"
    (plugin / "their_helper.py").write_text(
        "from pathlib import Path\n"
        "class Model:\n"
        "    def __init__(self, version=1): self.version = version\n"
        "    def depends_on(self):\n"
        f"        return {{'weights': Path({str(weights)!r}), 'version': self.version}}\n"
    )
    config = {"labeler": {"_target_": "their_helper.Model", "version": 1}, "lambda": 1.0}
    weights.write_text("1")
    before = fingerprint(config)
    assert fingerprint(config) == before
    weights.write_text("2")
    assert fingerprint(config) != before
    config["labeler"]["_target_"] = "their_helper.Absent"  # the experiment says what is wrong
    assert fingerprint(config) != before


NAMED = {
    "a class at any depth": {"models": [{"inner": {"_target_": "their_helper.Model"}}]},
    "as Gymnasium names code": {"id": "their_helper:Maze-v0"},
}


@pytest.mark.parametrize("how", NAMED)
def test_code_counts_wherever_it_is_named(plugin, how):
    config = {"domain": NAMED[how]}
    assert_counts(config, plugin / "their_helper.py", "ANSWER = 42\n", "ANSWER = 43\n")
    assert set(component_code(config)) == {"their_helper"}


def test_our_own_code_and_libraries_are_covered_elsewhere():
    for target in ("xplain.solvers.greedy.QMDP", "sklearn.tree.X", "collections.OrderedDict"):
        assert component_code({"_target_": target}) == {}
    assert component_code({"facts": {"text": "Say: yes", "url": "http://a.b/c"}}) == {}
    assert set(component_code({"_target_": "hydra.utils.get_class"})) == {"hydra"}
    brought = {name: of for name, of in metadata.packages_distributions().items() if name.isalpha()}
    for library in fingerprints.LIBRARIES:  # their versions count
        names = [name for name, distributions in brought.items() if library in distributions]
        assert names or library in ("gymnasium", "fast-downward.translate")  # of extras
        assert component_code([{"_target_": f"{name}.anything"} for name in names]) == {}


def test_the_content_of_files_counts(tmp_path, monkeypatch):
    """These are files that a path names, and files inside a package."""
    (tmp_path / "some_tasks" / "inner").mkdir(parents=True)
    (tmp_path / "some_tasks" / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    task = tmp_path / "some_tasks" / "inner" / "task.pddl"
    for named in (str(task), "pkg://some_tasks/inner/task.pddl"):
        cfg, found = composed("observers=file", f"observers.path='{named}'"), []
        for content in "121":
            task.write_text(content)
            found.append(both(cfg))
        assert found[0] == found[2]
        assert not {*found[0]} & {*found[1]}
    for absent in ("nowhere", "no.where", "no-where", ""):  # whoever reads it will say so
        assert fingerprint({"domain": {"file": f"pkg://{absent}/task.pddl"}})


def test_the_versions_of_libraries_that_run_count(monkeypatch):
    versions, before = fingerprints.library_versions(), fingerprint({})
    for name in ("numpy", "scipy", "numba", "pandas", "scikit-learn"):
        module = importlib.import_module({"scikit-learn": "sklearn"}.get(name, name))
        assert versions[name] == module.__version__
    assert versions["python"] == f"{sys.version_info.major}.{sys.version_info.minor}"
    monkeypatch.setattr(fingerprints, "library_versions", lambda: {"numpy": "0.1"})
    assert fingerprint({}) != before


def test_every_source_of_the_package_counts_by_content_and_place(tmp_path, monkeypatch):
    package = tmp_path / "xplain"
    (package / "experiment").mkdir(parents=True)
    monkeypatch.setattr(fingerprints, "__file__", str(package / "experiment" / "fingerprint.py"))
    edits = [
        lambda: (package / "a.py").write_text("1\n"),
        lambda: (package / "a.py").write_text("2\n"),
        lambda: (package / "a.py").rename(package / "b.py"),
        lambda: (package / "experiment" / "c.py").write_text("3\n"),
    ]
    seen = []
    for edit in edits:
        edit()
        seen.append(fresh({}))
    assert len(set(seen)) == 4
    (tmp_path / "beside.py").write_text("of the tests, say\n")
    assert fresh({}) == seen[-1]
    clear_caches()


def test_what_git_cannot_tell_is_left_out(tmp_path, monkeypatch):
    """Git does not accept the checkout: it is broken, or belongs to another user."""
    monkeypatch.setattr(fingerprints, "__file__", str(tmp_path / "xplain" / "experiment" / "f.py"))
    assert fingerprints.git_state.__wrapped__() == {}
    (tmp_path / ".git").write_text("gitdir: nowhere")
    assert fingerprints.git_state.__wrapped__() == {}


def test_a_compiled_file_that_was_not_loaded_refuses_nothing(plugin, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    source = plugin / "older_solver.py"
    source.write_text("class Mine: ...\n")
    py_compile.compile(str(source))
    source.write_text("class Mine:\n    newer = True\n")
    importlib.invalidate_caches()
    assert importlib.import_module(source.stem).Mine.newer
    require_as_loaded({"solver": {"_target_": f"{source.stem}.Mine"}})
