"""Makes the values of an experiment from a composed configuration."""

import json
from collections.abc import Iterable, Mapping
from functools import partial
from importlib import import_module
from inspect import signature
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import get_class

from xplain.domains.base import Domain
from xplain.domains.users.setting import Setting
from xplain.errors import InputError
from xplain.experiment.cache import SOURCE
from xplain.experiment.config import make_object
from xplain.experiment.experiment import Experiment
from xplain.experiment.explanations import Costs
from xplain.experiment.pipeline import Components
from xplain.explanation.asking import Limits, Pool
from xplain.randomness import stream
from xplain.solvers.base import Solver

Config = Mapping[str, Any]
"""A composed configuration, or a resolved one as plain values."""

KINDS: dict[str, type] = {"domain": Domain, "solver": Solver}
"""Base classes that are checked before any work, because other parts use them directly."""


def component(cfg: Config, group: str, **given: Any) -> Any:
    """Makes the component that a configuration chooses in a group. The arguments are the group's
    keys and ``given``.

    Raises:
        XplainError, HydraException: the class is missing or incomplete, or refuses a value.
    """
    try:
        made = make_object(cfg[group], _partial_=bool(given))
        made = made(**given) if given else made
    except TypeError as error:  # from a user's class with another constructor
        raise InputError(group, cfg[group].get("_target_"), f"a usable class ({error})") from None
    except InstantiationException as error:
        if isinstance(error.__cause__, ImportError):
            _require_class(f"{group}._target_", str(cfg[group].get("_target_")))
        if isinstance(error.__cause__, TypeError):
            _require_parameters(group, cfg[group])
        raise
    kind = KINDS.get(group, object)
    if not isinstance(made, kind):
        wanted = {*dir(kind), *kind.__annotations__}
        lacks = sorted(n for n in wanted if not n.startswith("_") and not hasattr(made, n))
        allowed = f"a {group}; this class lacks {', '.join(lacks)} (xplain.testing tests a class)"
        raise InputError(group, type(made).__qualname__, allowed)
    return made


def _require_class(key: str, target: str) -> None:
    """Checks that a dotted name is a class; the error lists the existing names.

    Raises:
        InputError: the name does not exist.
    """
    module, _, name = target.rpartition(".")
    try:
        found = vars(import_module(module))
    except ModuleNotFoundError as error:
        allowed = f"a class; Python finds no module {error.name!r}"
        raise InputError(key, target, allowed) from None
    except (ImportError, ValueError):
        return  # a class inside a class, or an error inside the module
    if name not in found:
        own = (n for n, one in found.items() if getattr(one, "__module__", None) == module)
        allowed = f"a class; {module} has {', '.join(own) or 'none'}"
        raise InputError(key, target, allowed) from None


def _require_parameters(group: str, node: Config) -> None:
    """Checks that a file gives only parameters that the class has; the error lists the parameters.

    Raises:
        InputError: an unknown parameter.
    """
    takes = signature(get_class(node["_target_"])).parameters
    for key in node:
        if key not in takes and not key.startswith("_"):
            allowed = f"no parameter of {node['_target_']}; it takes {', '.join(takes)}"
            raise InputError(f"{group}.{key}", node[key], allowed)


def experiment_of(cfg: Config) -> Experiment:
    """Makes everything that a run needs, so that all values are checked before any work.

    Raises:
        XplainError, HydraException: a component refuses a value.
    """
    return Experiment(
        components=partial(components_of, cfg),
        costs=costs_of(cfg),
        solver=component(cfg, "solver"),
        belief=component(cfg, "belief"),
        explainee=component(cfg, "explainee"),
        certify=component(cfg, "certify"),
        seed=cfg["seed"],
    )


def components_of(cfg: Config) -> Components:
    """Makes the components that decide data, types and traces.

    Raises:
        XplainError, HydraException: a component refuses a value.
    """
    trainer, ask = component(cfg, "labeler"), cfg["ask"]
    return Components(
        domain=component(cfg, "domain"),
        users=component(cfg, "users"),
        observers=component(cfg, "observers"),
        queries=component(cfg, "queries"),
        labeler=trainer,
        clusterer=component(cfg, "clusterer", labeler=trainer),
        traces=cfg["traces"],
        max_steps=cfg["max_steps"],
        seed=cfg["seed"],
        ask=Pool(tuple(ask["kinds"]), ask["clips"]) if ask["kinds"] else None,
    )


def costs_of(cfg: Config) -> Costs:
    """Makes λ and the other costs.

    Raises:
        InputError: an invalid cost, or a cost of an unknown message.
    """
    message_cost, ask = cfg["message_cost"], cfg["ask"]
    by_name = isinstance(message_cost, Mapping)
    costs = Costs(
        trade_off=cfg["lambda"],
        message_cost=dict(message_cost) if by_name else message_cost,
        inexplicability_cost=cfg["inexplicability_cost"],
        discount=cfg["discount"],
        discount_per=cfg["discount_per"],
        prior=cfg["prior"],
        asking=Limits(ask["cost"], ask["most"], ask["when"]),
    )
    if by_name:  # so that an unknown name is an error before learning
        costs.message_costs(tuple(p.name for p in component(cfg, "domain").parameters))
    return costs


COSTS = (
    "ask",
    "lambda",
    "message_cost",
    "inexplicability_cost",
    "discount",
    "discount_per",
    "prior",
)
"""Keys that :func:`costs_of` reads, besides the domain's messages."""


def check(configurations: Iterable[Mapping[str, Any]]) -> None:
    """Instantiates all components of resolved configurations, and solves each domain's task once
    for each type, so that values are checked before any work.

    Raises:
        XplainError, HydraException: a component refuses a value, or a task has no path to its goal.
    """
    seen: set[str] = set()
    for config in configurations:
        for part, make in (
            ((*SOURCE, "ask"), components_of),
            (("solver",), lambda cfg: component(cfg, "solver")),
            (("belief",), lambda cfg: component(cfg, "belief")),
            (("explainee",), lambda cfg: component(cfg, "explainee")),
            (("certify",), lambda cfg: component(cfg, "certify")),
            (("domain", *COSTS), costs_of),
            (("domain", "users"), _solve_task),
        ):
            key = json.dumps([part, [config[name] for name in part]], sort_keys=True)
            if key not in seen:
                make(config)
                seen.add(key)


def _solve_task(cfg: Config) -> None:
    domain: Domain = component(cfg, "domain")
    Setting.build(domain, component(cfg, "users").types(domain, stream(cfg["seed"], "users")))
