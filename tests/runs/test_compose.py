"""A sweep's configurations: composed once for many jobs, the same as Hydra's own for each."""

from __future__ import annotations

from copy import deepcopy
from functools import cache

import pytest
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from xplain.errors import XplainError
from xplain.experiment.config import composed
from xplain.experiment.fingerprint import configuration
from xplain.runs.compose import Composer

GROUPS = (
    "domain",
    "users",
    "observers",
    "queries",
    "labeler",
    "clusterer",
    "solver",
    "ask",
    "tracking",
)
JOBS = (
    ["domain=rescue", "solver=qmdp", "lambda=0.5", "seed=1"],
    ["domain=rescue", "solver=qmdp", "lambda=1.5", "seed=2"],
    ["solver=pomcp", "lambda=1.5", "seed=2", "solver.simulations=70"],
    ["domain=rescue", "solver=qmdp", "lambda=2", "seed=1"],
    ["domain=four_rooms", "users.count=3", "lambda=2"],
    ["domain=four_rooms", "users.count=4", "lambda=1"],
    ["lambda=1", "domain=four_rooms", "users.count=2"],
    ["message_cost={fire: 2}"],
    ["ask=clips", "ask.cost=0.2"],
    ["ask=clips", "ask.cost=0.5"],
    ["message_cost=3"],
    ["message_cost=0.5"],
    ["labeler='true'", "prior=observers"],
    ["labeler='true'", "prior=uniform"],
    ["queries=shared", "points='40'"],
    ["queries=shared", "points=null"],
    ["queries=shared", "points=50"],
)


@cache
def _hydras(overrides: tuple[str, ...]) -> DictConfig:
    return composed("config", overrides)


def _composer(loaded: list[list[str]]) -> Composer:
    def load(overrides: list[str]) -> DictConfig:
        loaded.append(overrides)
        return deepcopy(_hydras(tuple(overrides)))

    return Composer(load, GROUPS)


def test_every_job_gets_what_hydra_would_make_of_it() -> None:
    compose = _composer([])
    for job in JOBS:
        assert compose(list(job)) == configuration(_hydras(tuple(job))), job


def test_jobs_that_differ_in_values_alone_are_loaded_once() -> None:
    loaded: list[list[str]] = []
    compose = _composer(loaded)
    kinds = [(solver, f"seed={seed}") for solver in ("qmdp", "qhr") for seed in range(5)]
    for solver, seed in kinds:
        assert compose([f"solver={solver}", seed])["seed"] == int(seed[5:])
    assert len(loaded) == 2


REFUSED = (HydraException, OmegaConfBaseException, XplainError)


@pytest.mark.parametrize(
    ("right", "wrong"), [("seed=1", "seed=often"), ("resume=none", "resume=maybe"), ("", "sed=1")]
)
def test_a_wrong_value_is_refused_alike_first_and_later(right: str, wrong: str) -> None:
    with pytest.raises(REFUSED) as first:
        _composer([])([wrong])
    compose = _composer([])
    compose([right] if right else [])
    with pytest.raises(REFUSED) as later:
        compose([wrong])
    assert str(later.value) == str(first.value)
    assert compose(["seed=2"])["seed"] == 2  # what was refused left nothing behind
