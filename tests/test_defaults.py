"""Each default has one value: a default of a class equals that of its YAML file."""

import dataclasses
import inspect
from collections.abc import Iterator
from typing import Any

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig, OmegaConf

from xplain.experiment.config import CONF, compose_config, schema
from xplain.people.server import Server
from xplain.runs.mlflow import MLflow

GROUPS = ("labeler", "clusterer", "users", "observers", "queries", "belief", "domain", "solver")
VARIANTS = {
    "labeler/hypotheses",
    "labeler/practice",
    "labeler/pruned",
    "solver/clairvoyant",
    "solver/pomcp_paper",
    "domain/cliff_walking",
    "domain/frozen_lake",
    "domain/taxi",
    "domain/blocks",
    "domain/logistics",
    "domain/rover",
    "domain/search_and_rescue",
}
"""Files that choose other values for a class whose base is another file, or describe one of many
tasks."""
CHOICES = sorted(
    f"{group}/{path.stem}" for group in GROUPS for path in (CONF / group).glob("*.yaml")
)


def components(node: DictConfig) -> Iterator[DictConfig]:
    """Yields every part of a configuration that makes a class of the package."""
    if str(node.get("_target_", "")).startswith("xplain."):
        yield node
    for key in node:
        if not OmegaConf.is_missing(node, key) and isinstance(node[key], DictConfig):
            yield from components(node[key])


def defaults(cls: type) -> dict[str, Any]:
    """Returns the defaults of a class."""
    if dataclasses.is_dataclass(cls):
        made = {f.name: f.default_factory for f in dataclasses.fields(cls)}
        found = {f.name: f.default for f in dataclasses.fields(cls)} | {
            name: make() for name, make in made.items() if make is not dataclasses.MISSING
        }
        return {name: v for name, v in found.items() if v is not dataclasses.MISSING}
    parameters = inspect.signature(cls).parameters.values()
    return {p.name: p.default for p in parameters if p.default is not p.empty}


def disagreeing(node: DictConfig) -> dict[str, tuple[Any, Any]]:
    """Lists keys whose value is not the class's default, with both values."""
    found = {}
    for key, default in defaults(get_class(node["_target_"])).items():
        if key not in node or OmegaConf.is_missing(node, key):
            continue
        value = node[key]
        if OmegaConf.is_config(value):
            value = instantiate(value, _convert_="all")
        if isinstance(value, list):
            value = type(default)(value)
        # Estimators of scikit-learn compare by identity; their repr shows what is not default.
        if value != default and repr(value) != repr(default):
            found[key] = (value, default)
    return found


def loaded(choice: str) -> DictConfig:
    """Loads a file of conf/, together with the keys of the base domain that it refers to."""
    group, _ = choice.split("/")
    root = OmegaConf.load(CONF / "domain" / "rescue.yaml")
    root[group] = with_parent(choice)[group] if group == "domain" else with_parent(choice)
    return root[group]


def with_parent(choice: str) -> DictConfig:
    """Merges a file into the file of the same group that it changes, if any."""
    own = OmegaConf.load(CONF / f"{choice}.yaml")
    parents = [one for one in own.pop("defaults", ()) if isinstance(one, str) and one != "_self_"]
    above = [with_parent(f"{choice.split('/')[0]}/{one}") for one in parents]
    return OmegaConf.merge(*above, own)


@pytest.mark.parametrize("choice", sorted(set(CHOICES) - VARIANTS))
def test_a_default_of_a_class_is_that_of_its_file(choice: str) -> None:
    for node in components(loaded(choice)):
        assert disagreeing(node) == {}, node["_target_"]


@pytest.mark.parametrize("choice", sorted(VARIANTS))
def test_a_variant_varies(choice: str) -> None:
    assert any(disagreeing(node) for node in components(loaded(choice)))


def test_a_default_that_differs_is_seen() -> None:
    node = loaded("clusterer/dirichlet")
    node.chains = 5
    assert disagreeing(node) == {"chains": (5, 4)}


@pytest.mark.parametrize(
    ("config", "key", "made", "elsewhere"),
    [
        # `server.file` names a file with the other keys, where `key` stands alone; `demo` is the
        # key `consent`.
        ("study", "server", Server, {"file", "demo", "key"}),
        ("collect", "server", Server, {"file", "demo", "key"}),
        ("config", "tracking", MLflow, set()),
    ],
)
def test_a_class_and_its_file_have_one_default(
    config: str, key: str, made: type, elsewhere: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("MLFLOW_TRACKING_URI", "MLFLOW_EXPERIMENT_NAME"):
        monkeypatch.delenv(name, raising=False)
    GlobalHydra.instance().clear()
    chosen = compose_config(config, [])[key]
    plain = OmegaConf.to_container(chosen, resolve=True)
    told = {str(name): plain[name] for name in plain if name not in {"_target_", *elsewhere}}
    assert told.keys() == {field.name for field in dataclasses.fields(made)} - elsewhere
    lists = {name: tuple(value) for name, value in told.items() if isinstance(value, list)}
    assert made(**{**told, **lists}) == made()


def test_the_schema_has_types_and_no_values() -> None:
    """Only the file has values."""
    file = OmegaConf.load(CONF / "config.yaml")
    typed = {str(key) for key in schema()} - {"outputs"}  # a folder: known at the start alone
    assert all(OmegaConf.is_missing(schema(), key) for key in typed)
    untyped = {str(key) for key in file} - typed
    assert untyped == {"defaults", "certify"}
