"""The possible assumptions about how people listen and answer."""

from typing import Any

import pytest

from xplain.errors import InputError
from xplain.explanation.belief import Independent
from xplain.explanation.habits import habits_of


def test_rates_come_with_their_shares_among_people() -> None:
    """They may come from a user or from a plan in JSON; shares need not sum to 1."""
    for accept in ({1: 0.75, 0.8: 0.25}, {"1": 3, "0.8": 1}):
        found = habits_of(0.1, accept, 0.0)  # type: ignore[arg-type]
        assert (found.accept.tolist(), found.prior.tolist()) == ([1, 0.8], [0.75, 0.25])
    both = habits_of({0: 1, 0.2: 1}, {1: 3, 0.8: 1}, 0)
    assert both.shares("error") == {0: 0.5, 0.2: 0.5}
    assert both.shares("accept") == {0.8: 0.25, 1: 0.75}


@pytest.mark.parametrize(
    "accept", [0, 1.2, True, "often", {}, {1: 0}, {0: 1}, {0.5: -1}, {0.5: "x"}, {"x": 1}, [0.5]]
)
def test_what_is_no_rate_is_refused_with_what_is(accept: Any) -> None:
    with pytest.raises(InputError, match=r"^belief\.accept=.*\{rate: share, …\}"):
        Independent(accept=accept)
