"""Finds tables of measured figures that are older than the defaults and the code that they depend
on.

    python docs/tables.py                  lists all tables; exit code 1 if a page is wrong
    python docs/tables.py --write          marks older tables on their pages
    python docs/tables.py --stamp NAME …   marks NAME as current, after it was made again

A table has measured figures if a third of its cells, without the head, begin with a figure. The
comment `<!-- table: NAME -->` is above it, and docs/tables.toml describes NAME. docs/stamps.json
has digests of everything that each table depends on: the values of resolved configurations, and the
reference runs in tests/fixed. They change only if figures may change.
"""

import argparse
import fnmatch
import hashlib
import json
import re
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from xplain.experiment.config import GROUPS, register
from xplain.experiment.fingerprint import configuration

ROOT = Path(__file__).resolve().parent.parent
PAGES = ("README.md", "docs/*.md", "benchmarks/README.md")
ENTRIES, STAMPS, FIXED = "docs/tables.toml", "docs/stamps.json", "tests/fixed"
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
OLDER = "*Older than the code: `python docs/tables.py` says why.*"
TABLE = re.compile(
    r"(?:<!-- table: (?P<name>[^\n]+) -->\n)?(?P<older>\*Older than [^\n]*\n\n)?"
    r"(?P<table>^\|.*\n\|[-:| ]+\|\n(?P<body>(?:\|.*\n?)+))",
    re.MULTILINE,
)
TEXTS = ("message", "belief", "words", "_convert_")
"""Keys inside a component that change no figure."""

Stamp = dict[str, str]
"""A digest for each key of the configurations and each reference run."""


SINCE = {
    "belief.error": "0",
    "belief.accept": "1",
    "belief.forget": "0",
    "explainee._target_": '"Exact"',
    "ask.kinds": "null",
    "ask.cost": "0.1",
    "ask.most": "10",
    "ask.when": '"anytime"',
    "ask.clips": "150",
}
"""Keys that were added after tables were made, with the value that has the old behaviour."""
GONE = {
    "again.price": "1.0",
    "again.most": "null",
    "solver.leaf": '"max_of_mean"',
    "solver.rollout": '"qmdp"',
    "solver.trees": "1",
    "solver.threads": "1",
    "users.attempts": "1000",
    "clusterer.jobs": "1",
    "labeler.refit": "true",
}
"""Removed keys, with the value that has today's behaviour."""


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """Runs the command in a repository."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true", help="mark older tables on their pages")
    parser.add_argument(
        "--stamp", nargs="+", default=[], metavar="NAME", help="mark these tables as current"
    )
    chosen = parser.parse_args(arguments)
    entries = tomllib.loads((root / ENTRIES).read_text(encoding="utf-8"))
    kept = json.loads((root / STAMPS).read_text(encoding="utf-8"))
    now = {name: stamp(root, entry) for name, entry in entries.items() if "record" not in entry}
    if unknown := set(chosen.stamp) - now.keys():
        parser.error(f"--stamp {' '.join(sorted(unknown))}: no such table in {ENTRIES}")
    if chosen.stamp:
        kept = {name: now[name] if name in chosen.stamp else kept.get(name, {}) for name in now}
        lines = (f"{json.dumps(name)}: {json.dumps(kept[name])}" for name in sorted(kept))
        (root / STAMPS).write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    older = {name: why for name in now if (why := changed(kept.get(name, {}), now[name]))}
    for name in entries:
        state = f"older: {older[name]}" if name in older else "current"
        print(f"{name}: {state if name in now else 'a record'}")
    wrong = list(faults(root, entries))
    for page in pages(root):
        text = page.read_text(encoding="utf-8")
        if (said := telling(text, older)) != text:
            if chosen.write:
                page.write_text(said, encoding="utf-8")
            else:
                wrong.append(f"{page.relative_to(root)}: does not say what is older: --write")
    print("\n".join(wrong), end="\n" if wrong else "", file=sys.stderr)
    return bool(wrong)


def pages(root: Path) -> list[Path]:
    """Lists all pages that may have figures."""
    return [page for pattern in PAGES for page in sorted(root.glob(pattern))]


def measured(text: str) -> Iterator[re.Match[str]]:
    """Yields the tables of measured figures in a page, each with its name."""
    shown = FENCE.sub(lambda block: re.sub(r"[^\n]", " ", block[0]), text)  # the same places
    for match in TABLE.finditer(shown):
        rows = [row.strip("|").split("|") for row in match["body"].splitlines()]
        cells = [cell.strip(" *") for row in rows for cell in row]
        if 3 * sum(bool(re.match(r"[-−+.]?\d", cell)) for cell in cells) >= len(cells):
            yield match


def faults(root: Path, entries: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Finds tables without a name or a command, and names without a table."""
    used = set()
    for page in pages(root):
        text = page.read_text(encoding="utf-8")
        for match in measured(text):
            name, head = match["name"], match["table"].splitlines()[0]
            where = f"{page.relative_to(root)}: {head[:60]}"
            used.add(name)
            if name not in entries:
                yield f"{where}: no name above it that is in {ENTRIES}"
            elif entries[name]["command"] not in " ".join(text.split()):
                yield f"{where}: the page does not name its command, {entries[name]['command']}"
    yield from (f"{ENTRIES}: no page has the table {name}" for name in entries if name not in used)


def telling(text: str, older: Mapping[str, str]) -> str:
    """Returns the page with :data:`OLDER` above the older tables only."""
    for match in reversed(list(measured(text))):
        said = OLDER + "\n\n" if match["name"] in older else ""
        at = match.start("table") - len(match["older"] or "")
        text = text[:at] + said + text[match.start("table") :]
    return text


def changed(then: Stamp, now: Stamp) -> str:
    """Lists keys and reference runs that changed, in words; empty if nothing changed."""
    as_before = {key: digest([value]) for key, value in SINCE.items() if key in now}
    then = as_before | then if then else then
    gone = {(key, digest([value])) for key, value in GONE.items() if key not in now}
    then = {key: value for key, value in then.items() if (key, value) not in gone}
    keys = sorted(key for key in then.keys() | now.keys() if then.get(key) != now.get(key))
    return ", ".join(keys) if then else "never stamped"


def stamp(root: Path, entry: Mapping[str, Any]) -> Stamp:
    """Returns digests of everything that a table depends on.

    Args:
        root: of the repository.
        entry: as docs/tables.toml explains.

    Raises:
        FileNotFoundError: a reference run does not exist.
    """
    values: dict[str, set[str]] = {}
    for words in entry.get("configurations", [entry["command"].partition(" xplain ")[2]]):
        for key, value in resolved(root, words):
            if key.partition(".")[0] in entry.get("keys", [key.partition(".")[0]]):
                values.setdefault(key, set()).add(value)
    found = {key: digest(sorted(every)) for key, every in sorted(values.items())}
    for run in entry.get("runs", []):
        name, *inside = run.split("/")
        kept = part(json.loads((root / FIXED / f"{name}.json").read_text(encoding="utf-8")), inside)
        found[f"{FIXED}/{run}"] = digest(kept)
    return found


def part(node: Any, patterns: Sequence[str]) -> Any:
    """Returns the stored values below matching keys, level by level."""
    if not patterns:
        return node
    keys = fnmatch.filter(node, patterns[0])
    return {key: part(node[key], patterns[1:]) for key in keys}


def resolved(root: Path, words: str) -> Iterator[tuple[str, str]]:
    """Yields keys (two levels deep) and values of the configurations that a run's or a sweep's
    words compose.

    A choice of a group decides the keys of this group; all other keys are the domain's, or the
    defaults. A given key has its value as written.
    """
    settings = [dict(word.split("=", 1) for word in words.split())]
    if "sweeps" in settings[0]:
        settings += jobs(sweep(root, settings[0].pop("sweeps")))
    given = {key: [one[key] for one in settings if key in one] for one in settings for key in one}
    chosen = {
        group: sorted({choice for values in given.pop(group) for choice in values.split(",")})
        for group in GROUPS
        if group in given
    }
    whole = [f"domain={domain}" for domain in chosen.pop("domain", [])] or [""]
    parts = [("", choice) for choice in whole]
    parts += [(group, f"{group}={choice}") for group, each in chosen.items() for choice in each]
    for group, choice in parts:
        for key, value in composed(root, choice):
            above = key.partition(".")[0]
            own = above == group if group else above not in chosen
            if own and not {key, above} & given.keys():
                yield key, value
    yield from ((key, value) for key in given if key != "seed" for value in given[key])


def jobs(file: Mapping[str, Any]) -> list[dict[str, str]]:
    """Returns the values that a sweep's jobs set: keys of its file, its parameters, and each of its
    settings."""
    sweeper = file.get("hydra", {}).get("sweeper", {})
    own = {key: value for key, value in file.items() if key != "hydra"}
    parts = [own, sweeper.get("params", {}), *sweeper.get("settings", [])]
    return [{key: str(value) for key, value in part.items()} for part in parts]


def sweep(root: Path, name: str) -> dict[str, Any]:
    """Returns the content of a file of sweeps/, merged over the files that it is based on."""
    own: Any = OmegaConf.load(root / "sweeps" / f"{name}.yaml")
    based = [sweep(root, base) for base in own.pop("defaults", []) if base != "_self_"]
    merged: Any = OmegaConf.to_container(OmegaConf.merge(*based, own))
    return dict(merged)


@cache
def composed(root: Path, choice: str) -> list[tuple[str, str]]:
    """Returns the resolved configuration with a choice, or without, as (key, value), two levels
    deep."""
    register()
    with initialize_config_dir(str(root / "conf"), version_base="1.3"):
        found = configuration(compose("config", [choice] if choice else []))
    found = {key: plain(value) for key, value in found.items() if key != "seed"}
    return [
        (f"{key}.{inner}".strip("."), json.dumps(part, sort_keys=True))
        for key, value in found.items()
        for inner, part in (value.items() if isinstance(value, dict) else [("", value)])
    ]


def plain(node: Any) -> Any:
    """Removes :data:`TEXTS` and empty values, and reduces our classes to their names without their
    module."""
    if isinstance(node, dict):
        return {key: plain(value) for key, value in node.items() if key not in TEXTS} or None
    if isinstance(node, list):
        return [plain(value) for value in node] or None
    return node.rpartition(".")[2] if isinstance(node, str) and node.startswith("xplain.") else node


def digest(content: Any) -> str:
    """Computes a digest of eight hex digits."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]


if __name__ == "__main__":
    sys.exit(main())
