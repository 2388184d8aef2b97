"""Each choice lists every option of its class, and each default has one value: a default of a class
equals that of its YAML file."""

import dataclasses
import inspect
from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig, OmegaConf

from tests.configurations import composed
from xplain.experiment.config import CONF, compose_config, schema
from xplain.people.site import Server
from xplain.runs.mlflow import MLflow

GROUPS = ("labeler", "clusterer", "users", "observers", "queries", "belief", "solver")
DOMAIN = ("domain",)  # a domain chooses other defaults
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
GYM = {"domain/gym", "domain/taxi", "domain/cliff_walking", "domain/frozen_lake"}
CHOICES = {
    f"{group}/{path.stem}": number
    for group in GROUPS + DOMAIN
    for number, path in enumerate(sorted((CONF / group).glob("*.yaml")))
}
"""Each file, and its number in its group."""


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


NO_OPTION = {
    "name": "of a domain: the task is what it is called",
    "knows": "of a solver: which problem it is made for; the oracle's file does say it",
    "hypotheses": "of labeler=hypotheses: the observers' domain's, worked out once",
    "answers": "of labeler=hypotheses: how people err, learned with the types",
    "types": "of labeler=hypotheses: which types the answers come from, known with these",
    "evidence": "of labeler=hypotheses: how well hypotheses foretell answers, learned with them",
    "labeler": "of clusterer=…: what the group labeler chooses",
}
"""Parameters of shipped components that a file of conf/ may leave out, and why."""

UNUSED = {"labeler/hypotheses": {"confidence"}}
"""Inherited parameters without effect, by choice: hypotheses have their own confidence."""


TASK = "pkg://xplain/domains/pddl/tasks/blocks"
FILLED = {
    "observers/file": {"path": __file__},
    "users/explicit": {"groups": "{A: [fire]}"},
    "domain/gym": {
        "name": "lake",
        "id": "FrozenLake-v1",
        "states": "{row: 4, column: 4}",
        "actions": "[left, down, right, up]",
        "parameters": "{ice: {inaccurate: [{add: -1.0}], message: no ice}}",
    },
    "domain/pddl": {
        "file": f"{TASK}/domain.pddl",
        "problem": f"{TASK}/problem.pddl",
        "believed": f"{TASK}/believed.pddl",
    },
}
"""Keys without a value in their files."""


@cache
def compose_each(number: int, groups: tuple[str, ...]) -> DictConfig:
    """Composes a choice of every group together, because composing takes long."""
    words = []
    for group in groups:
        own = [choice for choice in CHOICES if choice.startswith(f"{group}/")]
        choice = own[number % len(own)]
        filled = FILLED.get(choice, {})
        words += [choice.replace("/", "="), *(f"{group}.{key}={filled[key]}" for key in filled)]
    return composed(*words)


@pytest.mark.parametrize("choice", CHOICES)
def test_a_choice_lists_every_option_of_its_class_with_its_default(choice: str) -> None:
    if choice in GYM:
        pytest.importorskip("gymnasium", reason="pip install 'xplain-hri[gym]'")
    group, filled = choice.split("/")[0], FILLED.get(choice, {})
    node = compose_each(CHOICES[choice], DOMAIN if group in DOMAIN else GROUPS)[group]
    options = {key: node[key] for key in node if not key.startswith("_")}
    component = instantiate(node)
    left_out = inspect.signature(type(component)).parameters.keys() - options.keys()
    assert left_out <= NO_OPTION.keys() | UNUSED.get(choice, set())
    for key, value in options.items():
        # None leaves the value to the component; a domain's ``starts`` are states made of it.
        plain = isinstance(value, bool | int | float | str) and key != "starts"
        if plain and hasattr(component, key):
            assert getattr(component, key) == value, key
    own = {key: one for part in components(node) for key, one in disagreeing(part).items()}
    assert bool(own.keys() - filled.keys()) == (choice in VARIANTS), own


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
