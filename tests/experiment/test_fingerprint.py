"""A fingerprint changes with everything that may change a number, and with nothing else."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

import numba
import numpy as np
import pandas as pd
import pytest
import scipy
import sklearn

from tests.configurations import CHOICES, composed, dotted, each_changed
from xplain.experiment import fingerprint as fingerprints
from xplain.experiment.fingerprint import (
    NOT_IN_NUMBERS,
    clear_caches,
    component_code,
    configuration,
    fingerprint,
)


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """A package of someone else's, which imports a module beside it."""
    (tmp_path / "their_solver").mkdir()
    (tmp_path / "their_solver" / "__init__.py").write_text("from .best import Best\n")
    (tmp_path / "their_solver" / "best.py").write_text("import their_helper\nclass Best: ...\n")
    (tmp_path / "their_helper.py").write_text("ANSWER = 42\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    fingerprints._package.cache_clear()
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("their_")]:
        del sys.modules[name]
    fingerprints._package.cache_clear()
    fingerprints._distributions.cache_clear()


CONFIG = {"solver": {"_target_": "their_solver.best.Best"}, "lambda": 1.0}


NO_NUMBER = {
    "hydra": "where and how jobs run; only what a sweep is planned with has it",
    "outputs": "where files are written",
    "tracking": "where results go besides the disk",
    "fingerprint": "of a sweep's job, as the sweep lists it",
    "dry_run": "lists jobs and runs none",
    "resume": "which jobs of a sweep run again, not what they give",
}
"""Top-level keys of a run that no number depends on, and why. Whatever is not here must count."""


@pytest.mark.parametrize("choices", CHOICES, ids=" ".join)
def test_every_key_counts_but_those_without_a_number(choices):
    cfg = composed(*choices)
    before = fingerprint(configuration(cfg))
    paths = []
    for path in each_changed(cfg):
        paths.append(path)
        counts = fingerprint(configuration(cfg)) != before
        assert counts == (path[0] not in NO_NUMBER), dotted(path)
    assert {path[0] for path in paths} == set(cfg)
    assert set(NOT_IN_NUMBERS) == NO_NUMBER.keys() <= {*cfg, "hydra"}  # no dead one
    assert fingerprint(configuration(cfg)) == before  # all was put back


def test_a_key_that_is_new_counts():
    config = configuration(composed())
    assert fingerprint(config | {"new": 1}) != fingerprint(config)


def test_values_count_and_order_does_not():
    assert fingerprint({"a": 1, "b": [1, 2]}) == fingerprint({"b": [1, 2], "a": 1})
    assert fingerprint({"a": 1}) != fingerprint({"a": 2})
    assert fingerprint({"a": [1, 2]}) != fingerprint({"a": [2, 1]})


@pytest.mark.parametrize(
    "path", ["their_solver/best.py", "their_solver/__init__.py", "their_helper.py"]
)
def test_code_plugged_in_counts_with_all_that_it_imports(plugin, path):
    before = fingerprint(CONFIG)
    file = plugin / path
    file.write_text(file.read_text() + "# changed\n")
    fingerprints._package.cache_clear()
    assert fingerprint(CONFIG) != before


@pytest.mark.parametrize("moved", ["their_solver/better.py", "their_solver/deep/best.py"])
def test_a_module_under_another_name_counts(plugin, moved):
    before = fingerprint(CONFIG)
    (plugin / moved).parent.mkdir(exist_ok=True)
    (plugin / "their_solver" / "best.py").rename(plugin / moved)
    fingerprints._package.cache_clear()
    assert fingerprint(CONFIG) != before


def test_the_order_in_which_files_are_found_does_not_count(plugin, monkeypatch):
    before = fingerprint(CONFIG)
    listed = Path.rglob
    monkeypatch.setattr(Path, "rglob", lambda *args: reversed(list(listed(*args))))
    fingerprints._package.cache_clear()
    assert fingerprint(CONFIG) == before


def test_an_installed_plugin_counts_by_the_hashes_of_its_files(plugin):
    installed = plugin / "their_solver-1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: their-solver\nVersion: 1.0\n")
    (installed / "top_level.txt").write_text("their_solver\n")
    found = set()
    for content in ("aaa", "bbb"):
        (installed / "RECORD").write_text(f"their_solver/__init__.py,sha256={content},23\n")
        fingerprints._package.cache_clear()
        fingerprints._distributions.cache_clear()
        assert component_code(CONFIG).keys() == {"their_solver"}
        found.add(fingerprint(CONFIG))
    assert len(found) == 2


def test_a_file_beside_the_code_counts(plugin):
    """A map that the component reads, say; what Python keeps for itself does not count."""
    data = plugin / "their_solver" / "maps" / "floor.txt"
    data.parent.mkdir()
    data.write_text("#..#")
    before = fingerprint(CONFIG)
    (plugin / "their_solver" / "__pycache__").mkdir(exist_ok=True)
    (plugin / "their_solver" / "__pycache__" / "best.pyc").write_text("compiled")
    clear_caches()
    assert fingerprint(CONFIG) == before
    data.write_text("#.##")
    clear_caches()
    assert fingerprint(CONFIG) != before


def test_plugged_in_code_is_not_run(plugin):
    (plugin / "their_solver" / "__init__.py").write_text("raise SystemExit('ran')\n")
    assert set(component_code(CONFIG)) == {"their_solver", "their_helper"}
    assert "their_solver" not in sys.modules


def test_what_a_package_imports_of_its_own_is_no_other_package(plugin):
    own = "from .flask import app\nfrom ..flask import app\nfrom . import flask\n"
    (plugin / "their_solver" / "best.py").write_text(own)
    assert "flask" not in component_code(CONFIG)
    (plugin / "their_solver" / "best.py").write_text("from flask import app\n")
    fingerprints._package.cache_clear()
    assert "flask" in component_code(CONFIG)


def test_what_a_component_declares_counts(plugin):
    """A file beside the code whose name nobody writes down, a server's version, a licence."""
    weights = plugin / "weights.bin"
    weights.write_bytes(b"1")
    (plugin / "their_helper.py").write_text(
        "from pathlib import Path\n"
        "class Model:\n"
        "    def __init__(self, version=1): self.version = version\n"
        "    def depends_on(self):\n"
        f"        return {{'weights': Path({str(weights)!r}), 'version': self.version}}\n"
    )
    config = {"labeler": {"_target_": "their_helper.Model", "version": 1}, "lambda": 1.0}
    before = fingerprint(config)
    assert fingerprint(config) == before
    weights.write_bytes(b"2")
    other = fingerprint(config)
    assert other != before
    weights.write_bytes(b"1")
    assert fingerprint(config) == before
    config["labeler"]["_target_"] = "their_helper.Absent"  # the experiment says what is wrong
    assert fingerprint(config) not in (before, other)


def test_targets_are_found_at_any_depth(plugin):
    nested = {"labeler": {"models": [{"inner": {"_target_": "their_helper.Model"}}]}}
    assert set(component_code(nested)) == {"their_helper"}


def test_code_named_in_another_way_counts(plugin):
    """As Gymnasium has it: ``id: module:Name-v0`` imports the module."""
    config = {"domain": {"id": "their_helper:Maze-v0"}}
    assert set(component_code(config)) == {"their_helper"}
    before = fingerprint(config)
    (plugin / "their_helper.py").write_text("ANSWER = 43\n")
    clear_caches()
    assert fingerprint(config) != before
    assert component_code({"facts": {"text": "Say: yes", "url": "http://a.b/c"}}) == {}


def test_an_installed_package_counts_without_reading_it():
    assert set(component_code({"_target_": "hydra.utils.get_class"})) == {"hydra"}


def test_our_own_and_the_standard_library_are_covered_elsewhere():
    config = {"a": {"_target_": "xplain.solvers.greedy.QMDP"}, "b": {"_target_": "sklearn.tree.X"}}
    assert component_code(config) == {}
    assert component_code({"_target_": "collections.OrderedDict"}) == {}
    brought = {name: of for name, of in metadata.packages_distributions().items() if name.isalpha()}
    for library in fingerprints.LIBRARIES:  # their versions count
        names = [name for name, distributions in brought.items() if library in distributions]
        assert names or library in ("gymnasium", "fast-downward.translate")  # of extras
        assert component_code([{"_target_": f"{name}.anything"} for name in names]) == {}


def test_the_content_of_files_counts(tmp_path):
    data = tmp_path / "labels.csv"
    data.write_text("1")
    config = {"observers": {"path": str(data)}}
    before = fingerprint(config)
    data.write_text("2")
    assert fingerprint(config) != before
    data.write_text("1")
    assert fingerprint(config) == before


def test_the_content_of_files_inside_packages_counts(tmp_path, monkeypatch):
    (tmp_path / "some_tasks" / "inner").mkdir(parents=True)
    (tmp_path / "some_tasks" / "__init__.py").touch()
    task = tmp_path / "some_tasks" / "inner" / "task.pddl"
    task.write_text("1")
    monkeypatch.syspath_prepend(tmp_path)
    config = {"domain": {"file": "pkg://some_tasks/inner/task.pddl"}}
    before = fingerprint(config)
    task.write_text("2")
    assert fingerprint(config) != before
    for absent in ("nowhere", "no.where", "no-where", ""):  # whoever reads it will say so
        assert fingerprint({"domain": {"file": f"pkg://{absent}/task.pddl"}})


def test_the_versions_are_those_that_run():
    versions = fingerprints.library_versions()
    for name, module in (("numpy", np), ("scipy", scipy), ("numba", numba), ("pandas", pd)):
        assert versions[name] == module.__version__
    assert versions["scikit-learn"] == sklearn.__version__
    assert versions["python"] == f"{sys.version_info.major}.{sys.version_info.minor}"


def test_code_and_libraries_count(monkeypatch):
    before = fingerprint({})
    monkeypatch.setattr(fingerprints, "code_version", lambda: "other")
    other = fingerprint({})
    assert other != before
    monkeypatch.setattr(fingerprints, "library_versions", lambda: {"numpy": "0.1"})
    assert fingerprint({}) not in (before, other)


def test_every_source_of_the_package_counts_by_content_and_place(tmp_path, monkeypatch):
    package = tmp_path / "xplain"
    (package / "experiment").mkdir(parents=True)
    (package / "a.py").write_text("1\n")
    monkeypatch.setattr(fingerprints, "__file__", str(package / "experiment" / "fingerprint.py"))
    version = fingerprints.code_version.__wrapped__
    seen = [version()]
    (tmp_path / "beside.py").write_text("of the tests, say\n")
    assert version() == seen[0]
    (package / "a.py").write_text("2\n")
    seen.append(version())
    (package / "a.py").rename(package / "b.py")
    seen.append(version())
    (package / "experiment" / "c.py").write_text("3\n")
    seen.append(version())
    assert len(set(seen)) == 4


def test_a_library_that_is_not_there_counts_as_none(monkeypatch):
    monkeypatch.setattr(fingerprints, "LIBRARIES", {"no-such-library": "no_such_library"})
    assert fingerprints.library_versions.__wrapped__()["no-such-library"] == "none"


def test_what_git_cannot_tell_is_left_out(tmp_path, monkeypatch):
    """A checkout that git does not take for one: broken, or of somebody else."""
    monkeypatch.setattr(fingerprints, "__file__", str(tmp_path / "xplain" / "experiment" / "f.py"))
    assert fingerprints.git_state.__wrapped__() == {}
    (tmp_path / ".git").write_text("gitdir: nowhere")
    assert fingerprints.git_state.__wrapped__() == {}
