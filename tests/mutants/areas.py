"""What is mutated, by which tests a mutant is met, and the draw: see areas.toml."""

from __future__ import annotations

import ast
import random
import tomllib
from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

from tests.mutants import operators


@dataclass(frozen=True)
class Mutant:
    """One mistake.

    Attributes:
        area, path: where; the path is relative to the repository.
        function: dotted, empty at module level.
        line: of the source that is replaced.
        operator, occurrence: what :func:`operators.mutate` needs.
        before, after: the lines replaced, and what replaces them, without indentation.
    """

    area: str
    path: str
    function: str
    line: int
    operator: str
    occurrence: int
    before: str
    after: str

    @property
    def key(self) -> str:
        """The same wherever its line is moved to within the function."""
        return "\n".join((self.path, self.function, self.before, self.after))


@dataclass(frozen=True)
class Stage:
    """Tests run at once: arguments of pytest, and whether kernels are compiled for them."""

    tests: tuple[str, ...]
    compiled: bool = True


class Areas:
    """The table of areas over a repository.

    Args:
        root: of the repository.
        table: of ``areas.toml``.
    """

    def __init__(self, root: Path, table: dict[str, Any]) -> None:
        self.root, self.table = root, table
        for area, entry in table["areas"].items():
            for pattern in entry["sources"]:
                if not any(root.glob(pattern)):
                    raise SystemExit(f"areas.toml: {area}: no file is {pattern}")
        for test in chain.from_iterable(
            chain(
                (entry.get("tests", ()) for entry in table["areas"].values()),
                table.get("uncompiled", {}).values(),
            )
        ):
            if not (root / test.partition("::")[0]).exists():
                raise SystemExit(f"areas.toml: no file is {test}")

    @classmethod
    def load(cls, root: Path) -> Areas:
        """Those of a repository's ``tests/mutants/areas.toml``."""
        return cls(root, tomllib.loads((root / "tests/mutants/areas.toml").read_text("utf-8")))

    def sources(self, area: str) -> list[str]:
        """Its modules; one that an earlier area names too is that one's."""
        taken: set[str] = set()
        for name, entry in self.table["areas"].items():
            own = {
                str(path.relative_to(self.root))
                for pattern in entry["sources"]
                for path in self.root.glob(pattern)
            }
            if name == area:
                return sorted(own - taken)
            taken |= own
        raise SystemExit(f"{area} is none of {', '.join(self.table['areas'])}")

    def stages(self, area: str, path: str) -> list[Stage]:
        """The tests that a mutant of this module meets, the nearest first: those that run its
        kernels uncompiled; its mirror's; those that import it and the area's."""
        plain = tuple(self.table.get("uncompiled", {}).get(path, ()))
        module = Path(path)
        mirror = Path("tests", *module.parts[1:-1], f"test_{module.name}")
        near = [str(mirror)] if (self.root / mirror).exists() else []
        importers = [test for test, names in self._imports.items() if _dotted(path) in names]
        left_out = set(self.table.get("left_out", ()))
        wider = dict.fromkeys(chain(importers, self.table["areas"][area].get("tests", ())))
        further = [test for test in wider if test not in {*left_out, *near, *plain}]
        near = [test for test in near if test not in plain]
        stages = [Stage(plain, compiled=False), Stage(tuple(near)), Stage(tuple(further))]
        return [stage for stage in stages if stage.tests]

    @cached_property
    def _imports(self) -> dict[str, set[str]]:
        """Per test file, the dotted names that it imports."""
        return {
            str(path.relative_to(self.root)): _imported(path)
            for path in sorted(self.root.glob("tests/**/test_*.py"))
            if "mutants" not in path.parts
        }

    def draw(self, sample: int, seed: int, only: list[str]) -> list[Mutant]:
        """Mutants at random, as many of each area as it has, up to an equal share.

        A place in the source is drawn, then one of its mutants. A larger sample begins with the
        smaller one.

        Args:
            sample: how many in all.
            seed: of the draw.
            only: areas; all of them where empty.
        """
        streams = [self._shuffled(area, seed) for area in only or self.table["areas"]]
        drawn: list[Mutant] = []
        while streams and len(drawn) < sample:
            for stream in list(streams):
                mutant = next(stream, None)
                if mutant is None:
                    streams.remove(stream)
                elif len(drawn) < sample:
                    drawn.append(mutant)
        return drawn

    def _shuffled(self, area: str, seed: int) -> Any:
        spots = defaultdict(list)
        for path in self.sources(area):
            for name, occurrence, span, function in operators.places(self._text(path)):
                spots[path, span].append((name, occurrence, function))
        rng = random.Random(f"{seed} {area}")
        order = sorted(spots)
        rng.shuffle(order)
        seen: set[str] = set()
        for path, span in order:
            name, occurrence, function = rng.choice(spots[path, span])
            source = self._text(path)
            mutated = operators.mutate(source, name, occurrence)
            if mutated is None:
                continue
            before, after = changed(source, mutated)
            mutant = Mutant(area, path, function, span[0][0], name, occurrence, before, after)
            if mutant.key not in seen:
                seen.add(mutant.key)
                yield mutant

    def _text(self, path: str) -> str:
        return (self.root / path).read_text("utf-8")


def changed(source: str, mutated: str) -> tuple[str, str]:
    """The lines that differ, in the one and in the other, each without its indentation."""
    old, new = source.splitlines(), mutated.splitlines()
    same = [a == b for a, b in zip_longest(old, new)]
    first = same.index(False)
    last = 0
    while last < min(len(old), len(new)) - first and old[-1 - last] == new[-1 - last]:
        last += 1
    kept = (
        "\n".join(line.strip() for line in lines[first : len(lines) - last]) for lines in (old, new)
    )
    before, after = kept
    return before, after


def _dotted(path: str) -> str:
    return ".".join(Path(path).with_suffix("").parts).removesuffix(".__init__")


def _imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names
