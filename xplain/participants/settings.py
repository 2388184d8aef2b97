"""Which keys of conf/study.yaml or conf/collect.yaml make the plan."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig, OmegaConf

NOT_OF_THE_PLAN = ("database", "host", "port", "threads", "server", "outputs")
"""Keys that may change between two starts."""


def fixed(cfg: DictConfig) -> dict[str, Any]:
    """The resolved keys that make the plan."""
    plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    return {key: value for key, value in plain.items() if key not in NOT_OF_THE_PLAN}
