"""From a composed configuration to the values that the experiment takes."""

from __future__ import annotations

from hydra.utils import instantiate
from omegaconf import DictConfig

from xplain.experiment.explanations import Costs
from xplain.experiment.pipeline import Components


def components_of(cfg: DictConfig) -> Components:
    """The components that decide data, types and traces.

    Raises:
        XplainError, HydraException: a value that one of them refuses.
    """
    return Components(
        domain=instantiate(cfg.domain),
        users=instantiate(cfg.users),
        observers=instantiate(cfg.observers),
        queries=instantiate(cfg.queries),
        labeler=instantiate(cfg.labeler),
        clusterer=instantiate(cfg.clusterer),
        traces=cfg.traces,
        max_steps=cfg.max_steps,
        seed=cfg.seed,
    )


def costs_of(cfg: DictConfig) -> Costs:
    """λ and the other costs.

    Raises:
        InputError: one that no problem can have.
    """
    return Costs(
        trade_off=cfg["lambda"],
        message_cost=cfg.message_cost,
        inexplicability_cost=cfg.inexplicability_cost,
        discount=cfg.discount,
        discount_per=cfg.discount_per,
        prior=cfg.prior,
    )
