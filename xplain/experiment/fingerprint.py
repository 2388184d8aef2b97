"""Fingerprints: jobs with one fingerprint give the same numbers.

A fingerprint covers the resolved configuration, the sources of this package, the versions of the
computing libraries, the sources of every external component with everything that they import, the
declarations of such components (:class:`Dependent`), and the content of every file that the
configuration names. Stored results and cached stages with an equal fingerprint are used again, so a
fingerprint must change in every doubtful case.
"""

import ast
import hashlib
import importlib.util
import inspect
import json
import marshal
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from importlib import metadata
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, runtime_checkable

from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from xplain.errors import InputError, XplainError
from xplain.experiment.config import make_object

LIBRARIES = {
    **{name: name for name in ("numpy", "scipy", "kneed", "numba", "pandas", "pyarrow")},
    "scikit-learn": "sklearn",
    "gymnasium": "gymnasium",
    "fast-downward.translate": "fast_downward",
}
"""Distributions whose version may change a number, with the package that each provides."""

NOT_IN_NUMBERS = ("hydra", "outputs", "tracking", "resume", "dry_run")
"""Configuration keys that cannot change a number. Hydra removes its own node from a job's
configuration, but not from the configuration of a whole sweep."""

_KNOWN = {"xplain", *LIBRARIES.values()}
"""Packages that every fingerprint covers in another way."""


@runtime_checkable
class Dependent(Protocol):
    """A component whose results also depend on something beyond its configuration, its code and the
    files that its configuration names."""

    def depends_on(self) -> Mapping[str, object]:
        """Returns the further dependencies by name: numbers, texts, or paths of files. The
        fingerprint covers the content of the files."""


def configuration(cfg: DictConfig) -> dict[str, Any]:
    """Resolves a configuration and removes the keys that cannot change a number."""
    return {
        str(key): OmegaConf.to_container(cfg[key], resolve=True)
        if OmegaConf.is_config(cfg[key])
        else cfg[key]
        for key in cfg
        if key not in NOT_IN_NUMBERS
    }


def fingerprint(config: Mapping[str, Any]) -> str:
    """Computes the digest of a resolved configuration and of all code that it runs: 32 hex
    digits."""
    named = {text: _find_file(text) for _, text in _list_texts(config)}
    content = {
        "config": config,
        "code": code_version(),
        "libraries": library_versions(),
        "components": component_code(config),
        "declared": collect_declarations(config),
        "files": {text: _digest(path.read_bytes()) for text, path in named.items() if path},
    }
    return _digest(json.dumps(content, sort_keys=True).encode())


@cache
def code_version() -> str:
    """Computes a digest of the package's own sources, so that results of
    another version of the code are never reused."""
    return _digest_of(_read_sources(Path(__file__).parents[1]))[:16]


@cache
def git_state() -> dict[str, str]:
    """Returns the commit, and ``dirty`` if the checkout has changes. Returns an empty mapping if
    the package is not a checkout."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return {}
    words = ["describe", "--always", "--abbrev=40", "--exclude=*", "--dirty"]
    try:
        said = subprocess.run(
            ["git", *words], cwd=root, capture_output=True, text=True, check=True, timeout=10
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return {}
    commit, dirty, _ = said.strip().partition("-dirty")
    return {"commit": commit, "dirty": str(bool(dirty)).lower()}


@cache
def library_versions() -> dict[str, str]:
    """Reads the versions of Python and of LIBRARIES."""
    found = {n: own.version for n in LIBRARIES for own in metadata.distributions(name=n)}
    python = ".".join(map(str, sys.version_info[:2]))
    return {"python": python, **dict.fromkeys(LIBRARIES, "none"), **found}


def component_code(config: Any) -> dict[str, str]:
    """Computes ``{top-level package: digest}`` of all code outside this package that ``_target_``
    (or a text such as ``module:Name``) names, and of its imports. No code is executed.

    The digest of an installed distribution covers its list of files with their hashes. The digest
    of any other package (a checkout) covers all of its files, including data. The digest of a
    module covers its source.
    """
    found: dict[str, str] = {}
    names = (text for key, text in _list_texts(config) if key == "_target_" or _NAMES_CODE(text))
    pending = sorted({re.split("[.:]", name)[0] for name in names})
    while pending:
        name = pending.pop()
        if name in found or name in _KNOWN or name in sys.stdlib_module_names:
            continue
        found[name], imported = _digest_package(name)
        pending += imported
    return found


def collect_declarations(config: Mapping[str, Any]) -> dict[str, dict[str, str]]:
    """Collects the declarations of components from outside the package, as ``{group: {name:
    value}}``. A component that cannot be created declares nothing; the experiment reports the
    reason."""
    found = {}
    for group, node in config.items():
        target = str(node.get("_target_", "xplain")) if isinstance(node, Mapping) else "xplain"
        if target.partition(".")[0] not in _KNOWN:
            with suppress(HydraException):
                made = make_object(node)
                if isinstance(made, Dependent):
                    found[group] = {name: _identify(own) for name, own in made.depends_on().items()}
    return found


def _identify(value: object) -> str:
    return _digest(value.read_bytes()) if isinstance(value, Path) else repr(value)


_NAMES_CODE = re.compile(r"[^\W\d][\w.]*:[^\W\d][\w.-]*").fullmatch


def _list_texts(node: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Yields (key, text) for every text in a configuration. The key is "" for a text in a list."""
    match node:
        case str():
            yield key, node
        case dict():
            for name, value in node.items():
                yield from _list_texts(value, name)
        case list():
            for value in node:
                yield from _list_texts(value)


def _find_file(text: str) -> Path | None:
    """Returns the file that a text of the configuration names, if any. The text is a path, or
    ``pkg://package/path`` inside an installed package."""
    if "\n" in text or len(text) >= 1000:
        return None
    path = Path(text)
    if text.startswith("pkg://"):
        package, _, inside = text.removeprefix("pkg://").partition("/")
        found = importlib.util.find_spec(package) if package.isidentifier() else None
        path = Path(found.origin).parent / inside if found and found.origin else path
    return path if path.is_file() else None


@cache
def _digest_package(name: str) -> tuple[str, tuple[str, ...]]:
    """Computes the digest of a top-level package, and lists the top-level names that its sources
    import."""
    for distribution in _list_distributions().get(name, ()):
        record = metadata.distribution(distribution).read_text("RECORD") or ""
        # The record of an editable install does not list the sources: continue with the sources.
        if f"{name}/" in record or f"{name}.py" in record:
            return _digest(record.encode()), ()
    if name == "__main__":
        return _digest_of(_read_program()), ()
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        spec = None
    if spec is None:
        return "missing", ()  # its instantiation reports the error
    origin = Path(spec.origin or "")
    if spec.submodule_search_locations:
        roots = map(Path, spec.submodule_search_locations)
        sources = [source for root in roots for source in _read_sources(root, "*")]
    else:
        sources = [(origin.name, origin.read_bytes())] if origin.is_file() else []
    code = (text for name, text in sources if name.endswith(".py"))
    imported = set[str]().union(*map(_list_imports, code))
    return _digest_of(sources), tuple(sorted(imported))


def _read_program() -> list[tuple[str, bytes]]:
    """Reads (name, source) of the running script, or of the classes and functions of a notebook.

    Raises:
        InputError: the source cannot be found.
    """
    program = sys.modules["__main__"]
    if file := getattr(program, "__file__", None):
        return [("__main__", Path(file).read_bytes())]
    own = [one for one in vars(program).values() if getattr(one, "__module__", "") == "__main__"]
    try:
        return [(one.__name__, inspect.getsource(one).encode()) for one in own if callable(one)]
    except (OSError, TypeError, AttributeError):
        allowed = "a class in a file or a cell of a notebook: its source is part of a result"
        raise InputError("_target_", "__main__", allowed) from None


_IGNORED = re.compile(r"__pycache__$|\.").match
"""Matches folders in a package without code or data."""


def _read_sources(root: Path, kind: str = "*.py") -> list[tuple[str, bytes]]:
    """Reads the files in a folder whose names match ``kind``, as (path inside it, content)."""
    files = [
        path
        for path in sorted(root.rglob(kind))
        if path.is_file() and not any(map(_IGNORED, path.relative_to(root).parts[:-1]))
    ]
    return [(path.relative_to(root).as_posix(), path.read_bytes()) for path in files]


def _digest_of(sources: list[tuple[str, bytes]]) -> str:
    return _digest(b"\0".join(name.encode() + b"\0" + text for name, text in sources))


def _list_imports(source: bytes) -> set[str]:
    """Lists top-level names that a source file imports absolutely."""
    try:
        nodes = [*ast.walk(ast.parse(source))]
    except (SyntaxError, ValueError):
        return set()
    names = [one.name for node in nodes if isinstance(node, ast.Import) for one in node.names]
    names += [n.module or "" for n in nodes if isinstance(n, ast.ImportFrom) and n.level == 0]
    return {name.partition(".")[0] for name in names}


@cache
def _list_distributions() -> dict[str, list[str]]:
    """Lists the installed distributions by the top-level names that they provide (takes 0.1 s)."""
    return dict(metadata.packages_distributions())


def clear_caches() -> None:
    """Clears the caches, because code may change while a program runs."""
    for known in (_digest_package, _list_distributions, code_version):
        known.cache_clear()


_LOADED: dict[str, tuple[object, str]] = {}
"""For each module: its specification, which changes when the module is loaded again, and the digest
of its file."""


def require_as_loaded(config: Mapping[str, Any]) -> None:
    """Refuses code that was edited after it was loaded. Otherwise this process would store results
    of the old code under the fingerprint of the new code.

    Raises:
        XplainError: code was edited.
    """
    ours = {"xplain", *component_code(config)}
    for name, module in [*sys.modules.items()]:
        file = Path(getattr(module, "__file__", None) or "")
        if name.partition(".")[0] not in ours or file.suffix != ".py" or not file.is_file():
            continue
        source, spec = file.read_bytes(), module.__spec__
        known = _LOADED.get(name, (None, ""))
        looked_at = name in _LOADED and known[0] is spec
        if known[1] != _digest(source) if looked_at else _was_compiled_from_other(module, source):
            raise XplainError(f"{name}: {file} was edited after it was loaded; reload or restart")
        _LOADED[name] = spec, _digest(source)


def _was_compiled_from_other(module: ModuleType, source: bytes) -> bool:
    """True if the compiled file from which a module was loaded was not made from ``source``. False
    if there is no compiled file."""
    # If Python writes no compiled files, one of an older source may exist that was not loaded.
    from_source = type(getattr(module, "__loader__", None)) is SourceFileLoader
    if sys.dont_write_bytecode or not from_source:
        return False
    try:
        content = Path(getattr(module, "__cached__", None) or "").read_bytes()
        loaded = marshal.loads(content[16:])
        return compile(source, loaded.co_filename, "exec", dont_inherit=True) != loaded
    except (OSError, ValueError, EOFError, TypeError, SyntaxError):
        return False


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]
