"""Domains and type sources from the configuration."""

import tempfile
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf

from xplain import Domain, Setting, stream
from xplain.experiment.config import CONF

PRIMARY = {
    "defaults": [
        "_self_",
        {"users": "random_cover"},
        {"queries": "independent"},
        {"labeler": "practice"},
        {"domain": "???"},
    ],
    "hydra": {"searchpath": [f"file://{CONF}"]},
    "seed": 0,
}


def configured(*overrides: str) -> Any:
    """Composes a domain: ``configured("domain=rescue").users`` are the types that it chooses."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "primary.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(PRIMARY)))
        with initialize_config_dir(folder, version_base="1.3"):
            return compose("primary", list(overrides))


@cache
def _arguments(name: str) -> Any:
    return OmegaConf.to_container(configured(f"domain={name}").domain, resolve=True)


def given(name: str) -> dict[str, Any]:
    """Returns a copy of the domain's arguments in the configuration."""
    return {k: deepcopy(v) for k, v in _arguments(name).items() if not k.startswith("_")}


@cache
def domain_of(*overrides: str) -> Domain:
    """Makes the domain of :func:`configured`."""
    domain: Domain = instantiate(configured(*overrides).domain)
    return domain


@cache
def setting_of(*overrides: str, seed: int = 0) -> Setting:
    """Makes the domain and its types."""
    types = instantiate(configured(*overrides).users)
    domain = domain_of(*overrides)
    return Setting.build(domain, types.types(domain, stream(seed, "users")))


def believed(domain: Any, *wrong: str) -> Any:
    """Makes the model of a person who believes these parameters incorrectly, or of the robot."""
    return domain.model(
        {p.name: p.inaccurate if p.name in wrong else p.accurate for p in domain.parameters}
    )
