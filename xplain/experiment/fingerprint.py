"""What a number depends on, as a digest: jobs with one fingerprint give the same numbers.

A fingerprint covers the resolved configuration, the sources of this package, the versions of the
libraries that compute, the sources of every component plugged in from elsewhere with all that
they import, and the content of every file that the configuration names. Results are taken for
finished, and cached stages for valid, by their fingerprint alone, so it errs on the side of change.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

LIBRARIES = {
    **{name: name for name in ("numpy", "scipy", "kneed", "numba", "pandas", "pyarrow")},
    "scikit-learn": "sklearn",
}
"""Distributions whose version may change a number, and the package that each brings."""

NOT_IN_NUMBERS = ("hydra", "outputs", "tracking", "resume", "dry_run")
"""Keys of a configuration that cannot change a number. Hydra takes its own from a job's, but not
from the one that a sweep is planned with."""

_KNOWN = {"xplain", *LIBRARIES.values()}
"""Packages that are in every fingerprint by other ways."""


def configuration(cfg: DictConfig) -> dict[str, Any]:
    """The resolved configuration, without what cannot change a number."""
    return {
        str(key): OmegaConf.to_container(cfg[key], resolve=True)
        if OmegaConf.is_config(cfg[key])
        else cfg[key]
        for key in cfg
        if key not in NOT_IN_NUMBERS
    }


def fingerprint(config: Mapping[str, Any]) -> str:
    """The digest of a resolved configuration and of all that it makes run: 32 hex digits."""
    content = {
        "config": config,
        "code": code_version(),
        "libraries": library_versions(),
        "components": component_code(config),
        "files": {name: _digest(path.read_bytes()) for name, path in _files(config).items()},
    }
    return _digest(json.dumps(content, sort_keys=True).encode())


@cache
def code_version() -> str:
    """A digest of the package's own sources: results of other code are other results."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1]
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


@cache
def git_state() -> dict[str, str]:
    """Commit and whether the checkout has changes; empty where the package is no checkout."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return {}
    try:
        commit = _git(root, "rev-parse", "HEAD")
        dirty = bool(_git(root, "status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return {}
    return {"commit": commit, "dirty": str(dirty).lower()}


def _git(root: Path, *arguments: str) -> str:
    command = ["git", "-C", str(root), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)
    return done.stdout.strip()


@cache
def library_versions() -> dict[str, str]:
    """Versions of Python and of LIBRARIES."""
    versions = {"python": ".".join(map(str, sys.version_info[:2]))}
    for name in LIBRARIES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "none"
    return versions


def component_code(config: Any) -> dict[str, str]:
    """``{top-level package: digest}`` of what ``_target_`` names outside this package, and of
    what that imports, without running any of it.

    An installed distribution counts by its list of files with their hashes; any other package
    or module (a checkout, a script beside the experiment) by its sources.
    """
    found: dict[str, str] = {}
    pending = sorted({target.partition(".")[0] for target in _targets(config)})
    while pending:
        name = pending.pop()
        if name in found or name in _KNOWN or name in sys.stdlib_module_names:
            continue
        found[name], imported = _package(name)
        pending += imported
    return found


def _targets(node: Any) -> Iterator[str]:
    if isinstance(node, dict):
        for key, value in node.items():
            if key == "_target_" and isinstance(value, str):
                yield value
            else:
                yield from _targets(value)
    elif isinstance(node, list):
        for value in node:
            yield from _targets(value)


def _files(node: Any) -> dict[str, Path]:
    """The files that texts of the configuration name, by these texts: paths, and
    ``pkg://package/path`` inside an installed package."""
    if isinstance(node, dict | list):
        items = node.values() if isinstance(node, dict) else node
        return {name: path for item in items for name, path in _files(item).items()}
    if not isinstance(node, str) or "\n" in node or not 0 < len(node) < 1000:
        return {}
    path = Path(node)
    if node.startswith("pkg://"):
        package, _, inside = node.removeprefix("pkg://").partition("/")
        found = importlib.util.find_spec(package) if package.isidentifier() else None
        path = Path(found.origin).parent / inside if found and found.origin else path
    return {node: path} if path.is_file() else {}


@cache
def _package(name: str) -> tuple[str, tuple[str, ...]]:
    """Digest of a top-level package, and the top-level names that its sources import."""
    for distribution in _distributions().get(name, ()):
        record = metadata.distribution(distribution).read_text("RECORD") or ""
        # An editable install lists no sources of its own: fall through to them.
        if f"{name}/" in record or f"{name}.py" in record:
            return _digest(record.encode()), ()
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        spec = None
    if spec is None:
        return "missing", ()  # instantiating it will say so
    if spec.submodule_search_locations:
        roots = [Path(folder) for folder in spec.submodule_search_locations]
        sources = sorted((path, root) for root in roots for path in root.rglob("*.py"))
    else:
        origin = Path(spec.origin or "")
        sources = [(origin, origin.parent)] if origin.is_file() else []
    digest = hashlib.sha256()
    imported: set[str] = set()
    for path, root in sources:
        text = path.read_bytes()
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + text)
        imported |= _imports(text)
    return digest.hexdigest()[:32], tuple(sorted(imported))


def _imports(source: bytes) -> set[str]:
    """Top-level names that a source file imports absolutely."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return set()
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.partition(".")[0])
    return names


@cache
def _distributions() -> dict[str, list[str]]:
    """Installed distributions by the top-level names that they bring (0.1 s: only on need)."""
    return dict(metadata.packages_distributions())


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]
