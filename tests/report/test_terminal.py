"""The policy's value on the terminal: its uncertainty, and notes about sampling error."""

import pytest

from xplain.cli.plan import describe_accuracy
from xplain.report.terminal import print_certificates

BOUNDS = {
    "traces": 2.0,
    "optimal_lower": -3.001,
    "optimal_upper": -3.0,
    "value_of_perfect_information_low": 0.5,
    "value_of_perfect_information_high": 0.501,
    "price_of_approximation_low": 0.0,
    "price_of_approximation_high": 0.1,
    "policy_cost": 4.0,
}


def shown(capsys, value: float, half: float, exact: float = 0.0) -> str:
    own = {"policy_value": value, "policy_value_exact": exact, "policy_value_se": half / 2}
    ends = {"policy_value_low": value - half, "policy_value_high": value + half}
    print_certificates(BOUNDS | own | ends)
    out: str = capsys.readouterr().out
    return next(line for line in out.splitlines() if "this policy" in line)


def test_a_simulated_value_beyond_the_proven_optimum_is_said_to_be_chance(capsys) -> None:
    below, above = shown(capsys, -3.05, 0.08), shown(capsys, -2.98, 0.08)
    assert "-3.0500 (± 0.0800)" in below
    assert "-2.9800 (± 0.0800, above the optimum by sampling error)" in above
    assert "(exact)" in shown(capsys, -3.05, 0.0, exact=1.0)


@pytest.mark.parametrize(("value", "chance"), [(-3.05, False), (-2.98, True)])
def test_a_comparison_of_solvers_says_so_too(value: float, chance: bool) -> None:
    row = {"value": value, "value_is": "simulated", "value_half_width": 0.08}
    for upper, expected in ((-3.0, chance), (None, False)):
        words = describe_accuracy(row | {"optimal_upper": upper})
        assert words.startswith("simulated ± 0.0800")
        assert ("by sampling error" in words) == expected
    assert describe_accuracy({"value": -3.0, "value_is": "exact", "optimal_upper": -3.0}) == "exact"


def test_what_certificates_are_not_about_is_said(capsys) -> None:
    print_certificates({**BOUNDS, "fresh_labels": 0.0})
    out = " ".join(capsys.readouterr().out.split())
    assert "this belief does not, so this policy has no certificate" in out
    assert "this policy -" not in out
    print_certificates(BOUNDS)
    assert "no certificate" not in capsys.readouterr().out
