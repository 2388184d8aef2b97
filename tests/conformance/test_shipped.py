"""Every component that ships keeps to what its kind promises; a new YAML file is tested by being
there."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

from xplain.config import CONF
from xplain.testing import (
    Chosen,
    ClustererConformance,
    DomainConformance,
    LabelerConformance,
    PartitionConformance,
    SolverConformance,
    TypeSourceConformance,
)

KINDS = {
    "domain": DomainConformance,
    "users": TypeSourceConformance,
    "labeler": LabelerConformance,
    "clusterer": ClustererConformance,
    "solver": SolverConformance,
}
FILLS: dict[tuple[str, str], list[str]] = {
    ("users", "explicit"): ["users.groups={A: [fire], B: [fence, first_aid]}"],
}
SAID: dict[tuple[str, str], dict[str, object]] = {
    ("clusterer", "single"): {"finds_types": False},
    ("clusterer", "perfect"): {"needs_truth": True},
}

for group, suite in KINDS.items():
    for path in sorted((CONF / group).glob("*.yaml")):
        choice = path.stem
        component = Chosen(group, choice, *FILLS.get((group, choice), []))
        name = f"Test_{group}_{choice}"
        tested = type(name, (suite,), {"component": component} | SAID.get((group, choice), {}))
        if "gym" in path.read_text() and find_spec("gymnasium") is None:
            tested = pytest.mark.skip(reason="pip install 'xplain-hri[gym]'")(tested)
        globals()[name] = tested


class Partition:
    """The ``partition`` of a clusterer."""

    def __init__(self, choice: str) -> None:
        self.clusterer = Chosen("clusterer", choice)

    def __get__(self, instance: object, owner: type) -> object:
        return self.clusterer.make().partition


class TestKMeans(PartitionConformance):
    component = Partition("kmeans")


class TestAgglomerative(PartitionConformance):
    component = Partition("agglomerative")
