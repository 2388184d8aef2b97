"""A sweep: which jobs it consists of, which are missing, and its report at the end.

The command line and Python make a :class:`Plan` in the same way; what runs its missing jobs is a
launcher of Hydra there, joblib here.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import logging
import os
import shlex
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import ConfigCompositionException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from xplain.errors import InputError, checks, first_line, mapping
from xplain.experiment.config import GROUPS, missing_key
from xplain.experiment.fingerprint import code_version, git_state
from xplain.experiment.from_config import check
from xplain.experiment.results import RESULTS, finished_at
from xplain.report.frame import SWEEP
from xplain.report.stages import stages
from xplain.runs.folder import FAILURE, LISTED, Disk, Listed, SweepFolder, listed, mark_failed
from xplain.runs.job import Job, ended_by
from xplain.runs.signals import end_with_parent, interruptible
from xplain.runs.terminal import attempted
from xplain.storage import write_text

log = logging.getLogger(__name__)

BATCH = "batch.json"
"""In the folder of a job: others that its worker runs after it."""

POLL = 1.0
"""Seconds between looks at how far a sweep is."""

Compose = Callable[[list[str]], DictConfig]
"""From overrides to a job's configuration, with the ``hydra`` node."""


@dataclass(frozen=True)
class Plan:
    """A sweep that may run.

    Attributes:
        folder: of the sweep.
        jobs: as it lists them.
        todo: the job of each fingerprint that has to run, first one of each data set.
        finished: fingerprints of the jobs that have results.
        config: of the process that plans it, with the ``hydra`` node.
        about: what is kept beside the jobs.
        together: keys whose values one worker runs after each other.
    """

    folder: SweepFolder
    jobs: tuple[Listed, ...]
    todo: Mapping[str, Job]
    finished: frozenset[str]
    config: DictConfig
    about: Mapping[str, Any]
    together: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        config: DictConfig,
        keys: Mapping[str, Any],
        words: Sequence[str],
        objects: Mapping[str, Sequence[Any]],
        compose: Compose,
    ) -> Plan:
        """Composes and checks every job, so that a mistake shows before the first one starts.

        Args:
            config: of the process that plans it, with the ``hydra`` node.
            keys: of the sweep's file, as in conf/hydra/sweeper/xplain.yaml.
            words: overrides, swept (``choice``, ``range``, commas) or single.
            objects: values from Python by key, which are no text.
            compose: makes a job's configuration.

        Raises:
            XplainError, HydraException, OmegaConfBaseException: the configuration of some job is
                wrong, or a kind of sweep has no finite list of values.
        """
        file = _File(**keys)
        settings = [{**file.params, **setting} for setting in file.settings or [{}]]
        combinations = _combinations(settings, _parse(words))
        swept = {key for values in combinations for key in values}
        compose, lacking = _Composer(compose, set(config.hydra.runtime.choices)), dict[str, Any]()
        jobs: dict[str, Job] = {}
        rows: dict[str, Listed] = {}
        for single in combinations:
            for given in itertools.product(*objects.values()):
                own = dict(zip(objects, given, strict=True))
                named = {
                    key: one for key, one in own.items() if key in GROUPS and isinstance(one, str)
                }
                values = {**single, **named}
                cfg = _composed(values, swept, compose, lacking)
                others = {key: one for key, one in own.items() if key not in named}
                choices = dict(cfg.hydra.runtime.choices) | set_values(cfg, others)
                job = Job.of(cfg, choices)
                if job.fingerprint not in jobs:
                    jobs[job.fingerprint] = job
                    texts = values_of([*values, *others], job)
                    rows[job.fingerprint] = Listed("", _overrides(values), texts, job.fingerprint)
        for key, (error, choices) in lacking.items():
            if not any(key in row.values for row in rows.values()):
                raise error  # no choice has it
            log.info("%s: no key of %s", key, ", ".join(dict.fromkeys(choices)))
        name = config.hydra.runtime.choices.get("sweeps") or "multirun"
        digest = hashlib.sha256(json.dumps([*jobs]).encode()).hexdigest()[:10]
        folder = SweepFolder(Path(config.outputs).absolute() / "sweeps" / f"{name}-{digest}")
        about: dict[str, Any] = {"name": name, "command": command(config), "pool": file.pool}
        about["report"] = file.report
        finished = frozenset(
            key for key, own in jobs.items() if not own.anew and finished_at(own.address)
        )
        todo = {key: own for key, own in jobs.items() if key not in finished}
        if config.resume == "failed":
            failed = {path.parent.name for path in folder.path.glob(f"jobs/*/{FAILURE}")}
            todo = {key: own for key, own in todo.items() if key in failed}
        check([job.config for job in todo.values()])
        todo = _in_launch_order(todo)
        rest = config, about, tuple(file.together)
        return cls(folder, listed([*rows.values()]), todo, finished, *rest)

    def batches(self) -> list[list[Listed]]:
        """The jobs to run, by the worker that runs them."""
        rows = {job.fingerprint: job for job in self.jobs}
        found: dict[tuple[tuple[str, str], ...], list[Listed]] = {}
        for key in self.todo:
            values = rows[key].values.items()
            apart = tuple(item for item in values if item[0] not in self.together)
            found.setdefault(apart if self.together else (("", key),), []).append(rows[key])
        return [*found.values()]


@checks("hydra.sweeper")
class _File:
    """Keys of hydra.sweeper; see :class:`hydra_plugins.xplain_sweeper.XplainSweeper`."""

    def __init__(
        self,
        params: Any = None,
        settings: list[dict[str, Any]] | None = None,
        pool: list[str] | None = None,
        report: str | None = None,
        together: list[str] | None = None,
    ) -> None:
        self.params = mapping("hydra.sweeper.params", params or {}, "key: values")
        self.settings, self.pool, self.report = settings, list(pool or ()), report
        self.together = list(together or ())


def _in_launch_order(jobs: Mapping[str, Job]) -> dict[str, Job]:
    """Jobs that share data wait for the first of them: one of each is first."""
    turns: dict[str, int] = {}
    order = {}
    for key, own in jobs.items():
        order[key] = turns[own.source] = turns.get(own.source, -1) + 1
    return {key: jobs[key] for key in sorted(jobs, key=lambda key: order[key])}


def run_missing(plan: Plan, launch: Callable[[list[list[Listed]], list[list[str]]], Any]) -> Any:
    """Runs the jobs of a plan that have no result, and returns what the launcher does.

    Args:
        plan: of the sweep. With ``dry_run=true`` its jobs are printed.
        launch: runs batches of jobs, each of which has overrides.

    Raises:
        KeyboardInterrupt: it was interrupted; what had ended is in MLflow.
    """
    folder, done = plan.folder, len(plan.finished)
    if plan.config.dry_run:
        _print_jobs(plan)
        return None
    with folder.alone(f"{folder.identity}: another process runs this sweep; waiting for it"):
        made = {"code": code_version(), "git": git_state(), "started": time.time()}
        outputs = folder.path.parents[1]
        folder.save(plan.jobs, outputs / "results", {**plan.about, **made})
        batches = plan.batches()
        run = [job for batch in batches for job in batch]
        words = [f"{len(run)} jobs to run" if run else "nothing is missing"]
        words += [f"{done} finished before"] if done else []
        log.info("%s: %s", folder.identity, ", ".join(words))
        for first, *others in batches if plan.together else ():
            save_batch(folder.of(first), [plan.todo[job.fingerprint] for job in others])
        arguments = [
            [
                *job.overrides,
                f"fingerprint='{job.fingerprint}'",
                f"hydra.sweep.dir='${{outputs}}/sweeps/{folder.identity}'",
                f"hydra.sweep.subdir=jobs/{job.fingerprint}",
                "hydra/job_logging=none",  # a job in this process would take the sweep's words
            ]
            for job, *_ in batches
        ]
        returned: Any = []
        try:
            with interruptible() as interrupted, _watched(folder, run, done):
                try:
                    returned = launch(batches, arguments) if run else []
                except Exception as error:  # noqa: BLE001  (launchers raise what they like)
                    log.warning("the launcher gave up (%s)", first_line(error)[:160])
                if interrupted.is_set():  # what was interrupted made another error of it
                    raise KeyboardInterrupt
        except KeyboardInterrupt:
            tracking: Disk = instantiate(plan.config.tracking)
            tracking.log(folder.path, outputs)
            finished = sum(folder.state(job) == "finished" for job in plan.jobs)
            said = f"{finished} of {len(plan.jobs)} jobs are finished; the same command goes on"
            raise KeyboardInterrupt(said) from None
        for (job, *_), one in zip(batches, returned, strict=False):
            with failing_into(folder.of(job)):
                _ = one.return_value  # raises what it failed with outside of its own code
    return returned


def run_in_sweep(job: Job, folder: Path, expected: str) -> float | None:
    """Runs a job of a sweep and returns its mean regret. It never raises: the others go on, and
    what went wrong is in its folder.

    Args:
        job: to run.
        folder: its own, in the sweep's.
        expected: the fingerprint that its sweep lists.
    """
    end_with_parent()
    regret = None
    with failing_into(folder):
        if expected != job.fingerprint:
            raise RuntimeError(
                "this worker has other code, libraries, data or files of choices than the process "
                "that started the sweep: give it the same, and start the command again"
            )
        regret = job.result().regret
    return regret


def save_batch(folder: Path, others: Sequence[Job]) -> None:
    """Leaves word in the folder of a batch's first job which others its worker runs after it."""
    folder.mkdir(parents=True, exist_ok=True)
    kept = {job.fingerprint: {**asdict(job), "outputs": str(job.outputs)} for job in others}
    write_text(folder / BATCH, json.dumps(kept))


def run_batch(folder: Path) -> None:
    """Runs what :func:`save_batch` left in the folder of a job, if anything."""
    if (folder / BATCH).exists():
        kept = json.loads((folder / BATCH).read_text(encoding="utf-8"))
        for fingerprint, own in kept.items():
            job = Job(**{**own, "outputs": Path(own["outputs"])})
            run_in_sweep(job, folder.parent / fingerprint, fingerprint)


@contextmanager
def failing_into(folder: Path) -> Iterator[None]:
    """An error ends the block, and is written into the folder: a failure is a result of a
    sweep."""
    try:
        yield
    except SystemExit as error:
        mark_failed(folder, RuntimeError(ended_by(error)))
    except Exception as error:  # noqa: BLE001  (components raise what they like)
        mark_failed(folder, error)


def finish(
    folder: SweepFolder,
    tracking: Disk,
    outputs: Path,
    began: float,
    tell: Callable[[str], None],
    shown: bool = True,
) -> bool:
    """Writes the report of a sweep, sends it to MLflow and tells its end; returns whether all of
    its jobs have results.

    Args:
        folder: of the sweep.
        tracking: where results go besides the disk.
        outputs: the outputs folder.
        began: when this process began with it, in seconds since 1970.
        tell: takes a line for people.
        shown: whether its table is printed.
    """
    from xplain.report.page import write_report
    from xplain.report.terminal import print_sweep

    jobs = folder.jobs()
    summary = None
    # The same sweep, started twice, ends twice: both would send the same jobs to MLflow.
    with folder.alone(f"{folder.identity}: another process ends this sweep; waiting for it"):
        with attempted("there is no report"):
            summary, _ = write_report(folder.path)
        lines = tracking.log(folder.path, outputs)
    if shown and summary is not None and summary.results:
        with attempted("the table was not printed"):
            print_sweep(summary)
    states = [(job, folder.state(job)) for job in jobs]
    finished = [job for job, state in states if state == "finished"]
    seconds = time.time() - began
    end = [f"{len(finished)} of {len(jobs)} jobs finished, {duration(seconds)}"]
    for job, state in states:
        if state == "failed":
            error = folder.failure(job)["error"]
            end += [f"failed: {job.label}: {error}", f"  {os.path.relpath(folder.of(job))}"]
    if len(finished) < len(jobs):
        end.append("run the others: the same command")
    end += [f"folder: {os.path.relpath(folder.path)}"]
    end += [f"report: {os.path.relpath(folder.path / 'report' / 'index.html')}", *lines]
    with attempted("the end was not told"):
        tell("\n".join(end))
    return len(finished) == len(jobs)


def list_job(job: Job, overrides: Sequence[str], folder: Path) -> None:
    """Leaves word of a job that another sweeper than ours runs, in its own folder."""
    texts = values_of([one.partition("=")[0] for one in overrides], job)
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(asdict(Listed("", (*overrides,), texts, job.fingerprint)))
    write_text(folder / LISTED, text + "\n")


def collected(config: DictConfig) -> SweepFolder | None:
    """The sweep that ended: of our sweeper as it was planned, of another one as its jobs left
    word. None where nothing ran."""
    folder = SweepFolder(Path(config.hydra.sweep.dir).absolute())
    paths = sorted(folder.path.glob(f"jobs/*/{LISTED}"), key=lambda path: path.stat().st_mtime_ns)
    if rows := [Listed(**json.loads(path.read_text(encoding="utf-8"))) for path in paths]:
        made = {"code": code_version(), "git": git_state(), "started": time.time()}
        about: dict[str, Any] = {
            "name": "multirun",
            "command": command(config),
            "pool": [],
            "report": None,
        }
        folder.save(listed(rows), Path(config.outputs).absolute() / "results", about | made)
    return folder if (folder.path / SWEEP).exists() else None


def _print_jobs(plan: Plan) -> None:
    """What ``dry_run=true`` prints: the jobs, those already done, and the time to expect."""
    for job in plan.jobs:
        if job.fingerprint in {*plan.finished, *plan.todo}:  # resume=failed leaves some
            print(f"{'done' if job.fingerprint in plan.finished else 'to run':8}{job.label}")
    print(f"{len(plan.jobs)} jobs: {len(plan.finished)} done, {len(plan.todo)} to run")
    results = plan.folder.path.parents[1] / "results"
    known = [finished_at(results / key) for key in plan.finished]
    seconds = [sum(one.seconds.values()) for one in known if one is not None]
    if seconds and plan.todo:
        left = sum(seconds) / len(seconds) * len(plan.todo)
        print(f"time to expect: about {duration(left)} of one worker, as its finished jobs took")


def values_of(keys: Sequence[str], job: Job) -> dict[str, str]:
    """``{key: value}`` that a job's configuration has, as text, of those keys that decide a
    number."""
    names = dict.fromkeys(key.lstrip("+~").partition("@")[0] for key in keys)
    known = {key: job.choices[key] for key in names if key in job.choices}
    cfg = OmegaConf.create(dict(job.config))
    return {
        key: known[key] if key in known else _text(OmegaConf.select(cfg, key))
        for key in names
        if key in known or key.partition(".")[0] in job.config
    }


def set_values(cfg: DictConfig, values: Mapping[str, Any]) -> dict[str, str]:
    """Sets values from Python in a configuration; returns the names of the components among them,
    by group.

    Raises:
        OmegaConfBaseException: there is no such key, or it takes no such value.
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


def _combinations(
    settings: list[dict[str, Any]], given: dict[str, list[str]]
) -> list[dict[str, str]]:
    """Values of keys, a mapping a job; each only once."""
    apart = [key for key in given if len({str(setting.get(key)) for setting in settings}) > 1]
    chosen: dict[tuple[str, ...], dict[str, str]] = {}
    for setting in settings:
        own = _parse([f"{key}={_swept_text(value)}" for key, value in setting.items()])
        merged = own | {key: values for key, values in given.items() if key not in apart}
        for combination in itertools.product(*merged.values()):
            values = dict(zip(merged, combination, strict=True))
            if all(values.get(key) in given[key] for key in apart):
                chosen[_overrides(values)] = values
    if not chosen:
        has = "; ".join(
            " ".join(f"{key}={_swept_text(own[key])}" for key in apart if key in own) or "none"
            for own in settings
        )
        asked = ",".join(given[apart[0]])
        raise InputError(apart[0], asked, f"values of one of the sweep's settings: {has}")
    return list(chosen.values())


def _overrides(values: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(f"{key}={value}" for key, value in values.items())


def _parse(overrides: Sequence[str]) -> dict[str, list[str]]:
    """``{key: values}`` of overrides, in their order."""
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
        # Truth values as YAML has them: Hydra gives them in Python's spelling.
        parsed[key] = [{"True": "true", "False": "false"}.get(own, own) for own in values]
    return parsed


def _swept_text(value: Any) -> str:
    """Values of a key in a sweep's file, as an override has them."""
    return ",".join(map(_text, value)) if isinstance(value, list) else _text(value)


def _text(value: Any) -> str:
    """A value as YAML has it; numbers without zeros at their ends."""
    if OmegaConf.is_config(value):
        value = OmegaConf.to_container(value)
    if isinstance(value, float):
        return f"{value:.10g}"
    return value if isinstance(value, str) else json.dumps(value)


def _composed(
    values: dict[str, str], swept: set[str], compose: Compose, lacking: dict[str, Any]
) -> DictConfig:
    """The configuration of one combination. Its values lose the keys that its choice of a swept
    group lacks, such as ``solver.simulations`` where another solver searches; ``lacking`` collects
    them, with Hydra's error and the choices."""
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


class _Composer:
    """Composes once for each choice of groups, since Hydra needs a fifth of a second: overrides
    that only set a value (``lambda=1.5``) change a configuration that is there. All else, and all
    that goes wrong, is left to Hydra.

    Args:
        load: Hydra's composition.
        groups: keys that choose a file.
    """

    def __init__(self, load: Compose, groups: set[str]) -> None:
        self._load, self._groups = load, groups
        self._like: dict[tuple[str, ...], DictConfig] = {}

    def __call__(self, overrides: list[str]) -> DictConfig:
        parsed = OverridesParser.create().parse_overrides(overrides)
        values = [override for override in parsed if self._sets_a_value(override)]
        others = (override.input_line or "" for override in parsed if override not in values)
        kind = (*others, "", *(override.key_or_group for override in values))
        try:
            config = self._like[kind]
            for override in values:
                OmegaConf.update(config, override.key_or_group, override.value())
        except (KeyError, OmegaConfBaseException):
            config = self._load(overrides)
        self._like[kind] = config
        return config

    def _sets_a_value(self, override: Override) -> bool:
        key = override.key_or_group
        plain = override.package is None and not (
            override.is_add() or override.is_force_add() or override.is_delete()
        )
        scalar = isinstance(override.value(), (str, int, float, bool, type(None)))
        return plain and scalar and key not in self._groups and key.partition(".")[0] != "hydra"


def command(config: DictConfig) -> str:
    """What starts the same sweep."""
    given = [*config.hydra.overrides.hydra, *config.hydra.overrides.task]
    words = [word for word in given if not word.startswith("hydra.mode=")]
    prepared = any(word.startswith("sweeps=") for word in words)
    return shlex.join(["python", "-m", "xplain", *([] if prepared else ["-m"]), *words])


@contextmanager
def _watched(folder: SweepFolder, jobs: Sequence[Listed], done: int) -> Iterator[None]:
    """Tells how far the jobs are, by their folders, for the time of the context."""
    began, every = time.time(), done + len(jobs)
    progress, stop = stages(), threading.Event()

    def ended(path: Path) -> bool:  # now, not in an attempt before
        return path.exists() and path.stat().st_mtime >= began - 1

    def look() -> None:
        failed = sum(ended(folder.of(job) / FAILURE) for job in jobs)
        count = failed + sum(ended(folder.address(job) / RESULTS) for job in jobs)
        words = f"{done + count} of {every} jobs done, {failed} failed"
        if 0 < count < len(jobs):
            words += f", about {duration((time.time() - began) / count * (len(jobs) - count))} left"
        progress.note(words)

    def watch() -> None:
        while not stop.wait(POLL):
            look()

    thread = threading.Thread(target=watch, daemon=True)
    with progress.stage("sweep"):
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()
            look()


def duration(seconds: float) -> str:
    """``2 h 05 min``, ``3 min 20 s`` or ``12 s``."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    if whole >= 60:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole} s"
