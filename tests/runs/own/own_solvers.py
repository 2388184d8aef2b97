"""A user's own solvers, for tests of the use from Python.

They are a separate module, because a component's fingerprint covers its whole package with all
imports, and the package of the tests is large.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from xplain.explanation.problem import Problem
from xplain.solvers.base import Policy
from xplain.solvers.simple import QHR


@dataclass(frozen=True)
class Talkative(QHR):
    """A solver that prints."""

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        print("planning")
        return super().plan(problem, seed)


@dataclass(frozen=True)
class Named(QHR):
    """A solver with options of every kind."""

    text: str = ""
    cells: tuple[tuple[int, ...], ...] = ()
    fees: Mapping[str, Any] = field(default_factory=dict)
