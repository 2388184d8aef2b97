"""The jobs of a sweep, and the jobs that have to run.

Every value is an override of Hydra, with its key. A value from the command line has a text; a value
from Python has none, because it is used as it is and never converted to text.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import logging
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override, OverrideType, ValueType
from joblib import effective_n_jobs
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import ConfigAttributeError, ConfigKeyError

from xplain.errors import InputError, mapping
from xplain.experiment.config import GROUPS
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

Axes = Mapping[str, Sequence[Override]]
"""The values of each key."""

Compose = Callable[[list[str]], DictConfig]
"""Makes a configuration, with the ``hydra`` node, from overrides."""


def parse(words: Iterable[str]) -> dict[str, list[Override]]:
    """Parses overrides, which may have several values (``choice``, ``range``, commas), to an
    override for each value.

    Raises:
        InputError: an override has no finite list of values.
        HydraException: an override cannot be read.
    """
    read, parsed = OverridesParser.create().parse_overrides, dict[str, list[Override]]()
    for one in read([*words]):
        key, several = one.get_key_element(), [one]
        if one.is_sweep_override():
            if not one.is_discrete_sweep() or isinstance(one.value(), Glob):
                raise InputError(key, one.get_value_string(), "a list, choice(...) or range(...)")
            several = read([f"{key}={text}" for text in one.sweep_string_iterator()])
        parsed[key.lstrip("+~")] = several
    return parsed


def make_overrides(key: str, value: Any) -> list[Override]:
    """Makes an override for each value of a list from Python, or for a single value. Names of
    choices become texts, because Hydra composes what they choose."""
    made = list[Override]()
    for one in value if isinstance(value, list) else [value]:
        if key in (*GROUPS, "tracking", "sweeps") and isinstance(one, str | None):
            made += parse([f"{key}={'null' if one is None else one}"])[key]
        else:
            made.append(Override(OverrideType.CHANGE, key, ValueType.ELEMENT, one))
    return made


def set_value(cfg: DictConfig, override: Override) -> None:
    """Sets a value in a composed configuration. A component from Python gets the name of its class,
    with a digest of its arguments.

    Raises:
        OmegaConfBaseException: the key does not exist, or does not accept the value.
    """
    key, value = override.key_or_group, override.value()
    if key in GROUPS and isinstance(value, dict) and "_target_" in value:
        digest = hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
        name = f"{str(value['_target_']).rpartition('.')[2]}_{digest[:4]}"
        cfg.hydra.runtime.choices[key] = name
        with open_dict(cfg):
            cfg[key] = value
    else:
        OmegaConf.update(cfg, key, value)


def compose_values(compose: Compose, overrides: Sequence[Override]) -> DictConfig:
    """Composes a configuration from overrides with and without a text."""
    cfg = compose([one.input_line for one in overrides if one.input_line])
    for one in overrides:
        if not one.input_line:
            set_value(cfg, one)
    return cfg


@dataclass(frozen=True)
class Plan:
    """A planned sweep.

    Attributes:
        folder: folder of the sweep.
        jobs: its list of jobs.
        todo: ``{fingerprint: job}`` of the jobs that have to run.
        finished: ``{fingerprint: seconds}`` of the jobs with results.
        config: configuration of the planning process, with the ``hydra`` node.
        about: contents of the sweep's file besides the jobs, such as the sweep's name.
    """

    folder: SweepFolder
    jobs: tuple[ListedJob, ...]
    todo: Mapping[str, Job]
    finished: Mapping[str, float]
    config: DictConfig
    about: Mapping[str, Any]

    @classmethod
    def of(cls, config: DictConfig, axes: Axes, compose: Compose) -> Plan:
        """Composes and checks every job, so that errors appear before the first job starts.

        Args:
            config: configuration of the planning process, with the ``hydra`` node.
            axes: the values of each key. The sweep has a job for each combination.
            compose: composes a job's configuration.

        Raises:
            XplainError, HydraException, OmegaConfBaseException: the configuration of a job is
                wrong.
        """
        for word in config.hydra.overrides.hydra:
            key, _, value = word.lstrip("+").partition("=")
            if key.startswith("hydra.sweep."):
                allowed = "outputs=FOLDER instead: a sweep's folder gets its name from the jobs"
                raise InputError(key, value, allowed)
        for key in (key for key, own in axes.items() if not own):
            raise InputError(key, [], "at least one value")
        keys: Any = OmegaConf.to_container(config.hydra.sweeper)
        params = mapping("hydra.sweeper.params", keys.get("params") or {}, "key: values")
        settings = [{**params, **setting} for setting in keys.get("settings") or [{}]]
        jobs, rows = dict[str, Job](), list[ListedJob]()
        combinations = _list_combinations(settings, axes)
        for cfg, own in _compose_each(combinations, compose, config.hydra.runtime.choices):
            job = Job.of(cfg, cfg.hydra.runtime.choices)
            if jobs.setdefault(job.fingerprint, job) is job:
                # Hydra's own settings, such as the launcher, are not the job's.
                task = [one for one in own if one.input_line and not one.is_hydra_override()]
                texts = tuple(str(one.input_line) for one in task)
                rows.append(ListedJob("", texts, values_of(own, job), job.fingerprint))
        name = config.hydra.runtime.choices.get("sweeps") or "multirun"
        digest = hashlib.sha256(json.dumps([*jobs]).encode()).hexdigest()[:10]
        folder = SweepFolder(Path(config.outputs).absolute() / "sweeps" / f"{name}-{digest}")
        found = ((key, job.find_result()) for key, job in jobs.items())
        finished = {key: sum(own.seconds.values()) for key, own in found if own is not None}
        todo = {key: job for key, job in jobs.items() if key not in finished}
        if config.resume == "failed":
            failed = {path.parent.name for path in folder.path.glob(f"jobs/*/{FAILURE}")}
            todo = {key: job for key, job in todo.items() if key in failed}
        check([job.config for job in todo.values()])
        about = {"name": name, "command": command(config)}
        about |= {key: keys.get(key) for key in ("pool", "report")}
        return cls(folder, label_jobs(rows), todo, finished, config, about)

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


def values_of(overrides: Iterable[Override], job: Job) -> dict[str, str]:
    """Returns ``{key: value as text}`` for the keys that affect the numbers of a job."""
    return {
        key: job.choices[key] if key in job.choices else _format_value(_get_value(job.config, key))
        for key in dict.fromkeys(one.key_or_group for one in overrides)
        if key in job.choices or key.partition(".")[0] in job.config
    }


def _get_value(node: Any, key: str) -> Any:
    """Returns the value of a dotted key; None if it is missing."""
    for name in key.split("."):
        node = node.get(name) if isinstance(node, Mapping) else None
    return node


def _list_combinations(settings: list[dict[str, Any]], given: Axes) -> list[tuple[Override, ...]]:
    """Lists the combinations of values, one for each job. If the settings differ in a key, a given
    value of this key selects the settings that have the value."""
    apart = [key for key in given if len({str(setting.get(key)) for setting in settings}) > 1]
    selected = {key: [one.value() for one in given[key]] for key in apart}
    chosen = list[tuple[Override, ...]]()
    for setting in settings:
        several = {key: own if isinstance(own, list) else [own] for key, own in setting.items()}
        words = [f"{key}={','.join(map(_format_value, own))}" for key, own in several.items()]
        merged = parse(words) | {key: own for key, own in given.items() if key not in apart}
        for combination in itertools.product(*merged.values()):
            own = dict(zip(merged, combination, strict=True))
            if all(key in own and own[key].value() in selected[key] for key in apart):
                chosen.append(combination)
    if apart and not chosen:
        known = ([f"{key}={own[key]}" for key in apart if key in own] for own in settings)
        has = "; ".join(" ".join(words) or "none" for words in known)
        asked = ",".join(map(_format_value, selected[apart[0]]))
        raise InputError(apart[0], asked, f"values of one of the sweep's settings: {has}")
    return chosen


def _format_value(value: Any) -> str:
    """Formats a value in YAML's form; numbers have no trailing zeros."""
    if isinstance(value, float):
        return f"{value:.10g}"
    return value if isinstance(value, str) else json.dumps(value)


def _compose_each(
    combinations: Iterable[Sequence[Override]], compose: Compose, choices: Mapping[str, Any]
) -> Iterator[tuple[DictConfig, list[Override]]]:
    """Composes the configurations of jobs with few calls of Hydra, because a call takes 0.2 s.
    Hydra chooses the components; values are set afterwards. If two jobs have the same
    components and the same keys, the second job's values are set in the first job's configuration.

    Args:
        combinations: the overrides of each job.
        compose: composes a configuration by Hydra.
        choices: the groups of the configuration, with the chosen components.

    Yields:
        The job's configuration, valid until the next job's; and the job's overrides. Keys that the
        chosen component lacks are dropped, such as ``solver.simulations`` for a solver without a
        search.

    Raises:
        OmegaConfBaseException: a key does not exist in any job, or does not accept its value.
    """
    like, known = dict[tuple[str, ...], DictConfig](), set[str]()
    lacking: dict[str, tuple[Exception, dict[str, None]]] = {}
    for combination in combinations:
        own, later = [*combination], [one for one in combination if _is_set_later(one, choices)]
        texts = [str(one.input_line) for one in own if one not in later]
        # A mapping is merged into the mapping that is there, so it needs a new configuration.
        merged = [str(one.value()) for one in later if _is_merged(one.value())]
        kind = (*texts, "", *(one.key_or_group for one in later), "", *merged)
        if kind not in like:
            like[kind] = compose(texts)
        for one in later:
            key, group = one.key_or_group, one.key_or_group.partition(".")[0]
            try:
                set_value(like[kind], one)
                known.add(key)
            except (ConfigAttributeError, ConfigKeyError) as error:
                if group == key or all(other.key_or_group != group for other in own):
                    raise
                name = str(like[kind].hydra.runtime.choices[group])
                lacking.setdefault(key, (error, {}))[1][name] = None
                own.remove(one)
        yield like[kind], own
    for key, (lack, names) in lacking.items():
        if key not in known:
            raise lack
        log.info("%s: no key of %s", key, ", ".join(names))


def _is_set_later(one: Override, choices: Mapping[str, Any]) -> bool:
    """True if a value can be set in a composed configuration: the value of an existing key, or any
    value from Python."""
    plain = one.type == OverrideType.CHANGE and not one.package and not one.is_hydra_override()
    return not one.input_line or (plain and one.key_or_group not in choices)


def _is_merged(value: Any) -> bool:
    return isinstance(value, dict) and "_target_" not in value


def command(config: DictConfig) -> str:
    """Returns the command that starts the same sweep."""
    # A sweep from Python has Hydra's own settings in both lists.
    given = dict.fromkeys((*config.hydra.overrides.hydra, *config.hydra.overrides.task))
    words = [word for word in given if not word.startswith("hydra.mode=")]
    prepared = any(word.startswith("sweeps=") for word in words)
    return shlex.join(["python", "-m", "xplain", *([] if prepared else ["-m"]), *words])
