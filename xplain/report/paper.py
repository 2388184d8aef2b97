"""The values in the paper's Table 1 (where they are truncated to two decimals), and readable
names."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd

NAMES = {
    "qmdp": "QMDP",
    "pomcp_paper": "POMCP (d = 2)",
    "pomcp": "POMCP (ours)",
    "certified": "Certified",
    "qhr": "QHR",
    "baseline": "Baseline",
    "conformant": "Conformant",
    "silent": "Silent",
    "say_all": "Say all",
    "four_rooms": "Four rooms",
    "rescue": "Disaster rescue",
}
"""Readable names of solvers and domains. The paper's POMCP searches to depth 2 and backs up means,
so its values are compared with ``pomcp_paper``, not with our tuned search."""

GROUPS = {
    "truth": "True types and labels",
    "hypotheses": "Learned with hypotheses",
    "tree": "Learned as in the paper",
}
"""Names of Table 1's groups of columns, by labeler."""


def title(key: str) -> str:
    """Returns the readable name of a solver or domain."""
    name, _, rest = key.partition(" ")
    return " ".join(filter(None, [NAMES.get(name, name), rest]))


def group_title(group: Mapping[str, Any], label: str) -> str:
    """Returns the name of a group of columns. If the groups differ only in the labeler, this is the
    labeler's name; otherwise it is ``label``.

    Args:
        group: {swept key: value} of the group.
        label: the formatted values of the group.
    """
    return GROUPS.get(group.get("labeler", ""), label) if len(group) == 1 else label


@cache
def table1() -> dict[Any, dict[str, float]]:
    """Reads Table 1 as ``{(domain, λ): {"oracle": cost, solver: regret, …}}``."""
    path = Path(__file__).with_name("table1.csv")
    found: Any = pd.read_csv(path, index_col=["domain", "lambda"]).to_dict("index")
    return {problem: dict(values) for problem, values in found.items()}
