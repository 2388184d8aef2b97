"""The paper's Table 2 from exported data, with what should stand beside it."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from xplain.errors import InputError
from xplain.participants.stored import STREAMS
from xplain.randomness import derived_seed
from xplain.study.analysis.statistics import Comparison, compare, holm
from xplain.study.protocol.machine import ENDS

if TYPE_CHECKING:
    import pandas as pd

CONDITIONS = ("conformant", "personalized")
MEASURES = {
    "interaction_time_s": "Interaction time (s)",
    "inexplicable_transitions": "Inexplicable transitions",
    "quiz_score": "Quiz score",
}
SECONDARY = {
    "visible_time_s": "Interaction time while visible (s)",
    "messages_given": "Messages",
}
STAGES = ("entered", "consented", "eligible", "evaluated", "completed")
NEEDED = ("participant", "stream", "stage", "type", "condition", "eligible", *MEASURES, *SECONDARY)


@dataclass(frozen=True)
class Row:
    """One measure: ours, the p values after Holm's correction, and the paper's."""

    measure: str
    title: str
    ours: Comparison
    holm_p: float
    paper: Mapping[str, float] | None


@dataclass(frozen=True)
class Analysis:
    """Everything that is reported.

    Attributes:
        stream: whose data: person, pilot or bot. Never mixed.
        rows: the three measures, then the secondary ones (not part of the correction).
        flow: [(stage, {condition or "all": number})] of participants, then the ends.
        excluded: {reason: number} of completed participants that were left out.
        data: the completed, included participants.
    """

    stream: str
    rows: tuple[Row, ...]
    flow: tuple[tuple[str, Mapping[str, int]], ...]
    excluded: Mapping[str, int]
    data: pd.DataFrame


@cache
def paper_table() -> dict[str, dict[str, float]]:
    """The paper's Table 2: {measure: {conformant, personalized, p_value, n_per_arm}}."""
    text = files("xplain.study.analysis").joinpath("paper_table2.csv").read_text(encoding="utf-8")
    return {
        row["measure"]: {key: float(v) for key, v in row.items() if key != "measure"}
        for row in csv.DictReader(text.splitlines())
    }


def read(folder: Path) -> pd.DataFrame:
    """The table of participants of an export.

    Raises:
        InputError: there is none, or a column is missing.
    """
    import pandas as pd

    path = folder / "participants.csv"
    if not path.is_file():
        raise InputError("data", str(folder), "a folder with participants.csv, as exported")
    data = pd.read_csv(path)
    for column in NEEDED:
        if column not in data.columns:
            raise InputError("data", str(path), f"lacks the column {column}")
    return data


def analyse(
    data: pd.DataFrame, stream: str, excluded: Mapping[str, str], seed: int = 0
) -> Analysis:
    """Compares the conditions.

    Args:
        data: table of participants.
        stream: "person", "pilot" or "bot"; only these rows count.
        excluded: {participant: reason}, decided before looking at the results.
        seed: of the permutation tests.

    Raises:
        InputError: an unknown stream, participant or condition, or nobody to analyse.
    """
    if stream not in STREAMS:
        raise InputError("stream", stream, ", ".join(STREAMS))
    unknown = set(excluded) - set(data["participant"])
    if unknown:
        raise InputError("exclude", min(unknown), "a participant in the data")
    own = data[data["stream"] == stream]
    done = own[own["stage"] == "done"]
    others = set(done["condition"]) - set(CONDITIONS)
    if others:
        raise InputError("condition", min(others), " or ".join(CONDITIONS))
    if "attention_missed" in done.columns:
        missed = done.loc[done["attention_missed"] > 0, "participant"]
        excluded = dict.fromkeys(missed, "attention check missed") | dict(excluded)
    reasons = [excluded[p] for p in done["participant"] if p in excluded]
    kept = done[~done["participant"].isin(list(excluded))]
    if any((kept["condition"] == condition).sum() < 2 for condition in CONDITIONS):
        counts = {c: int((kept["condition"] == c).sum()) for c in CONDITIONS}
        raise InputError(
            "data", counts, f"at least 2 completed participants (stream {stream}) a condition"
        )
    primary = [_compare(kept, m, title, seed) for m, title in MEASURES.items()]
    adjusted = holm([c.student.p for _, _, c in primary]).tolist()
    rows = [
        Row(m, title, c, p, paper_table()[m])
        for (m, title, c), p in zip(primary, adjusted, strict=True)
    ]
    rows += [
        Row(m, title, _compare(kept, m, title, seed)[2], float("nan"), None)
        for m, title in SECONDARY.items()
        if kept[m].notna().all()
    ]
    counted = {reason: reasons.count(reason) for reason in dict.fromkeys(reasons)}
    return Analysis(stream, tuple(rows), _flow(own), counted, kept)


def _compare(
    data: pd.DataFrame, measure: str, title: str, seed: int
) -> tuple[str, str, Comparison]:
    """Conformant against personalized, as the paper's columns."""
    a, b = (data[data["condition"] == condition] for condition in CONDITIONS)
    result = compare(
        a[measure].to_numpy(),
        b[measure].to_numpy(),
        a["type"].astype(str).tolist(),
        b["type"].astype(str).tolist(),
        derived_seed(seed, "permutation", measure),
    )
    return measure, title, result


def _flow(own: pd.DataFrame) -> tuple[tuple[str, Mapping[str, int]], ...]:
    """How many got how far, and how the others ended."""
    consented = own["condition"].notna()
    evaluated = own["inexplicable_transitions"].notna()
    reached = {
        "entered": own["participant"].notna(),
        "consented": consented,
        "eligible": own["eligible"] == 1,
        "evaluated": evaluated,
        "completed": own["stage"] == "done",
    }
    rows = [(stage, _by_condition(own, reached[stage])) for stage in STAGES]
    rows += [(end.replace("_", " "), _by_condition(own, own["stage"] == end)) for end in ENDS]
    running = ~own["stage"].isin(["done", *ENDS])
    rows.append(("still on their way", _by_condition(own, running)))
    return tuple(rows)


def _by_condition(own: pd.DataFrame, chosen: pd.Series[bool]) -> dict[str, int]:
    counts = {c: int((chosen & (own["condition"] == c)).sum()) for c in CONDITIONS}
    return {"all": int(chosen.sum()), **counts}


def table(rows: Sequence[Row]) -> list[dict[str, float | str]]:
    """The rows as flat records, for CSV."""
    records: list[dict[str, float | str]] = []
    for row in rows:
        parts = (("conformant", row.ours.a), ("personalized", row.ours.b))
        tests = (("student", row.ours.student), ("welch", row.ours.welch))
        records.append(
            {
                "measure": row.measure,
                **{f"{key}_{name}": v for name, group in parts for key, v in vars(group).items()},
                **{f"{name}_{key}": v for name, test in tests for key, v in vars(test).items()},
                "student_p_holm": row.holm_p,
                "hedges_g": row.ours.g,
                "g_low": row.ours.g_low,
                "g_high": row.ours.g_high,
                "permutation_p": row.ours.permutation_p,
                **{f"paper_{key}": value for key, value in (row.paper or {}).items()},
            }
        )
    return records
