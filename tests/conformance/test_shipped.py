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


class TestDomains(DomainConformance):
    @pytest.fixture(params=shipped("domain", "pddl", "gym"))  # which have no task of their own
    def component(self, request: pytest.FixtureRequest) -> Any:
        return request.param.component


class TestTypeSources(TypeSourceConformance):
    @pytest.fixture(
        params=shipped("users", explicit="users.groups={A: [fire], B: [fence, first_aid]}")
    )
    def component(self, request: pytest.FixtureRequest) -> Any:
        return request.param.component


class TestQueries(QueriesConformance):
    @pytest.fixture(params=shipped("queries"))
    def component(self, request: pytest.FixtureRequest) -> Any:
        return request.param.component


class TestLabelers(LabelerConformance):
    @pytest.fixture(params=shipped("labeler", "truth"))
    def component(self, request: pytest.FixtureRequest) -> Any:
        made = request.param.component
        if isinstance(made, HypothesisTrainer):
            made = replace(made, hypotheses=of_rescue())
        return made


class TestClusterers(TypeFinderConformance):
    @pytest.fixture(params=shipped("clusterer", "single", "perfect"))
    def component(self, request: pytest.FixtureRequest) -> Any:
        return request.param.component


class TestSingle(TypeFinderConformance):
    chosen = Chosen("clusterer", "single")
    finds_types = False


class TestPerfect(TypeFinderConformance):
    chosen = Chosen("clusterer", "perfect")
    needs_truth = True


class TestPartitions(PartitionConformance):
    @pytest.fixture(params=["kmeans", "agglomerative"])
    def component(self, request: pytest.FixtureRequest) -> Any:
        return Chosen("clusterer", request.param).component.partition


class TestSolvers(SolverConformance):
    @pytest.fixture(params=shipped("solver", "silent", "say_all"))
    def component(self, request: pytest.FixtureRequest) -> Any:
        return request.param.component


class TestOpenLoop(SolverConformance):
    weighs_costs = False

    @pytest.fixture(params=["silent", "say_all"])
    def component(self, request: pytest.FixtureRequest) -> Any:
        return Chosen("solver", request.param).component


class TestExplainees(ExplaineeConformance):
    @pytest.fixture(params=shipped("explainee"))
    def component(self, request: pytest.FixtureRequest) -> Any:
        return request.param.component
