"""Composed configurations of a run, with a change of every key, and the traces of such runs."""

from collections.abc import Iterator
from copy import deepcopy
from functools import cache
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from xplain.experiment.config import CONF, register
from xplain.experiment.explanations import Costs
from xplain.experiment.from_config import components_of, costs_of
from xplain.experiment.pipeline import PreparedData, prepare

Path = tuple[str | int, ...]

CHOICES = (
    ("domain=rescue", "solver=pomcp", "labeler=practice", "clusterer=agglomerative"),
    ("domain=four_rooms", "solver=certified", "labeler=pruned", "clusterer=dirichlet"),
    (
        "domain=rescue",
        "queries=shared",
        "solver=lookahead",
        "clusterer=agglomerative",
        "users=rescue_completions",
    ),
    (
        "domain=frozen_lake",
        "solver=oracle",
        "clusterer=kmeans",
        "belief=persistent",
        "tracking=none",
    ),
    (
        "domain=rescue",
        "observers=file",
        "observers.path=labels.csv",
        "solver=qhr",
        "prior=observers",
    ),
    (
        "domain=four_rooms",
        "clusterer=agglomerative",
        "users=explicit",
        "users.groups={A: [goals]}",
    ),
)
"""Choices that cover most components and every kind of key."""


def composed(*overrides: str) -> DictConfig:
    """Composes a configuration of a run that may be changed: ``composed("solver=pomcp",
    "lambda=2")``."""
    return deepcopy(_composed(overrides))


@cache
def _composed(overrides: tuple[str, ...]) -> DictConfig:
    register()
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", [*overrides])


@cache
def world(*overrides: str) -> tuple[PreparedData, Costs]:
    """Returns traces and costs of a run; everybody reads the same ones."""
    cfg = composed(*overrides)
    return prepare(components_of(cfg)), costs_of(cfg)


def dotted(path: Path) -> str:
    """Writes a key as on the command line."""
    return ".".join(map(str, path))


def each_changed(cfg: DictConfig) -> Iterator[Path]:
    """Yields the path of every key with a value, in turn, while ``cfg`` has another value there."""
    for path, value in _leaves(OmegaConf.to_container(cfg), ()):
        parent: Any = cfg
        for key in path[:-1]:
            parent = parent[key]
        parent[path[-1]] = _other(cfg, path, value)
        yield path
        parent[path[-1]] = value


def _leaves(node: Any, path: Path) -> Iterator[tuple[Path, Any]]:
    inside = node.items() if isinstance(node, dict) else enumerate(node)
    for key, value in inside:
        if isinstance(value, dict | list) and value:
            yield from _leaves(value, (*path, key))
        else:
            yield (*path, key), value


def _other(cfg: DictConfig, path: Path, value: Any) -> Any:
    """Returns another value of the same type; an interpolation has the type of its value."""
    if isinstance(value, str) and "${" in value:
        value = OmegaConf.to_container(cfg, resolve=True)
        for key in path:
            value = value[key]
    match value:
        case bool():
            return not value
        case int() | float():
            return value + 1
        case str():
            return f"{value} other"
        case None:
            return 1
        case dict():
            return {"more": 1}
    return [1]
