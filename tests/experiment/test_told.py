"""``belief=told``: the rates of the simulated users, and no others."""

from __future__ import annotations

import pytest
from hydra.utils import instantiate

from tests.configurations import composed
from xplain.explanation.habits import PAPER


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
    told = instantiate(composed("belief=told", *overrides).belief).habits()
    assert (told.error.item(), told.accept.item(), told.forget.item()) == rates
    assert told.prior.tolist() == PAPER.prior.tolist()
