"""What Table 1 and the learning stage call the settings of a sweep's jobs."""

from __future__ import annotations

from xplain.experiment.cache import SOURCE

_SOURCE = {*SOURCE, "points"} - {"seed"}
"""What decides data, types and traces."""

_WORDS = {"users.count": "{} types", "users.index": "completion {}"}
"""What people call settings."""


def is_setting(key: str) -> bool:
    """Whether the values of a swept key tell settings of one domain apart."""
    return key != "domain" and key.partition(".")[0] in _SOURCE


def setting_of(values: dict[str, str]) -> str:
    """``3 types``, ``noise=0.1``; empty where settings are domains alone."""
    words = []
    for key, value in values.items():
        if is_setting(key):
            group, _, last = key.rpartition(".")
            words.append(_WORDS.get(key, f"{last}=" + "{}").format(value) if group else value)
    return " ".join(words)
