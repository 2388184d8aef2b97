"""Every shipped component passes the suite of its kind; a new YAML file is tested automatically."""

from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from typing import Any

import pytest

from xplain.domains.users.hypotheses import Hypotheses
from xplain.experiment.config import CONF
from xplain.learning.mixture.labeler import HypothesisTrainer
from xplain.testing import (
    Chosen,
    DomainConformance,
    ExplaineeConformance,
    LabelerConformance,
    PartitionConformance,
    QueriesConformance,
    SolverConformance,
    TypeFinderConformance,
    TypeSourceConformance,
)
from xplain.testing.suite import Conformance

PDDL = pytest.mark.skipif(
    find_spec("fast_downward") is None, reason="pip install 'xplain-hri[pddl]'"
)
GYM = pytest.mark.skipif(find_spec("gymnasium") is None, reason="pip install 'xplain-hri[gym]'")


def shipped(group: str, *others: str, **keys: str) -> list[Any]:
    """Makes a parameter for each choice of the group except ``others``; ``keys`` has the keys that
    a choice needs."""
    return [
        pytest.param(
            Chosen(group, path.stem, *([keys[path.stem]] if path.stem in keys else [])),
            id=path.stem,
            marks=[
                mark
                for word, mark in (("xplain-hri[gym]", GYM), ("xplain-hri[pddl]", PDDL))
                if word in path.read_text(encoding="utf-8")
            ],
        )
        for path in sorted((CONF / group).glob("*.yaml"))
        if path.stem not in others
    ]


@cache
def of_rescue() -> Hypotheses:
    """Makes the hypotheses of the rescue task."""
    return Hypotheses.of_domain(Chosen("domain", "rescue").make())


def make_tests(
    suite: type[Conformance], choices: list[Any], **attributes: bool
) -> type[Conformance]:
    """Makes the suite's tests of these choices; ``attributes`` are the suite's."""

    class Shipped(suite):
        @pytest.fixture(params=choices)
        def component(self, request: pytest.FixtureRequest) -> Any:
            return request.param.component

    return type(suite.__name__, (Shipped,), attributes)


# These have no task of their own.
TestDomains = make_tests(DomainConformance, shipped("domain", "pddl", "gym"))
TestTypeSources = make_tests(
    TypeSourceConformance,
    shipped("users", explicit="users.groups={A: [fire], B: [fence, first_aid]}"),
)
TestQueries = make_tests(QueriesConformance, shipped("queries"))
TestClusterers = make_tests(TypeFinderConformance, shipped("clusterer", "single", "perfect"))
SINGLE, PERFECT = ([Chosen("clusterer", name)] for name in ("single", "perfect"))
TestSingle = make_tests(TypeFinderConformance, SINGLE, finds_types=False)
TestPerfect = make_tests(TypeFinderConformance, PERFECT, needs_truth=True)
TestSolvers = make_tests(SolverConformance, shipped("solver", "silent", "say_all"))
OPEN_LOOP = [Chosen("solver", name) for name in ("silent", "say_all")]
TestOpenLoop = make_tests(SolverConformance, OPEN_LOOP, weighs_costs=False)
TestExplainees = make_tests(ExplaineeConformance, shipped("explainee"))


class TestLabelers(LabelerConformance):
    @pytest.fixture(params=shipped("labeler", "truth"))
    def component(self, request: pytest.FixtureRequest) -> Any:
        made = request.param.component
        if isinstance(made, HypothesisTrainer):
            made = replace(made, hypotheses=of_rescue())
        return made


class TestPartitions(PartitionConformance):
    @pytest.fixture(params=["kmeans", "agglomerative"])
    def component(self, request: pytest.FixtureRequest) -> Any:
        return Chosen("clusterer", request.param).component.partition
