"""How many participants? ``study power``: dry runs in the bare protocol.

Simulated participants of every type take part under all conditions; planned studies of n a
condition are drawn from them, and analysed as the real one will be (Student's t, Holm), also where
one condition asks. Beside the paper's comparison stands the power for the effects that the paper's
p values imply. What the simulated participants are like is an assumption: the second plot shows how
much each assumption matters.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.people.study.bot import Habits, take_part
from xplain.people.study.flow import Study
from xplain.people.study.report import figure_of, saved
from xplain.people.study.statistics import holm, student_p, t_power
from xplain.people.study.table2 import COMPARED, CONDITIONS, MEASURES, paper_effect
from xplain.randomness import stream

SIZES = (10, 20, 30, 40, 50, 60, 80)
SWEEPS: dict[str, tuple[float, ...]] = {
    "label_noise": (0.0, 0.03, 0.1, 0.2),
    "forgetting": (0.0, 0.05, 0.15, 0.3),
    "overload": (0.0, 0.03, 0.08, 0.15),
    "fading": (0.0, 0.1, 0.2, 0.4),
    "message_seconds": (0.0, 2.5, 5.0, 10.0),
    "spread": (0.1, 0.35, 0.7),
}
"""Assumptions that are varied one at a time, the others at their defaults."""
MARKS: dict[str, dict[str, Any]] = {
    "interaction_time_s": {"color": "#0072B2", "marker": "o", "linestyle": "-"},
    "inexplicable_transitions": {"color": "#D55E00", "marker": "s", "linestyle": "--"},
    "quiz_score": {"color": "#00795A", "marker": "^", "linestyle": "-."},
}


SimulatedCrowd = dict[str, NDArray[np.float64]]
"""{condition: [N, participants, 3] the measures in the order of MEASURES} of simulated people."""


def effect(pool: SimulatedCrowd, conditions: tuple[str, str] = CONDITIONS) -> NDArray[np.float64]:
    """[3] standardized difference, the first of two conditions − the second."""
    a, b = (pool[c].reshape(-1, len(MEASURES)) for c in conditions)
    spread = np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / 2)
    difference = a.mean(axis=0) - b.mean(axis=0)
    return np.divide(difference, spread, out=np.zeros_like(spread), where=spread > 0)


def compared(conditions: Iterable[str]) -> dict[str, tuple[str, str]]:
    """What the analysis compares of these conditions, by name.

    Raises:
        InputError: nothing.
    """
    met = {*conditions}
    found = {name: pair for name, pair in COMPARED.items() if met.issuperset(pair)}
    if not found:
        raise InputError("conditions", sorted(met), " and ".join(CONDITIONS))
    return found


def simulate(study: Study, habits: Habits, a_cell: int, seed: int) -> SimulatedCrowd:
    """``a_cell`` participants of each type under each condition of the plan, who reach the end.

    Raises:
        InputError: hardly anybody gets to the end with these habits.
    """
    pool = {}
    for condition in study.plan.conditions:
        of_types = []
        for user_type in range(len(study.plan.roles)):
            tried = (
                take_part(
                    study,
                    user_type,
                    condition,
                    habits,
                    stream(seed, "people", condition, user_type, index),
                )
                for index in range(20 * a_cell)
            )
            found = list(islice(filter(None, tried), a_cell))
            if len(found) < a_cell:
                raise InputError("habits", habits, "that let at least 1 in 20 get to the end")
            of_types.append([(one.seconds, one.inexplicable, one.score) for one in found])
        pool[condition] = np.array(of_types, dtype=float)
    return pool


def power(
    pool: SimulatedCrowd,
    n: int,
    studies: int,
    rng: np.random.Generator,
    alpha: float = 0.05,
    conditions: tuple[str, str] = CONDITIONS,
) -> NDArray[np.float64]:
    """Share of planned studies with n a condition (types as even as n allows) in which each
    measure is significant between two of them: [2, 3], plain and after Holm's correction."""
    drawn = []
    for condition in conditions:
        values = pool[condition]
        # n participants over N types: the remainder goes to types drawn anew in each study.
        order = rng.permuted(np.tile(np.arange(len(values)), (studies, 1)), axis=1)
        types = order[:, np.arange(n) % len(values)]
        drawn.append(values[types, rng.integers(values.shape[1], size=(studies, n))])
    p = student_p(drawn[0], drawn[1])
    return np.stack([(p < alpha).mean(axis=0), (holm(p) < alpha).mean(axis=0)])


def curves(pool: SimulatedCrowd, sizes: Sequence[int], studies: int, seed: int) -> pd.DataFrame:
    """Power by comparison, n and measure: simulated, and for the paper's effects where it has
    any."""
    tables, effects = [], [abs(paper_effect(measure)) for measure in MEASURES]
    for (name, pair), n in product(compared(pool).items(), sizes):
        rng = stream(seed, "studies", n)
        plain, corrected = power(pool, n, studies, rng, conditions=pair)
        own = {
            "comparison": name,
            "n_per_condition": n,
            "measure": [*MEASURES],
            "simulated": plain,
            "simulated_holm": corrected,
        }
        if pair == CONDITIONS:
            own["paper_effect"] = [t_power(d, n) for d in effects]
            # The hardest step of Holm's procedure, if the other two are no help.
            own["paper_effect_holm"] = [t_power(d, n, 0.05 / len(MEASURES)) for d in effects]
        tables.append(pd.DataFrame(own))
    return pd.concat(tables)


def sensitivity(
    study: Study, habits: Habits, a_cell: int, n: int, studies: int, seed: int
) -> pd.DataFrame:
    """Effect and power (Holm, n a condition) when one assumption is varied."""
    tables = []
    for assumption, value in [(one, value) for one, own in SWEEPS.items() for value in own]:
        pool = simulate(study, replace(habits, **{assumption: value}), a_cell, seed)
        for name, pair in compared(pool).items():
            _, corrected = power(pool, n, studies, stream(seed, "studies", n), conditions=pair)
            own = {
                "comparison": name,
                "assumption": assumption,
                "value": value,
                "measure": [*MEASURES],
                "effect": effect(pool, pair),
                "power_holm": corrected,
            }
            tables.append(pd.DataFrame(own))
    return pd.concat(tables)


def draw_curves(rows: pd.DataFrame, path: Path) -> None:
    """Power against n of one comparison: simulated, and the paper's effects where it has any."""
    figure, axes = figure_of(10.5, 3.8, 1, len(MEASURES), sharey=True)
    for axis, (measure, title) in zip(axes, MEASURES.items(), strict=True):
        own = rows[rows["measure"] == measure].dropna(axis="columns")
        for key, colour, style, label in (
            ("simulated", "#0072B2", "o-", "simulated"),
            ("simulated_holm", "#0072B2", "o--", "simulated, Holm"),
            ("paper_effect", "#D55E00", "s-", "paper's effect"),
            ("paper_effect_holm", "#D55E00", "s--", "paper's effect, α/3"),
        ):
            if key in own:
                inside = "white" if "holm" in key else colour
                look = {"color": colour, "mfc": inside, "label": label, "ms": 5}
                axis.plot(own["n_per_condition"], own[key], style, **look)
        axis.axhline(0.8, color="#888888", linewidth=1, linestyle=":")
        axis.axvline(20, color="#888888", linewidth=1, linestyle=":")
        axis.set_title(title, fontsize=10)
        axis.set(xlabel="participants a condition (paper: 20)", ylim=(0, 1.03))
    axes[0].set_ylabel("power (α = .05, two-sided)")
    saved(figure, path, columns=4)


def draw_sensitivity(
    rows: pd.DataFrame, path: Path, conditions: tuple[str, str] = CONDITIONS
) -> None:
    """The effect of each measure against each assumption, of one comparison."""
    figure, axes = figure_of(10.5, 6, 2, 3, sharey=True)
    for axis, assumption in zip(axes.flat, SWEEPS, strict=True):
        for measure, title in MEASURES.items():
            own = rows[(rows["assumption"] == assumption) & (rows["measure"] == measure)]
            axis.plot(own["value"], own["effect"], **MARKS[measure], label=title)
        axis.axhline(0, color="#888888", linewidth=1, linestyle=":")
        unit = " (s)" if assumption.endswith("seconds") else ""
        axis.set_xlabel(assumption.replace("_", " ") + unit)
    for axis in axes[:, 0]:
        axis.set_ylabel("d ({} − {})".format(*conditions))
    saved(figure, path, columns=3)


def write(study: Study, folder: Path, people: int, studies: int, n: int) -> pd.DataFrame:
    """Power curves and what they hang on, as tables and plots; the rows of the curves.

    Args:
        study: its plan and policies.
        folder: made where it is missing.
        people: simulated ones a cell.
        studies: planned studies a point.
        n: participants a condition, for the sensitivity.
    """
    seed, habits, pairs = study.plan.seed, Habits(), compared(study.plan.conditions)
    rows = curves(simulate(study, habits, people, seed), SIZES, studies, seed)
    swept = sensitivity(study, habits, max(2, people // 2), n, studies, seed)
    folder.mkdir(parents=True, exist_ok=True)
    rows.to_csv(folder / "power.csv", index=False)
    swept.to_csv(folder / "sensitivity.csv", index=False)
    for name, pair in pairs.items():
        own, varied = (table[table["comparison"] == name] for table in (rows, swept))
        suffix = "" if pair == CONDITIONS else f"_{name}"
        draw_curves(own, folder / f"power{suffix}.png")
        draw_sensitivity(varied, folder / f"sensitivity{suffix}.png", pair)
    return rows
