"""What Table 1 and the learning stage call the settings and methods of a sweep's jobs."""

from __future__ import annotations

from xplain.experiment.cache import SOURCE

_SOURCE = {*SOURCE, "points"} - {"seed"}
"""What tells settings apart; anything else that is swept tells methods apart."""

_WORDS = {"users.count": "{} types", "users.index": "completion {}"}
"""What people call settings."""


def setting_of(values: dict[str, str]) -> str:
    """``3 types``, ``noise=0.1``; empty where settings are domains alone."""
    words = []
    for key, value in values.items():
        group, _, last = key.rpartition(".")
        if key.partition(".")[0] not in _SOURCE or key == "domain":
            continue
        words.append(_WORDS.get(key, f"{last}=" + "{}").format(value) if group else value)
    return " ".join(words)


def method_of(values: dict[str, str], solver: str) -> str:
    """``pomcp``, or ``pomcp simulations=500`` where that is swept as well."""
    own = [
        f"{key.rpartition('.')[2]}={value}"
        for key, value in values.items()
        if key.partition(".")[0] not in _SOURCE and key not in ("solver", "lambda", "seed")
    ]
    return " ".join([solver, *own])
