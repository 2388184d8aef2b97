"""Bad values are found before any work, in any of the jobs."""

from __future__ import annotations

from typing import Any

import pytest
from hydra.errors import HydraException
from hydra.utils import instantiate

from tests.configurations import composed
from xplain.errors import InputError
from xplain.experiment.fingerprint import configuration
from xplain.experiment.from_config import check, costs_of

GOOD = configuration(composed("domain=four_rooms"))
BAD: dict[str, Any] = {
    "lambda": -1.0,
    "message_cost": -2.0,
    "inexplicability_cost": -1.0,
    "discount": 1.5,
    "discount_per": "trace",
    "prior": "flat",
}


@pytest.mark.parametrize("key", BAD)
def test_a_bad_cost_is_found_behind_jobs_that_are_good(key: str) -> None:
    check([GOOD])
    with pytest.raises(InputError, match=key):
        check([GOOD, GOOD | {key: BAD[key]}])


def test_bad_parts_are_found_behind_jobs_that_are_good() -> None:
    for part, key, value in (
        ("solver", "memory_gib", -1.0),
        ("certify", "gap", -1.0),
        ("clusterer", "sweeps", 0),
        ("labeler", "holdout", 2.0),
        ("observers", "points", 0),
        ("queries", "trace_length", 0),
        ("users", "count", 0),
        ("domain", "slip", 2.0),
    ):
        assert key in GOOD[part], (part, key)
        with pytest.raises((InputError, HydraException), match=key):
            check([GOOD, GOOD | {part: GOOD[part] | {key: value}}])


def test_types_that_do_not_fit_the_domain_are_found_behind_jobs_that_are_good() -> None:
    fact = instantiate(composed("domain=four_rooms").domain).parameters[0].name
    fits, other = (
        configuration(composed("domain=four_rooms", "users=explicit", f"users.groups={{A: [{j}]}}"))
        for j in (fact, "lava")
    )
    check([GOOD, fits])
    with pytest.raises(InputError, match="lava"):
        check([GOOD, fits, other])


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
    assert costs.trade_off == 0.25
    assert costs.message_cost == 3.0
    assert costs.inexplicability_cost == 0.5
    assert costs.discount == 0.75
    assert costs.discount_per == "step"
    assert costs.prior == "observers"
