"""The jobs of a sweep, and the jobs that have to run.

Jobs are planned in the same way for the command line and for Python. The command line gives
overrides, which are text in Hydra's form. Python can also give values, such as numbers and lists;
the plan uses these values as they are, and never converts them to text and back.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import logging
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import ConfigCompositionException
from joblib import effective_n_jobs
from omegaconf import DictConfig, OmegaConf, open_dict

from xplain.errors import InputError, mapping
from xplain.experiment.config import GROUPS, missing_key
from xplain.experiment.from_config import check
from xplain.report.folder import FAILURE, ListedJob, SweepFolder
from xplain.runs.job import Job

log = logging.getLogger(__name__)

MANY, EACH = 32, 4
"""A worker takes 0.2 s to begin a batch, so large sweeps run several jobs in one batch. With EACH
batches for each worker, all workers are busy to the end. If the launcher's number of workers is
unknown, there are MANY batches."""

LAST = ("solver", "lambda", "seed")
"""Keys at the end of a job's label, so that labels sort by setting."""

Compose = Callable[[list[str]], DictConfig]
"""Makes a job's configuration, with the ``hydra`` node, from overrides."""


@dataclass(frozen=True)
class Plan:
    """A planned sweep.

    Attributes:
        folder: folder of the sweep.
        jobs: its list of jobs.
        todo: ``{fingerprint: job}`` of the jobs that have to run.
        finished: fingerprints of the jobs with results.
        config: configuration of the planning process, with the ``hydra`` node.
        about: contents of the sweep's file besides the jobs, such as the sweep's name.
    """

    folder: SweepFolder
    jobs: tuple[ListedJob, ...]
    todo: Mapping[str, Job]
    finished: frozenset[str]
    config: DictConfig
    about: Mapping[str, Any]

    @classmethod
    def of(
        cls,
        config: DictConfig,
        words: Sequence[str],
        given: Mapping[str, Sequence[Any]],
        compose: Compose,
    ) -> Plan:
        """Composes and checks every job, so that errors appear before the first job starts.

        Args:
            config: configuration of the planning process, with the ``hydra`` node.
            words: overrides; an override may have several values (``choice``, ``range``, commas).
            given: ``{key: Python values}``. The sweep has a job for each combination of these
                values and the values in ``words``.
            compose: composes a job's configuration from overrides.

        Raises:
            XplainError, HydraException, OmegaConfBaseException: the configuration of a job is
                wrong, or a sweep has no finite list of values.
        """
        for word in config.hydra.overrides.hydra:
            key, _, value = word.lstrip("+").partition("=")
            if key.startswith("hydra.sweep."):
                allowed = "outputs=FOLDER instead: a sweep's folder gets its name from the jobs"
                raise InputError(key, value, allowed)
        keys: Any = OmegaConf.to_container(config.hydra.sweeper)
        params = mapping("hydra.sweeper.params", keys.get("params") or {}, "key: values")
        settings = [{**params, **setting} for setting in keys.get("settings") or [{}]]
        composer = _Composer(compose, config.hydra.runtime.choices)
        jobs, rows = dict[str, Job](), dict[str, ListedJob]()
        combinations = _list_combinations(settings, _parse(words))
        for texts, values in itertools.product(combinations, itertools.product(*given.values())):
            own = dict(zip(given, values, strict=True))
            named = {k: v for k, v in own.items() if k in GROUPS and isinstance(v, str)}
            texts = {**texts, **named}
            cfg = composer.compose(texts)
            others = {key: value for key, value in own.items() if key not in named}
            job = Job.of(cfg, dict(cfg.hydra.runtime.choices) | set_values(cfg, others))
            if jobs.setdefault(job.fingerprint, job) is job:
                shown = values_of([*texts, *others], job)
                rows[job.fingerprint] = ListedJob(
                    "", _make_overrides(texts), shown, job.fingerprint
                )
        composer.require_known([*rows.values()])
        name = config.hydra.runtime.choices.get("sweeps") or "multirun"
        digest = hashlib.sha256(json.dumps([*jobs]).encode()).hexdigest()[:10]
        folder = SweepFolder(Path(config.outputs).absolute() / "sweeps" / f"{name}-{digest}")
        finished = frozenset(key for key, job in jobs.items() if job.find_result())
        todo = {key: job for key, job in jobs.items() if key not in finished}
        if config.resume == "failed":
            failed = {path.parent.name for path in folder.path.glob(f"jobs/*/{FAILURE}")}
            todo = {key: job for key, job in todo.items() if key in failed}
        check([job.config for job in todo.values()])
        about = {"name": name, "command": command(config)}
        about |= {key: keys.get(key) for key in ("pool", "report")}
        return cls(folder, label_jobs([*rows.values()]), todo, finished, config, about)

    def batches(self) -> list[list[Job]]:
        """Groups the jobs to run into batches; a worker runs a batch at each call.

        All jobs of a batch use the same data set, because jobs of one data set wait until the first
        of them has made the data. The first batch of each data set comes before any second batch of
        a data set.
        """
        by_data: dict[str, list[Job]] = {}
        for job in self.todo.values():
            by_data.setdefault(job.source, []).append(job)
        workers = OmegaConf.select(self.config, "hydra.launcher.n_jobs")
        enough = MANY if workers is None else EACH * effective_n_jobs(workers)
        size = 1 + len(self.todo) // enough
        cut = [[own[i : i + size] for i in range(0, len(own), size)] for own in by_data.values()]
        return [batch for turn in itertools.zip_longest(*cut) for batch in turn if batch]


def label_jobs(jobs: Sequence[ListedJob]) -> tuple[ListedJob, ...]:
    """Returns the jobs with labels made from the swept keys, and with only these keys in
    ``values``. A key is swept if its value differs between jobs, or if some jobs lack the key. If
    no key is swept, domain, solver and λ are used instead."""
    keys = dict.fromkeys(key for job in jobs for key in job.values)
    varying = [key for key in keys if len({job.values.get(key) for job in jobs}) > 1]
    varying = varying or [key for key in ("domain", "solver", "lambda") if key in keys]
    varying.sort(key=lambda key: LAST.index(key) if key in LAST else -1)
    found = []
    for job in jobs:
        values = {key: job.values[key] for key in varying if key in job.values}
        names = {key: "λ" if key == "lambda" else key.rpartition(".")[2] for key in values}
        words = [own if key in GROUPS else f"{names[key]}={own}" for key, own in values.items()]
        label = " ".join(words) or "only job"
        found.append(ListedJob(label, job.overrides, values, job.fingerprint))
    return tuple(found)


def values_of(keys: Sequence[str], job: Job) -> dict[str, str]:
    """Returns ``{key: value as text}`` for the keys that affect the numbers of a job."""
    names = dict.fromkeys(key.lstrip("+~").partition("@")[0] for key in keys)
    return {
        key: job.choices[key] if key in job.choices else _format_value(_get_value(job.config, key))
        for key in names
        if key in job.choices or key.partition(".")[0] in job.config
    }


def _get_value(node: Any, key: str) -> Any:
    """Returns the value of a dotted key; None if it is missing."""
    for name in key.split("."):
        node = node.get(name) if isinstance(node, Mapping) else None
    return node


def set_values(cfg: DictConfig, values: Mapping[str, Any]) -> dict[str, str]:
    """Sets Python values in a configuration. Returns ``{group: name}`` of those values that are
    components.

    Raises:
        OmegaConfBaseException: the key does not exist, or does not accept the value.
    """
    names = {}
    for key, value in values.items():
        if key in GROUPS:
            digest = hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
            names[key] = f"{str(value['_target_']).rpartition('.')[2]}_{digest[:4]}"
            with open_dict(cfg):
                cfg[key] = value
        else:
            OmegaConf.update(cfg, key, value)
    return names


def _list_combinations(
    settings: list[dict[str, Any]], given: dict[str, list[str]]
) -> list[dict[str, str]]:
    """Lists the distinct combinations of values, a mapping for each job."""
    apart = [key for key in given if len({str(setting.get(key)) for setting in settings}) > 1]
    texts = [{key: _format_values(value) for key, value in setting.items()} for setting in settings]
    chosen: dict[tuple[str, ...], dict[str, str]] = {}
    for setting in texts:
        own = _parse(_make_overrides(setting))
        merged = own | {key: values for key, values in given.items() if key not in apart}
        for combination in itertools.product(*merged.values()):
            values = dict(zip(merged, combination, strict=True))
            if all(values.get(key) in given[key] for key in apart):
                chosen[_make_overrides(values)] = values
    if not chosen:
        known = [{key: own[key] for key in apart if key in own} for own in texts]
        has = "; ".join(" ".join(_make_overrides(own)) or "none" for own in known)
        asked = ",".join(given[apart[0]])
        raise InputError(apart[0], asked, f"values of one of the sweep's settings: {has}")
    return list(chosen.values())


def _make_overrides(values: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(f"{key}={value}" for key, value in values.items())


def _parse(overrides: Sequence[str]) -> dict[str, list[str]]:
    """Parses overrides to ``{key: values}``, in the order of the overrides."""
    parsed: dict[str, list[str]] = {}
    for override in OverridesParser.create().parse_overrides([*overrides]):
        key = override.get_key_element()
        if not override.is_sweep_override():
            values = [override.get_value_element_as_str()]
        elif override.is_discrete_sweep() and not isinstance(override.value(), Glob):
            values = [str(value) for value in override.sweep_string_iterator()]
        else:
            asked = (override.input_line or "").partition("=")[2]
            raise InputError(key, asked, "a list, choice(...) or range(...)")
        # Booleans as in YAML: Hydra writes them as in Python.
        parsed[key] = [{"True": "true", "False": "false"}.get(own, own) for own in values]
    return parsed


def _format_values(value: Any) -> str:
    """Formats the value or values of a key in a sweep's file as the right side of an override:
    ``0.5,1``."""
    return ",".join(map(_format_value, value)) if isinstance(value, list) else _format_value(value)


def _format_value(value: Any) -> str:
    """Formats a value in YAML's form; numbers have no trailing zeros."""
    if isinstance(value, float):
        return f"{value:.10g}"
    return value if isinstance(value, str) else json.dumps(value)


class _Composer:
    """Composes the configurations of jobs with few calls of Hydra, because a call takes 0.2 s.
    If two jobs choose the same components and set the same keys (``lambda=1.5``), the second job's
    values are set in the configuration of the first. Hydra handles everything else, including
    errors.

    Args:
        load: composes a configuration from overrides by Hydra.
        choices: the groups of the configuration, with the chosen components.
    """

    def __init__(self, load: Compose, choices: Mapping[str, Any]) -> None:
        self._load, self._choices = load, choices
        self._like: dict[tuple[str, ...], DictConfig] = {}
        self._lacking: dict[str, tuple[Exception, dict[str, None]]] = {}

    def compose(self, values: dict[str, str]) -> DictConfig:
        """Composes the configuration of one combination. Keys that the chosen component lacks are
        dropped, such as ``solver.simulations`` for a solver without a search."""
        try:
            return self._reuse_or_load([*_make_overrides(values)])
        except ConfigCompositionException as error:
            key = missing_key(error) or ""
            group = key.partition(".")[0]
            if key not in values or group == key or group not in values:
                raise
            self._lacking.setdefault(key, (error, {}))[1][values[group]] = None
            del values[key]
            return self.compose(values)

    def require_known(self, jobs: Sequence[ListedJob]) -> None:
        """Logs the chosen components that lack a swept key.

        Raises:
            ConfigCompositionException: none of the jobs' components has the key.
        """
        for key, (error, choices) in self._lacking.items():
            if not any(key in job.values for job in jobs):
                raise error
            log.info("%s: no key of %s", key, ", ".join(choices))

    def _reuse_or_load(self, overrides: list[str]) -> DictConfig:
        parsed = OverridesParser.create().parse_overrides(overrides)
        values = [override for override in parsed if self._sets_a_value(override)]
        others = [override for override in parsed if override not in values]
        kind = tuple(override.input_line or "" for override in others)
        kind += ("", *(override.key_or_group for override in values))
        if kind not in self._like:
            self._like[kind] = self._load(overrides)
        for override in values:
            OmegaConf.update(self._like[kind], override.key_or_group, override.value())
        return self._like[kind]

    def _sets_a_value(self, override: Override) -> bool:
        key = override.key_or_group
        plain = override.package is None and not (
            override.is_add() or override.is_force_add() or override.is_delete()
        )
        scalar = isinstance(override.value(), (str, int, float, bool, type(None)))
        return plain and scalar and key not in self._choices and key.partition(".")[0] != "hydra"


def command(config: DictConfig) -> str:
    """Returns the command that starts the same sweep."""
    given = [*config.hydra.overrides.hydra, *config.hydra.overrides.task]
    words = [word for word in given if not word.startswith("hydra.mode=")]
    prepared = any(word.startswith("sweeps=") for word in words)
    return shlex.join(["python", "-m", "xplain", *([] if prepared else ["-m"]), *words])
