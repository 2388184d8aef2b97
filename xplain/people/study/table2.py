"""The paper's Table 2 from exported data, with what should stand beside it."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

import pandas as pd

from xplain.errors import InputError, one_of
from xplain.people.analysis.stored import STREAMS
from xplain.people.study.flow import ENDS
from xplain.people.study.plan import ASKING, CONFORMANT, PERSONALIZED
from xplain.people.study.statistics import compare, d_from_p, holm
from xplain.randomness import derived_seed

CONDITIONS = (CONFORMANT, PERSONALIZED)
"""What the paper compares."""
COMPARED = {"table2": CONDITIONS, "asking": (PERSONALIZED, ASKING)}
"""Which conditions, by the name of the table: the second only in studies that ask."""
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
"""Shown where they are known of everybody."""
TITLES = {**MEASURES, **SECONDARY}
NEEDED = ("participant", "stream", "stage", "type", "condition", "eligible", *MEASURES)


@dataclass(frozen=True)
class Analysis:
    """Everything that is reported.

    Attributes:
        conditions: that are compared, the first less the second.
        stream: whose data: person, pilot or bot. Never mixed.
        measures: a row a measure, the three primary ones first (the others are not part of the
            correction): the figures of :func:`xplain.people.study.statistics.compare`, those of a
            group by its condition; ``student_p_holm``; and ``paper_…`` what the paper has there.
        flow: participants that reached a stage, those that came to an end, those that were
            excluded and why, and those that are analysed; of all and by condition.
        data: the completed, included participants.
    """

    conditions: tuple[str, str]
    stream: str
    measures: pd.DataFrame
    flow: pd.DataFrame
    data: pd.DataFrame


@cache
def paper_table() -> dict[str, dict[str, float]]:
    """The paper's Table 2: {measure: {conformant, personalized, p_value, n_per_arm}}."""
    text = files("xplain.people.study").joinpath("paper_table2.csv").read_text(encoding="utf-8")
    return {
        row["measure"]: {key: float(v) for key, v in row.items() if key != "measure"}
        for row in csv.DictReader(text.splitlines())
    }


def paper_effect(measure: str) -> float:
    """d (conformant − personalized) behind the paper's p value."""
    paper = paper_table()[measure]
    size = d_from_p(paper["p_value"], int(paper["n_per_arm"]))
    return size if paper["conformant"] > paper["personalized"] else -size


def read(folder: Path) -> pd.DataFrame:
    """The table of participants of an export.

    Raises:
        InputError: there is none, or a column is missing.
    """
    path = folder / "participants.csv"
    if not path.is_file():
        raise InputError("data", str(folder), "a folder with participants.csv, as exported")
    data = pd.read_csv(path)
    for column in NEEDED:
        if column not in data.columns:
            raise InputError("data", str(path), f"lacks the column {column}")
    return data


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
        stream: "person", "pilot" or "bot"; only these rows count.
        excluded: {participant: reason}, decided before looking at the results.
        seed: of the permutation tests.
        conditions: the two.

    Raises:
        InputError: an unknown stream, participant or condition, or nobody to analyse.
    """
    one_of("stream", stream, STREAMS)
    unknown = set(excluded) - set(data["participant"])
    if unknown:
        raise InputError("exclude", min(unknown), "a participant in the data")
    own = data[data["stream"] == stream]
    done = own[own["stage"] == "done"]
    known = (*CONDITIONS, ASKING)
    others = set(done["condition"]) - set(known)
    if others:
        raise InputError("condition", min(others), " or ".join(known))
    done = done[done["condition"].isin(conditions)]
    if "attention_missed" in done.columns:
        missed = done.loc[done["attention_missed"] > 0, "participant"]
        excluded = dict.fromkeys(missed, "attention check missed") | dict(excluded)
    reasons = done["participant"].map(excluded)
    kept = done[~done["participant"].isin(list(excluded))]
    if any((kept["condition"] == condition).sum() < 2 for condition in conditions):
        counts = {c: int((kept["condition"] == c).sum()) for c in conditions}
        raise InputError(
            "data", counts, f"at least 2 completed participants (stream {stream}) a condition"
        )
    told = [m for m in SECONDARY if m in kept and kept[m].notna().all()]
    if ASKING not in conditions:
        told = [m for m in told if m != "questions_asked"]
    found = {m: _compare(kept, m, conditions, seed) for m in (*MEASURES, *told)}
    measures = pd.DataFrame.from_dict(found, orient="index").rename_axis("measure")
    adjusted = pd.Series(holm(measures.loc[[*MEASURES], "student_p"]), [*MEASURES])
    measures.insert([*measures.columns].index("hedges_g"), "student_p_holm", adjusted)
    if conditions == CONDITIONS:
        measures = measures.join(pd.DataFrame(paper_table()).T.add_prefix("paper_"))
    left_out = {f"excluded: {one}": reasons == one for one in dict.fromkeys(reasons.dropna())}
    if kept["interaction_time_s"].isna().any():
        left_out["time left out: the clock was set back"] = kept["interaction_time_s"].isna()
    analysed = done["participant"].isin(kept["participant"])
    return Analysis(conditions, stream, measures, _flow(own, left_out, analysed), kept)


def analyses(
    data: pd.DataFrame, stream: str, excluded: Mapping[str, str], seed: int = 0
) -> dict[str, Analysis]:
    """:func:`analyse` of the paper's two conditions, and of asking where somebody was to be asked,
    by the names in COMPARED. Each corrects for its own three measures."""
    met = set(data.loc[(data["stream"] == stream) & (data["stage"] == "done"), "condition"])
    return {
        name: analyse(data, stream, excluded, seed, pair)
        for name, pair in COMPARED.items()
        if pair == CONDITIONS or ASKING in met
    }


def _compare(
    data: pd.DataFrame, measure: str, conditions: tuple[str, str], seed: int
) -> dict[str, float]:
    """The first condition against the second, the figures of each by its name."""
    data = data.dropna(subset=[measure])  # a time that cannot be is left out
    a, b = (data[data["condition"] == condition] for condition in conditions)
    types_a, types_b = (group["type"].astype(str).tolist() for group in (a, b))
    drawn = derived_seed(seed, "permutation", measure)
    return compare(a[measure], b[measure], types_a, types_b, drawn, conditions)


def _flow(
    own: pd.DataFrame, left_out: Mapping[str, pd.Series[bool]], analysed: pd.Series[bool]
) -> pd.DataFrame:
    """How many got how far, how the others ended, who is left out and why, and who is analysed.

    Args:
        own: participants of a stream.
        left_out: {reason: who}, of rows of ``own``; absent rows are False.
        analysed: the same.
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
    }
    for stage, who in {**left_out, "analysed": analysed}.items():
        reached[stage] = pd.Series(own.index.isin(who.index[who]), own.index)
    asking = (ASKING,) if (own["condition"] == ASKING).any() else ()
    of = {"all": everybody} | {c: own["condition"] == c for c in (*CONDITIONS, *asking)}
    counted = {
        whose: {stage: int((who & theirs).sum()) for stage, who in reached.items()}
        for whose, theirs in of.items()
    }
    return pd.DataFrame(counted).rename_axis("stage")
