"""From a composed configuration to the values that the experiment takes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from xplain.domains.base import Domain
from xplain.domains.users.setting import Setting
from xplain.experiment.cache import SOURCE
from xplain.experiment.certificates import Certify
from xplain.experiment.experiment import Experiment
from xplain.experiment.explanations import Costs
from xplain.experiment.pipeline import Components
from xplain.explanation.again import Again
from xplain.explanation.asking import Limits, Pool
from xplain.randomness import stream


def experiment_of(cfg: DictConfig) -> Experiment:
    """All that a run needs; made, and so checked, before any work.

    Raises:
        XplainError, HydraException: a value that a component refuses.
    """
    return Experiment(
        components=partial(components_of, cfg),
        costs=costs_of(cfg),
        solver=instantiate(cfg.solver),
        belief=instantiate(cfg.belief),
        explainee=instantiate(cfg.explainee),
        certify=Certify(**cfg.certify),
        seed=cfg.seed,
    )


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
        ask=Pool(tuple(cfg.ask.kinds), cfg.ask.clips) if cfg.ask.kinds else None,
    )


def costs_of(cfg: DictConfig) -> Costs:
    """λ and the other costs.

    Raises:
        InputError: one that no problem can have, or of a message that the domain does not have.
    """
    message_cost = cfg.message_cost
    if by_name := OmegaConf.is_config(message_cost):
        message_cost = OmegaConf.to_container(message_cost, resolve=True)
    costs = Costs(
        trade_off=cfg["lambda"],
        message_cost=message_cost,
        inexplicability_cost=cfg.inexplicability_cost,
        discount=cfg.discount,
        discount_per=cfg.discount_per,
        prior=cfg.prior,
        asking=Limits(cfg.ask.cost, cfg.ask.most, cfg.ask.when),
        again=Again(**cfg.again),
    )
    if by_name:  # before anything is learned
        costs.message_costs(tuple(p.name for p in instantiate(cfg.domain).parameters))
    return costs


COSTS = (
    "ask",
    "again",
    "lambda",
    "message_cost",
    "inexplicability_cost",
    "discount",
    "discount_per",
    "prior",
)
"""Keys that :func:`costs_of` reads, beside the domain's messages."""


def check(configurations: Iterable[Mapping[str, Any]]) -> None:
    """Instantiates all that resolved configurations name, and solves the task of each domain once
    as its types see it: so their values are checked before any work.

    Raises:
        XplainError, HydraException: a value that a component refuses, or a task without a way to
            its goal.
    """
    seen: set[str] = set()
    for config in configurations:
        for part, make in (
            ((*SOURCE, "ask"), components_of),
            (("solver",), lambda cfg: instantiate(cfg.solver)),
            (("belief",), lambda cfg: instantiate(cfg.belief)),
            (("explainee",), lambda cfg: instantiate(cfg.explainee)),
            (("certify",), lambda cfg: Certify(**cfg.certify)),
            (("domain", *COSTS), costs_of),
            (("domain", "users"), _solve),
        ):
            key = json.dumps([part, [config[name] for name in part]], sort_keys=True)
            if key not in seen:
                make(OmegaConf.create(dict(config)))
                seen.add(key)


def _solve(cfg: DictConfig) -> None:
    domain: Domain = instantiate(cfg.domain)
    Setting.build(domain, instantiate(cfg.users).types(domain, stream(cfg.seed, "users")))
