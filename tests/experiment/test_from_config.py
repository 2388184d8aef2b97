"""Values of a configuration: bad ones are found before any work, in any of the jobs."""

from typing import Any

import pytest
from hydra.errors import HydraException
from hydra.utils import instantiate

from tests.configurations import composed
from tests.refusals import refused
from xplain.errors import InputError
from xplain.experiment.fingerprint import configuration
from xplain.experiment.from_config import check, component, costs_of
from xplain.explanation.habits import PAPER

GOOD = configuration(composed("domain=four_rooms"))
BAD: list[tuple[str, Any]] = [
    ("lambda", -1.0),
    ("message_cost", -2.0),
    ("inexplicability_cost", -1.0),
    ("discount", 1.5),
    ("discount_per", "trace"),
    ("prior", "flat"),
    ("solver.memory_gib", -1.0),
    ("certify.gap", -1.0),
    ("clusterer.sweeps", 0),
    ("labeler.holdout", 2.0),
    ("observers.points", 0),
    ("queries.trace_length", 0),
    ("users.count", 0),
    ("domain.slip", 2.0),
]


@pytest.mark.parametrize(("key", "value"), BAD)
def test_a_bad_value_is_found_behind_jobs_that_are_good(key: str, value: Any) -> None:
    part, _, inside = key.rpartition(".")
    assert inside in (GOOD[part] if part else GOOD)
    change = {part: GOOD[part] | {inside: value}} if part else {key: value}
    with pytest.raises((InputError, HydraException), match=inside):
        check([GOOD, GOOD | change])


def test_types_that_do_not_fit_the_domain_are_found_behind_jobs_that_are_good() -> None:
    fact = instantiate(composed("domain=four_rooms").domain).parameters[0].name
    fits, other = (
        configuration(composed("domain=four_rooms", "users=explicit", f"users.groups={{A: [{j}]}}"))
        for j in (fact, "lava")
    )
    check([GOOD, fits])
    with pytest.raises(InputError, match="lava"):
        check([GOOD, fits, other])


@pytest.mark.parametrize(
    ("target", "options", "said"),
    [
        ("xplain.solvers.greedy.Nothing", {}, r"^solver\._target_=.*greedy has .*QMDP"),
        ("xplain.nowhere.QMDP", {}, r"^solver\._target_=.*finds no module 'xplain\.nowhere'"),
        ("xplain.solvers.greedy.QMDP", {"memory": 1}, r"^solver\.memory=1: .*takes memory_gib"),
        ("collections.OrderedDict", {}, "^solver='OrderedDict'.*lacks knows, plan"),
    ],
)
def test_a_component_that_cannot_be_made_is_refused_with_what_can(
    target: str, options: dict[str, Any], said: str
) -> None:
    with refused(said):
        component({"solver": {"_target_": target, **options}}, "solver")


def test_every_cost_is_the_one_of_its_key() -> None:
    given = {
        "lambda": 0.25,
        "message_cost": 3.0,
        "inexplicability_cost": 0.5,
        "discount": 0.75,
        "discount_per": "step",
        "prior": "observers",
    }
    costs = costs_of(composed("domain=four_rooms", *(f"{k}={v}" for k, v in given.items())))
    assert costs.trade_off == given.pop("lambda")
    assert {key: getattr(costs, key) for key in given} == given


@pytest.mark.parametrize(
    ("overrides", "rates"),
    [
        ((), (0, 1, 0)),
        (("explainee=slips", "explainee.rate=0.2"), (0.2, 1, 0)),
        (("explainee=heedless", "explainee.accept=0.7"), (0, 0.7, 0)),
        (("explainee=forgetful", "explainee.forget=0.3"), (0, 1, 0.3)),
        (("explainee=unseen",), (0, 1, 0)),
    ],
)
def test_who_is_told_knows_the_rates_of_these_users(
    overrides: tuple[str, ...], rates: tuple[float, ...]
) -> None:
    """``belief=told``: the rates of the simulated users, and no others."""
    told = instantiate(composed("belief=told", *overrides).belief).habits()
    assert (told.error.item(), told.accept.item(), told.forget.item()) == rates
    assert told.prior.tolist() == PAPER.prior.tolist()
