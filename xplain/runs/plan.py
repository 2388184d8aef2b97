"""Which jobs a sweep consists of, and what each is known by."""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob
from hydra.errors import ConfigCompositionException

from xplain.errors import InputError
from xplain.experiment.config import GROUPS, missing_key, named

Compose = Callable[[list[str]], dict[str, Any]]
"""From overrides to the resolved configuration of a job."""

_Lacking = tuple[ConfigCompositionException, list[str]]
"""Hydra's error about a key, and the choices that lack it."""

_LAST = ("solver", "lambda", "seed")
"""Keys that end a job's name, so that names sort by setting."""


@dataclass(frozen=True)
class Job:
    """One run of a sweep.

    Attributes:
        name: of its folder; what tells it from the sweep's other jobs.
        label: the same for people, in MLflow and in messages.
        overrides: what Hydra makes its configuration from.
        values: the swept keys and their values, as text.
        fingerprint: digest of all that its numbers depend on
            (:mod:`xplain.experiment.fingerprint`).
        source: digest of all that its data, types and traces depend on.
    """

    name: str
    label: str
    overrides: tuple[str, ...]
    values: dict[str, str]
    fingerprint: str
    source: str


@dataclass(frozen=True)
class Plan:
    """A sweep: its jobs in the order of their names' keys, and an identity made of them; notes on
    keys that only some of its choices have."""

    name: str
    jobs: tuple[Job, ...]
    notes: tuple[str, ...] = ()

    @property
    def identity(self) -> str:
        """Name and digest: the same jobs by the same code are the same sweep."""
        content = json.dumps([[job.name, job.fingerprint] for job in self.jobs])
        return f"{self.name}-{hashlib.sha256(content.encode()).hexdigest()[:10]}"


def make_plan(
    name: str,
    settings: list[dict[str, Any]],
    arguments: list[str],
    compose: Compose,
    fingerprints: Callable[[dict[str, Any]], tuple[str, str]],
) -> Plan:
    """Composes every job, so that a mistake shows before the first one starts.

    Args:
        name: of the sweep.
        settings: mappings of keys to values, swept (``choice``, ``range``, commas) or single;
            each gives the product of its values.
        arguments: overrides from the command line. One whose key tells settings apart chooses
            among them; any other replaces the settings' own.
        compose: makes a job's configuration.
        fingerprints: from a configuration to those of its numbers, and of its source.

    A key of a swept group that only some of its choices have varies where it is; the plan notes it.

    Raises:
        InputError: a kind of sweep without a finite list of values, or no job is left.
    """
    combinations = _combinations(settings, _parse(arguments))
    swept = _swept(combinations)
    jobs: dict[str, Job] = {}
    names: set[str] = set()
    lacking: dict[str, _Lacking] = {}
    for values in combinations:
        resolved = _composed(values, swept, compose, lacking)
        overrides = _overrides(values)
        fingerprint, source = fingerprints(resolved)
        if fingerprint in jobs:
            continue
        varied = {key.lstrip("+"): values[key] for key in swept if key in values}
        folder = _folder(varied)
        if folder in names:
            folder = f"{folder[:100]},{fingerprint[:8]}"
        names.add(folder)
        jobs[fingerprint] = Job(folder, _label(varied), overrides, varied, fingerprint, source)
    for key, (error, _) in lacking.items():
        if not any(key in values for values in combinations):
            raise error  # no choice has it
    notes = (f"{key}: no key of {', '.join(dict.fromkeys(c))}" for key, (_, c) in lacking.items())
    return Plan(name, tuple(jobs.values()), tuple(notes))


def _combinations(
    settings: list[dict[str, Any]], given: dict[str, list[str]]
) -> list[dict[str, str]]:
    """Values of keys, a mapping a job; each only once."""
    apart = [key for key in given if len({str(setting.get(key)) for setting in settings}) > 1]
    chosen: dict[tuple[str, ...], dict[str, str]] = {}
    for setting in settings:
        own = _parse([f"{key}={_text(value)}" for key, value in setting.items()])
        merged = own | {key: values for key, values in given.items() if key not in apart}
        for combination in itertools.product(*merged.values()):
            values = dict(zip(merged, combination, strict=True))
            if all(values.get(key) in given[key] for key in apart):
                chosen[_overrides(values)] = values
    if not chosen:
        has = "; ".join(
            " ".join(f"{key}={_text(setting[key])}" for key in apart if key in setting) or "none"
            for setting in settings
        )
        asked = ",".join(given[apart[0]])
        raise InputError(apart[0], asked, f"values of one of the sweep's settings: {has}")
    return list(chosen.values())


def _overrides(values: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(named([f"{key}={value}" for key, value in values.items()]))


def _composed(
    values: dict[str, str], swept: Sequence[str], compose: Compose, lacking: dict[str, _Lacking]
) -> dict[str, Any]:
    """The configuration of one combination. Its values lose the keys that its choice of a swept
    group lacks, such as ``solver.simulations`` where another solver searches."""
    while True:
        try:
            return compose(list(_overrides(values)))
        except ConfigCompositionException as error:
            key = missing_key(error) or ""
            group, _, inside = key.partition(".")
            if not inside or key not in values or group not in swept:
                raise
            del values[key]
            lacking.setdefault(key, (error, []))[1].append(values[group])


def in_launch_order(jobs: Iterable[Job]) -> list[Job]:
    """Jobs that share a source wait for the first of them: begin with one of each source."""
    seen: dict[str, int] = {}
    order = []
    for position, job in enumerate(jobs):
        turn = seen[job.source] = seen.get(job.source, -1) + 1
        order.append((turn, position, job))
    return [job for _, _, job in sorted(order, key=lambda item: item[:2])]


def _parse(overrides: list[str]) -> dict[str, list[str]]:
    """``{key: values}`` of overrides, in their order."""
    parsed: dict[str, list[str]] = {}
    for override in OverridesParser.create().parse_overrides(overrides):
        key = override.get_key_element()
        if "." not in key:
            key = key.removeprefix("++")  # the keys at the top are all there
        if not override.is_sweep_override():
            values = [override.get_value_element_as_str()]
        elif override.is_discrete_sweep() and not isinstance(override.value(), Glob):
            values = [str(value) for value in override.sweep_string_iterator()]
        else:
            asked = (override.input_line or "").partition("=")[2]
            raise InputError(key, asked, "a list, choice(...) or range(...)")
        # Truth values as YAML has them: Hydra gives them in Python's spelling.
        parsed[key] = [{"True": "true", "False": "false"}.get(own, own) for own in values]
    return parsed


def _text(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return ",".join(map(_text, value))
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    return str(value)


def _swept(jobs: list[dict[str, str]]) -> list[str]:
    """Keys with more than one value, or that some jobs lack: settings, solver, λ, seed."""
    keys = list(dict.fromkeys(key for values in jobs for key in values))
    varying = [key for key in keys if len({values.get(key) for values in jobs}) > 1]
    varying = varying or [key for key in ("domain", "solver", "lambda") if key in keys]
    return sorted(varying, key=lambda key: _LAST.index(key) if key in _LAST else -1)


def _folder(values: dict[str, str]) -> str:
    text = ",".join(f"{key}={value}" for key, value in values.items()) or "only"
    return re.sub(r"[^\w.=,+-]", "_", text)[:120]


def _label(values: dict[str, str]) -> str:
    words = []
    for key, value in values.items():
        if key in GROUPS:
            words.append(value)
        elif key == "lambda":
            words.append(f"λ={value}")
        else:
            words.append(f"{key.rpartition('.')[2]}={value}")
    return " ".join(words) or "only job"
