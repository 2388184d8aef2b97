"""The analysis of a study (``study analyse``), and the document to register before the first
participant (``study preregister``). The document follows from the plan alone, so the registered
study is the study that runs."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from rich.table import Column, Table
from scipy import special, stats

from xplain.errors import InputError, one_of
from xplain.people.flow import STREAMS
from xplain.people.study.flow import ENDS, Study
from xplain.people.study.plan import ASKING, CONFORMANT, PERSONALIZED, StudyPlan
from xplain.randomness import derive_seed

CONDITIONS = (CONFORMANT, PERSONALIZED)
"""The conditions that the paper compares."""
COMPARED = {"table2": CONDITIONS, "asking": (PERSONALIZED, ASKING)}
"""Compared conditions by the name of the table; the second table is only for studies with
questions."""
MEASURES = {
    "interaction_time_s": "Interaction time (s)",
    "inexplicable_transitions": "Inexplicable transitions",
    "quiz_score": "Quiz score",
}
SECONDARY = {
    "visible_time_s": "Interaction time while visible (s)",
    "messages_given": "Messages",
    "messages_again": "Messages said again",
    "questions_asked": "Questions",
    "cost": "Cost",
}
"""Measures that are reported only if they are known for all participants."""
NEEDED = ("participant", "stream", "stage", "type", "condition", "eligible", *MEASURES)
PERMUTATIONS = 10_000


@dataclass(frozen=True)
class Analysis:
    """All reported results of one comparison.

    Attributes:
        conditions: the two compared conditions; a difference is the first minus the second.
        stream: kind of the analysed participants: "person", "pilot" or "bot". Kinds are never
            mixed.
        measures: one row for each measure, the three primary measures first. The columns are the
            figures of :func:`compare`, named after the conditions; ``student_p_holm``, the
            corrected p of the primary measures; and ``paper_…``, the paper's figures.
        flow: numbers of participants, as in :func:`_count_flow`.
        data: table of the analysed participants: those who finished and are not excluded.
    """

    conditions: tuple[str, str]
    stream: str
    measures: pd.DataFrame
    flow: pd.DataFrame
    data: pd.DataFrame


@cache
def paper_table() -> pd.DataFrame:
    """Reads the paper's Table 2: a row for each measure, with the columns conformant, personalized,
    p_value and n_per_arm."""
    with files("xplain.people.study").joinpath("paper_table2.csv").open() as file:
        return pd.read_csv(file, index_col="measure").astype(float)


def _read_table(key: str, path: Path, columns: Sequence[str]) -> pd.DataFrame:
    wanted = f"a CSV file with the columns {', '.join(columns)}"
    if not path.is_file():
        raise InputError(key, str(path), wanted)
    table = pd.read_csv(path, encoding="utf-8-sig")
    if missing := [column for column in columns if column not in table]:
        raise InputError(key, str(path), f"{wanted}; it lacks the column {missing[0]}")
    return table


def read(folder: Path) -> pd.DataFrame:
    """Reads the table of participants of an export.

    Raises:
        InputError: the table or a column is missing.
    """
    return _read_table("data", folder / "participants.csv", NEEDED)


def exclusions(path: Path | None) -> dict[str, str]:
    """Reads {participant: reason} from a CSV with these two columns.

    Raises:
        InputError: the file or a column is missing.
    """
    if path is None:
        return {}
    table = _read_table("exclude", path, ("participant", "reason"))
    return dict(zip(table["participant"], table["reason"].fillna("").astype(str), strict=True))


def analyse_all(
    data: pd.DataFrame, stream: str, excluded: Mapping[str, str], seed: int = 0
) -> dict[str, Analysis]:
    """Compares the paper's two conditions. If the study also has the asking condition, compares the
    personalized condition with the asking condition too.

    Returns:
        The analyses by their names in ``COMPARED``. Each analysis corrects its p values for its own
        three primary measures.
    """
    met = set(data.loc[(data["stream"] == stream) & (data["stage"] == "done"), "condition"])
    return {
        name: analyse(data, stream, excluded, seed, pair)
        for name, pair in COMPARED.items()
        if pair == CONDITIONS or ASKING in met
    }


def analyse(
    data: pd.DataFrame,
    stream: str,
    excluded: Mapping[str, str],
    seed: int = 0,
    conditions: tuple[str, str] = CONDITIONS,
) -> Analysis:
    """Compares two conditions.

    Args:
        data: table of participants.
        stream: kind of participants: "person", "pilot" or "bot"; only their rows are used.
        excluded: {participant: reason}, decided before looking at the results.
        seed: seed of the permutation tests.
        conditions: the two conditions.

    Raises:
        InputError: a kind, participant or condition is unknown, or there are too few participants.
    """
    one_of("stream", stream, STREAMS)
    for who in excluded:
        if who not in set(data["participant"]):
            raise InputError("exclude", who, "a participant in the data")
    own = data[data["stream"] == stream]
    done = own[own["stage"] == "done"]
    for condition in set(done["condition"]):
        one_of("condition", condition, (*CONDITIONS, ASKING))
    done = done[done["condition"].isin(conditions)]
    if "attention_missed" in done:
        missed = done.loc[done["attention_missed"] > 0, "participant"]
        excluded = dict.fromkeys(missed, "attention check missed") | dict(excluded)
    reasons = done["participant"].map(excluded)
    kept = done[reasons.isna()]
    counts = {c: int((kept["condition"] == c).sum()) for c in conditions}
    if min(counts.values()) < 2:
        wanted = f"at least 2 completed participants (stream {stream}) in each condition"
        raise InputError("data", counts, wanted)
    left = () if ASKING in conditions else ("questions_asked",)
    shown = [m for m in SECONDARY if m in kept and m not in left and kept[m].notna().all()]
    found = {m: _compare_measure(kept, m, conditions, seed) for m in (*MEASURES, *shown)}
    measures = pd.DataFrame.from_dict(found, orient="index").rename_axis("measure")
    adjusted = pd.Series(holm(measures.loc[[*MEASURES], "student_p"]), [*MEASURES])
    measures.insert([*measures.columns].index("hedges_g"), "student_p_holm", adjusted)
    if conditions == CONDITIONS:
        measures = measures.join(paper_table().add_prefix("paper_"))
    left_out = {f"excluded: {one}": reasons == one for one in dict.fromkeys(reasons.dropna())}
    if kept["interaction_time_s"].isna().any():
        left_out["time left out: the clock was set back"] = kept["interaction_time_s"].isna()
    left_out["analysed"] = reasons.isna()
    return Analysis(conditions, stream, measures, _count_flow(own, left_out), kept)


def _compare_measure(
    data: pd.DataFrame, measure: str, conditions: tuple[str, str], seed: int
) -> dict[str, float]:
    """Returns the figures of :func:`compare` for one measure. The groups are the participants of
    the two conditions, whose names are part of the figures' names."""
    data = data.dropna(subset=[measure])  # impossible times are left out
    a, b = (data[data["condition"] == condition] for condition in conditions)
    types_a, types_b = (group["type"].astype(str).tolist() for group in (a, b))
    drawn = derive_seed(seed, "permutation", measure)
    return compare(a[measure], b[measure], types_a, types_b, drawn, conditions)


def _count_flow(own: pd.DataFrame, ends: Mapping[str, pd.Series[bool]]) -> pd.DataFrame:
    """Makes a table of numbers of participants. Its columns are all participants and each
    condition. Its rows are each stage that participants reached, each way in which participation
    ended, and the counts of ``ends``.

    Args:
        own: table of all participants of one kind (person, pilot or bot).
        ends: {name of a further row: True for each counted participant}, such as each reason for
            exclusion. Participants without a value are not counted.
    """
    everybody = own["participant"].notna()
    reached = {
        "entered": everybody,
        "consented": own["condition"].notna(),
        "eligible": own["eligible"] == 1,
        "evaluated": own["inexplicable_transitions"].notna(),
        "completed": own["stage"] == "done",
        **{end.replace("_", " "): own["stage"] == end for end in ENDS},
        "still on their way": ~own["stage"].isin(["done", *ENDS]),
        **{name: who.reindex(own.index, fill_value=False) for name, who in ends.items()},
    }
    asking = (ASKING,) if (own["condition"] == ASKING).any() else ()
    of = {"all": everybody} | {c: own["condition"] == c for c in (*CONDITIONS, *asking)}
    counted = {
        whose: {stage: int((who & theirs).sum()) for stage, who in reached.items()}
        for whose, theirs in of.items()
    }
    return pd.DataFrame(counted).rename_axis("stage")


# Statistics -------------------------------------------------------------------------------------


def compare(
    a: ArrayLike,
    b: ArrayLike,
    strata_a: Sequence[str],
    strata_b: Sequence[str],
    seed: int,
    names: tuple[str, str] = ("a", "b"),
) -> dict[str, float]:
    """Compares group a with group b.

    Args:
        a, b: the measure of each participant.
        strata_a, strata_b: the user type of each participant; groups are permuted only within a
            type.
        seed: seed of the permutations.
        names: names of the groups.

    Returns:
        ``n_…``, ``mean_…`` and ``sd_…`` of each group; t, df and p of Student's test (the paper's
        test) and of Welch's test, two-sided; Hedges' g of a − b with its 95 % interval; p of the
        permutation test. Figures are NaN if a group is too small or has no variance.
    """
    groups = [pd.Series(np.asarray(values, dtype=float)) for values in (a, b)]
    x, y = groups
    found: dict[str, float] = {
        f"{figure}_{name}": group.agg(how)
        for name, group in zip(names, groups, strict=True)
        for figure, how in (("n", "size"), ("mean", "mean"), ("sd", "std"))
    }
    varies = min(len(x), len(y)) > 1 and (np.ptp(x) > 0 or np.ptp(y) > 0)
    for test, equal in (("student", True), ("welch", False)):
        figures = (np.nan,) * 3
        if varies:
            with warnings.catch_warnings():
                # A group without variance: all participants got the same messages.
                warnings.filterwarnings("ignore", "Precision loss", RuntimeWarning)
                t = stats.ttest_ind(x, y, equal_var=equal)
            figures = (float(t.statistic), float(t.df), float(t.pvalue))
        found |= dict(zip((f"{test}_t", f"{test}_df", f"{test}_p"), figures, strict=True))
    g = hedges(found["student_t"], len(x), len(y)) if varies else (np.nan,) * 3
    found |= dict(zip(("hedges_g", "g_low", "g_high"), g, strict=True))
    strata = np.array(strata_a), np.array(strata_b)
    p = stratified_permutation(x.to_numpy(), y.to_numpy(), *strata, seed)
    return found | {"permutation_p": p}


def hedges(t: float, n_a: int, n_b: int, level: float = 0.95) -> tuple[float, float, float]:
    """Computes Hedges' g from Student's t of two groups.

    The small-sample factor is exact, J = Γ(ν/2) / (√(ν/2) Γ((ν − 1)/2)) with ν = n_a + n_b − 2
    degrees of freedom (Hedges 1981).

    Args:
        t: Student's t.
        n_a, n_b: numbers of participants in the groups.
        level: level of the interval.

    Returns:
        g, and the low and high end of its exact interval from the noncentral t distribution.
    """
    df, scale = n_a + n_b - 2, np.sqrt(1 / n_a + 1 / n_b)
    correction = np.exp(special.gammaln(df / 2) - special.gammaln((df - 1) / 2)) / np.sqrt(df / 2)
    tail = (1 - level) / 2
    to_g = float(correction * scale)
    # Computed for |t|, where the function is accurate, and then mirrored.
    low, high = (to_g * special.nctdtrinc(df, [1 - tail, tail], abs(t))).tolist()
    return (t * to_g, low, high) if t >= 0 else (t * to_g, -high, -low)


def holm(p: ArrayLike) -> NDArray[np.float64]:
    """Computes Holm's step-down adjusted p values. NaN stays NaN and does not count as a test.

    Args:
        p: [n] p values of n tests.

    Returns:
        [n] the adjusted p values, in the order of ``p``.
    """
    values = np.asarray(p, dtype=float)
    order = np.argsort(values)  # NaN last
    steps = (~np.isnan(values)).sum() - np.arange(len(values))
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(values[order] * steps))
    return adjusted


def stratified_permutation(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    strata_x: NDArray[np.str_],
    strata_y: NDArray[np.str_],
    seed: int,
    permutations: int = PERMUTATIONS,
) -> float:
    """Computes the two-sided p of the difference between the means of two groups. Participants are
    permuted between the groups, but only within a stratum (a user type).

    The test is valid because the study assigns conditions at random within each type. The result is
    p = (1 + number of permutations with a difference at least as large) / (1 + number of
    permutations), so p is never 0.

    Args:
        x, y: the measure of each participant in the two groups.
        strata_x, strata_y: the stratum of each participant.
        seed: seed of the permutations.
        permutations: number of permutations.
    """
    if not len(x) or not len(y):
        return float("nan")
    values, strata = np.concatenate([x, y]), np.concatenate([strata_x, strata_y])
    rng = np.random.default_rng(seed)
    masks = np.tile(np.arange(len(values)) < len(x), (1 + permutations, 1))
    for stratum in np.unique(strata):
        where = np.flatnonzero(strata == stratum)
        masks[1:, where] = rng.permuted(masks[1:, where], axis=1)
    sums = masks @ values
    gaps = np.abs(sums / len(x) - (values.sum() - sums) / len(y))
    # Equal differences count as extreme despite rounding errors.
    slack = 1e-9 * (1 + np.abs(values).max())
    return float((gaps >= gaps[0] - slack).sum() / (1 + permutations))


TITLES = {**MEASURES, **SECONDARY}
LOOKS: dict[str, dict[str, Any]] = {
    "conformant": {"color": "#D55E00", "marker": "s"},
    "personalized": {"color": "#0072B2", "marker": "o"},
    "asking": {"color": "#00795A", "marker": "^"},
}
"""Colour and marker of each condition."""
TESTS = {
    "Student's\np": "student_p",
    "p, Holm": "student_p_holm",
    "Welch's\np": "welch_p",
    "Permutation\np": "permutation_p",
}
"""Columns of the terminal's table with p values."""
WHOSE = {"person": "participants", "pilot": "PILOTS", "bot": "SIMULATED PARTICIPANTS"}


def show(analysis: Analysis, console: Console) -> None:
    """Prints the tables on a terminal."""
    first, second = analysis.conditions
    published = analysis.conditions == CONDITIONS
    title = "Table 2" if published else "Questions between steps"
    rows = {
        TITLES[str(measure)]: _list_cells(row, analysis.conditions)
        for measure, row in analysis.measures.iterrows()
    }
    for frame, caption in (
        (
            pd.DataFrame(rows).T.fillna("").rename_axis("Measure"),
            f"{title}: {WHOSE[analysis.stream]} ({first} − {second})",
        ),
        (analysis.flow, "Flow of participants"),
    ):
        printed = Table(
            str(frame.index.name),
            *(Column(heading, justify="right", overflow="fold") for heading in frame.columns),
            title=caption,
        )
        for name, cells in frame.iterrows():
            printed.add_row(str(name), *map(str, cells))
        console.print(printed)


def _list_cells(row: pd.Series[float], conditions: tuple[str, str]) -> dict[str, str]:
    """Returns the cells of a measure's row in the terminal's table, by their headings."""
    cells = {
        f"{c.capitalize()}\nmean (SD), n": f"{row[f'mean_{c}']:.2f} ({row[f'sd_{c}']:.2f}), "
        f"{row[f'n_{c}']:.0f}"
        for c in conditions
    }
    for heading, test in TESTS.items():
        p = row[test]
        cells[heading] = "–" if math.isnan(p) else "< 0.001" if p < 0.001 else f"{p:.3f}"
    g = f"{row['hedges_g']:.2f} [{row['g_low']:.2f}, {row['g_high']:.2f}]"
    cells["Hedges' g [95 %]"] = "–" if math.isnan(row["hedges_g"]) else g
    if row.name in MEASURES and conditions == CONDITIONS:
        means = ", ".join(f"{row[f'paper_{c}']:g}" for c in CONDITIONS)
        cells["Paper: means, p"] = f"{means}, p = {row['paper_p_value']:g}"
    return cells


def save(analysis: Analysis, folder: Path, name: str = "table2") -> list[str]:
    """Writes the table and the flow as CSV, and the plot. Returns the names of the files."""
    folder.mkdir(parents=True, exist_ok=True)
    analysis.measures.to_csv(folder / f"{name}.csv")
    analysis.flow.to_csv(folder / "flow.csv")
    drawn = "measures.png" if name == "table2" else f"{name}.png"
    draw(analysis, folder / drawn)
    return [f"{name}.csv", "flow.csv", drawn]


def draw(analysis: Analysis, path: Path) -> None:
    """Draws all participants, the means with 95 % intervals, and the paper's means."""
    figure = Figure(figsize=(10.5, 4.2))
    rng = np.random.default_rng(0)
    for axis, measure in zip(figure.subplots(1, len(MEASURES)), MEASURES, strict=True):
        row = analysis.measures.loc[measure]
        for x, condition in enumerate(analysis.conditions):
            values = analysis.data.loc[analysis.data["condition"] == condition, measure].dropna()
            look = LOOKS[condition]
            aside = x + rng.uniform(-0.15, 0.15, len(values))
            axis.scatter(aside, values, s=16, alpha=0.5, linewidths=0, label="participants", **look)
            half = stats.t.ppf(0.975, max(len(values) - 1, 1)) * stats.sem(values)
            mean = {"label": "mean, 95 % interval", "linestyle": "", "markersize": 8, "capsize": 4}
            axis.errorbar(x + 0.3, values.mean(), half, **look, **mean)
            if analysis.conditions == CONDITIONS:
                axis.plot(x + 0.45, row[f"paper_{condition}"], "*", color="black", label="paper")
        axis.set(
            title=f"Hedges' g {row['hedges_g']:.2f} [{row['g_low']:.2f}, {row['g_high']:.2f}]",
            xticks=range(2),
            xticklabels=analysis.conditions,
            xlim=(-0.4, 1.6),
            ylabel=TITLES[measure],
        )
        axis.spines[["top", "right"]].set_visible(False)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    of_each = dict(zip(labels, handles, strict=True))
    figure.legend(of_each.values(), of_each, loc="upper center", ncols=3, frameon=False, fontsize=9)
    figure.tight_layout(rect=(0, 0, 1, 0.93))
    figure.savefig(path, dpi=160)


def document(plan: StudyPlan) -> str:
    """Writes hypotheses, design, measures, exclusions, analysis and sample size, in Markdown."""
    loader = PackageLoader("xplain.people.study")
    written = Environment(loader=loader, undefined=StrictUndefined, trim_blocks=True)
    return written.get_template("preregistration.md").render(
        plan=plan,
        asks=ASKING in plan.conditions,
        difference=Study.of(plan).difference(),
        primary=MEASURES,
        secondary=SECONDARY,
    )
