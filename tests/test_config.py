"""What a key is by default is said in conf/; where a class has to say it too, it says the same."""

from __future__ import annotations

from dataclasses import fields

import pytest
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from xplain.config import CONF, composed, schema
from xplain.participants.server.http import Server
from xplain.runs.mlflow import MLflow


@pytest.mark.parametrize(
    ("config", "key", "made"), [("study", "server", Server), ("config", "tracking", MLflow)]
)
def test_a_class_and_its_file_have_one_default(config, key, made, monkeypatch):
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    GlobalHydra.instance().clear()
    chosen = composed(config, [])[key]
    told = {name: chosen[name] for name in chosen if name != "_target_"}
    assert told.keys() == {field.name for field in fields(made)}
    assert made(**told) == made()


def test_the_schema_holds_the_values_of_the_file():
    """Types need a value beside them; the file's stands over it in a run."""
    file = OmegaConf.load(CONF / "config.yaml")
    assert isinstance(file, DictConfig)
    typed = {str(key) for key in schema()} - {"outputs"}  # a folder: known at the start alone
    assert {key: OmegaConf.to_container(schema())[key] for key in typed} == {
        key: OmegaConf.to_container(file)[key] for key in typed
    }
    untyped = {str(key) for key in file} - typed
    assert untyped == {"defaults", "hydra", "certify"}
