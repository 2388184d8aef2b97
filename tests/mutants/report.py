"""What a campaign found: shares killed by area, and the survivors as differences."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tests.mutants.areas import Mutant
from tests.mutants.campaign import Outcome
from tests.mutants.scratch import KILLED, SURVIVED, TIMEOUT


@dataclass(frozen=True)
class Equivalent:
    """A mutant that is no mistake, and why."""

    file: str
    function: str
    before: str
    after: str
    reason: str

    def is_(self, mutant: Mutant, root: Path) -> bool:
        """Whether it is this one. A file that is gone was moved: then the rest decides."""
        same = (mutant.function, mutant.before, mutant.after)
        if (self.function, self.before, self.after) != same:
            return False
        return self.file == mutant.path or not (root / self.file).exists()


def equivalents(path: Path) -> list[Equivalent]:
    """Those of a file like ``equivalent.toml``.

    Raises:
        SystemExit: where one lacks a reason.
    """
    found = [
        Equivalent(**entry) for entry in tomllib.loads(path.read_text("utf-8")).get("mutant", [])
    ]
    for one in found:
        if not one.reason.strip():
            raise SystemExit(f"{path.name}: {one.file}: {one.before!r} lacks a reason")
    return found


def report(outcomes: Iterable[Outcome], known: list[Equivalent], root: Path) -> str:
    """The table by area, then every survivor that is not explained."""
    rows: dict[str, list[Outcome]] = {}
    every = list(outcomes)
    for outcome in every:
        rows.setdefault(outcome.mutant.area, []).append(outcome)
    explained = {
        outcome.mutant.key
        for outcome in every
        if outcome.outcome == SURVIVED and any(one.is_(outcome.mutant, root) for one in known)
    }
    lines = [_row("area", "mutants", KILLED, TIMEOUT, "explained", SURVIVED, "share", "CPU s")]
    for area, found in [*rows.items(), ("all", every)]:
        killed, late, survived = (
            sum(outcome.outcome == kind for outcome in found)
            for kind in (KILLED, TIMEOUT, SURVIVED)
        )
        known_here = sum(outcome.mutant.key in explained for outcome in found)
        counted = len(found) - known_here
        share = f"{(killed + late) / counted:.0%}" if counted else "-"
        seconds = f"{sum(outcome.seconds for outcome in found) / max(1, len(found)):.0f}"
        lines.append(
            _row(area, len(found), killed, late, known_here, survived - known_here, share, seconds)
        )
    lines += [
        "\n" + difference(outcome.mutant)
        for found in rows.values()
        for outcome in found
        if outcome.outcome == SURVIVED and outcome.mutant.key not in explained
    ]
    return "\n".join(lines)


def difference(mutant: Mutant) -> str:
    """``file:line function operator``, then the lines with − and +."""
    where = f"{mutant.path}:{mutant.line}  {mutant.function or 'module'}"
    old = [f"- {line}" for line in mutant.before.splitlines()]
    new = [f"+ {line}" for line in mutant.after.splitlines()]
    return "\n".join([f"[{mutant.area}] {where}  ({mutant.operator})", *old, *new])


def _row(name: str, *figures: object) -> str:
    return f"{name:14}" + "".join(f"{figure!s:>10}" for figure in figures)
