"""Power curves against theory, and what simulated participants do to them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from tests.people.study.stand_in import ASK, street_plan, street_study
from xplain.cli.main import main
from xplain.errors import InputError
from xplain.people.study.bot import Habits
from xplain.people.study.plan import ASKING, CONFORMANT, PERSONALIZED
from xplain.people.study.power import (
    SWEEPS,
    compared,
    curves,
    draw_curves,
    draw_sensitivity,
    effect,
    power,
    simulate,
)
from xplain.people.study.statistics import (
    t_power,
)
from xplain.people.study.table2 import MEASURES


def test_false_alarms_are_as_rare_as_promised() -> None:
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(5, 300, len(MEASURES)))
    pool = {"conformant": noise, "personalized": noise}
    plain, corrected = power(pool, 20, 4000, rng)
    assert (np.abs(plain - 0.05) < 0.015).all()
    assert corrected.max() < 0.03


def test_simulated_power_agrees_with_theory() -> None:
    rng = np.random.default_rng(4)
    a, b = rng.normal(0.7, 1, (1, 40_000, 3)), rng.normal(0, 1, (1, 40_000, 3))
    plain, corrected = power({"conformant": a, "personalized": b}, 20, 3000, rng)
    assert plain == pytest.approx(t_power(0.7, 20), abs=0.035)
    assert (corrected <= plain).all()


def test_types_beyond_an_even_share_are_drawn_anew_in_each_study_and_condition() -> None:
    """Types answer 0 and 1 for certain; of three people two are of one type. In half of the studies
    that is another type in the other condition: t = 1/√2, p = 0.52 (4 degrees of freedom)."""
    values = np.array([0.0, 1.0])[:, None, None] * np.ones((2, 10, len(MEASURES)))
    pool = {"conformant": values, "personalized": values}
    plain, _ = power(pool, 3, 4000, np.random.default_rng(6), alpha=0.6)
    # Within four standard deviations of a binomial.
    assert plain == pytest.approx(0.5, abs=4 * (0.25 / 4000) ** 0.5)


def test_what_people_forget_changes_what_the_study_would_find() -> None:
    study = street_study()
    perfect = simulate(study, Habits(0, 0, 0, 0, mistake=0), 20, seed=0)
    overloaded = simulate(study, Habits(0, 0, 0.4, 0, mistake=0), 20, seed=0)
    slow = simulate(study, Habits(message_seconds=30, spread=0.1), 20, seed=0)
    fast = simulate(study, Habits(message_seconds=0, spread=0.1), 20, seed=0)
    inexplicable = list(MEASURES).index("inexplicable_transitions")
    for condition in ("conformant", "personalized"):
        better, worse = (p[condition][..., inexplicable].mean() for p in (perfect, overloaded))
        assert better < worse
        assert fast[condition][..., 0].mean() < slow[condition][..., 0].mean()
    # Whoever needs long for a message gains most from getting fewer of them.
    assert effect(slow)[0] > effect(fast)[0]
    with pytest.raises(InputError):
        simulate(study, Habits(mistake=1), 2, seed=0)
    with pytest.raises(InputError):
        Habits(label_noise=2)


@pytest.mark.parametrize("habit", SWEEPS)
def test_assumptions_are_varied_upwards_around_their_default(habit: str) -> None:
    values = SWEEPS[habit]
    assert list(values) == sorted(set(values))
    assert values[0] <= getattr(Habits(), habit) <= values[-1]
    Habits(**{habit: values[0]})
    Habits(**{habit: values[-1]})


def test_pictures_show_every_figure_at_its_place(tmp_path: Path, drawn: list[Figure]) -> None:
    rng = np.random.default_rng(5)
    rows = [
        {"assumption": assumption, "value": value, "measure": measure, "effect": rng.normal()}
        for assumption, values in SWEEPS.items()
        for value in values
        for measure in MEASURES
    ]
    draw_sensitivity(pd.DataFrame(rows), tmp_path / "sensitivity.png")
    for axis, (assumption, values) in zip(drawn[0].axes, SWEEPS.items(), strict=True):
        assert axis.get_xlabel().startswith(assumption.replace("_", " "))
        *lines, nothing = axis.lines
        for line, (measure, title) in zip(lines, MEASURES.items(), strict=True):
            own = (row for row in rows if row["assumption"] == assumption)
            effects = [row["effect"] for row in own if row["measure"] == measure]
            assert (list(line.get_xdata()), list(line.get_ydata())) == (list(values), effects)
            assert line.get_label() == title
        assert list(nothing.get_ydata()) == [0, 0]


def test_curves_show_every_figure_under_the_name_of_its_measure(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    rng = np.random.default_rng(6)
    kinds = ("simulated", "simulated_holm", "paper_effect", "paper_effect_holm")
    rows = [
        {"measure": measure, "n_per_condition": n} | {kind: rng.random() for kind in kinds}
        for n in (10, 20, 40)
        for measure in MEASURES
    ]
    draw_curves(pd.DataFrame(rows), tmp_path / "power.png")
    for axis, (measure, title) in zip(drawn[0].axes, MEASURES.items(), strict=True):
        assert axis.get_title() == title
        own = [row for row in rows if row["measure"] == measure]
        for kind, line in zip(kinds, axis.lines, strict=False):
            assert list(line.get_xdata()) == [10, 20, 40]
            assert list(line.get_ydata()) == [row[kind] for row in own]


def test_a_condition_is_compared_with_the_one_that_the_analysis_compares_it_with() -> None:
    """Who is asked is as the others in time, half a deviation below them in labels, above in the
    quiz; the other two conditions are alike."""
    rng = np.random.default_rng(7)
    others = {c: rng.normal(0, 1, (1, 20_000, 3)) for c in (CONFORMANT, PERSONALIZED)}
    pool = {**others, ASKING: rng.normal([0, -0.5, 0.5], 1, (1, 20_000, 3))}
    rows = curves(pool, (40,), 2000, 0).set_index(["comparison", "measure"])
    assert [*compared(pool)] == ["table2", "asking"]
    assert effect(pool, (PERSONALIZED, ASKING)) == pytest.approx([0, 0.5, -0.5], abs=0.04)
    simulated = rows["simulated"].unstack("measure")[[*MEASURES]]
    t = t_power(0.5, 40)
    assert simulated.loc["asking"].tolist() == pytest.approx([0.05, t, t], abs=0.04)
    assert simulated.loc["table2"].tolist() == pytest.approx([0.05] * 3, abs=0.02)
    assert rows.loc["asking", "paper_effect"].isna().all()  # the paper asked nobody
    with pytest.raises(InputError, match="conformant and personalized"):
        compared([PERSONALIZED])


@pytest.mark.parametrize("asks", [False, True])
def test_the_command_prints_the_figures(
    asks: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = street_plan(ask=ASK) if asks else street_plan()
    monkeypatch.setattr("xplain.people.study.prepare.study_plan", lambda cfg: plan)
    out = tmp_path / "power"
    main(["study", "power", "--out", str(out), "--people", "4", "--studies", "20", "--n", "4"])
    said = capsys.readouterr().out
    found = pd.read_csv(out / "power.csv")
    assert ("personalized − asking: power" in said) == asks
    names = [["table2"], ["table2", "asking"]][asks]
    assert found["comparison"].unique().tolist() == names
    plots = {"power.png", "sensitivity.png"}
    plots |= {"power_asking.png", "sensitivity_asking.png"} if asks else set()
    assert {path.name for path in out.glob("*.png")} == plots
    found = found[found["comparison"] == "table2"]
    for row in found[found["n_per_condition"] == 50].itertuples():
        assert row.measure in said
        assert f"{row.paper_effect_holm:.2f}".rstrip("0") in said
