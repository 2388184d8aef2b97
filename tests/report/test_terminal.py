"""The policy's value on the terminal: its uncertainty, and notes about sampling error."""

from dataclasses import replace

import pytest

from tests.report import handmade
from xplain.cli.plan import describe_accuracy
from xplain.experiment.results import Figure
from xplain.report.terminal import print_certificates, print_summary


def test_a_run_is_printed_with_its_figures(capsys) -> None:
    """No found type fits users A, whose costs are 3 and 4 (on two traces)."""
    costs = {"solver": 3.0, "say_all": 5.0, "conformant": 4.0}
    episodes = tuple(
        replace(handmade.episode(solver, trace, kind, cost + trace + 2 * (fit > 0.4)), fit=fit)
        for solver, cost in costs.items()
        for trace in range(2)
        for kind, fit in (("A", 0.4), ("B", 0.5))
    )
    run = handmade.results("", {}, episodes)
    means = {"cost": Figure(3.5, 3.25, 3.75), "regret": Figure(0.5, None, None)}
    config = {**run.config, "traces": 2, "ask": {"cost": 0.5}}
    run = replace(run, metrics=means, config=config)
    asked = replace(run, choices={**run.choices, "ask": "cheap"})
    fits = tuple(replace(own, fit=1.0) for own in episodes)
    clumsy = replace(run, choices={**run.choices, "explainee": "clumsy"}, episodes=fits)
    for own, more, paper in (
        (run, "", True),
        (asked, "ask=cheap, κ = 0.5 · ", False),
        (clumsy, "explainee=clumsy · ", False),
    ):
        print_summary(own)
        heads = "measure mean 95 % interval" + paper * " paper"
        below = (
            "no found type fits 2 of 4 users; for these users the solver costs 3.50, giving "
            "all messages 5.50, and one explanation for all types 4.50"
            if own is not clumsy
            else "no found type fits 0 of 4 users"
        )
        assert " ".join(capsys.readouterr().out.split()) == (
            f"rescue · qmdp · λ = 1 · 2 traces × 2 types · {more}seed 0 user types found: 2, "
            f"adjusted Rand index 1.00 (kneedle) {heads} cost 3.500 3.250 … 3.750 regret (cost − "
            f"oracle's) 0.500 one trace{paper * ' 0.93'} {below}"
        )


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
