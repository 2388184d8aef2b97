"""Runs and sweeps from Python: the same configuration, cache, folders and MLflow as on the command
line.

    run = xplain.run("solver=pomcp", domain="rescue", trade_off=1.5)
    sweep = xplain.sweep("solver=qmdp,qhr", trade_off=[0.5, 1, 2])
    sweep.frame()

See docs/python.md.
"""

from __future__ import annotations

import logging
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property
from pathlib import Path
from pydoc import locate
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.utils import instantiate
from joblib import Parallel, delayed
from joblib.externals.loky import get_reusable_executor
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from xplain.errors import InputError, XplainError, one_of, quoted
from xplain.experiment.config import (
    CONF,
    GROUPS,
    did_you_mean,
    known_keys,
    one_line,
    register,
    require_names,
)
from xplain.experiment.fingerprint import clear_caches, require_as_loaded
from xplain.experiment.results import RESULTS, Results, load_results
from xplain.report.claims import answer
from xplain.report.compare import table
from xplain.report.frame import SWEEP, TITLES, Summary, warning_about_oracle
from xplain.report.stages import stages
from xplain.runs.discovery import Discovery, discovery, require_writable
from xplain.runs.folder import Listed
from xplain.runs.job import Job, run_alone
from xplain.runs.sweep import Plan, finish, run_in_sweep, run_missing, set_values

if TYPE_CHECKING:
    from matplotlib.axes import Axes

log = logging.getLogger(__name__)

PYTHON = {"trade_off": "lambda"}
"""Keys that Python cannot have as names."""


@dataclass(frozen=True)
class Run:
    """A run that is on disk.

    Attributes:
        folder: of its files.
    """

    folder: Path

    @cached_property
    def results(self) -> Results:
        """All figures, and the configuration (:class:`xplain.experiment.results.Results`)."""
        return load_results(self.folder)

    def frame(self) -> pd.DataFrame:
        """A row an episode, of the solver and of its references; costs are undiscounted."""
        return pd.DataFrame([vars(episode) for episode in self.results.episodes])

    def plot(self) -> list[Axes]:
        """Draws the episode of median cost; returns the axes, whose ``figure`` is the drawing."""
        from xplain.report.trace import draw_typical

        figure, _, _ = draw_typical(self.folder, self.results)
        return figure.axes

    def _repr_html_(self) -> str:
        figures = {name: vars(figure) for name, figure in self.results.metrics.items()}
        shown = pd.DataFrame(figures).T.round(3).to_html(na_rep="", border=0)
        said = warning_about_oracle(self.results.learning, self.results.regret or 0)
        return f"<p>{self.results.name}</p>{shown}<p>{said}</p>"


@dataclass(frozen=True)
class Sweep:
    """A sweep that is on disk, with the jobs that are finished.

    Attributes:
        folder: of its files; ``report/index.html`` is its report.
        measure: what its jobs are compared by; None takes what is fair.
    """

    folder: Path
    measure: str | None = None

    @cached_property
    def summary(self) -> Summary:
        """What its jobs say (:class:`xplain.report.frame.Summary`)."""
        return Summary(self.folder, self.measure)

    @property
    def answer(self) -> str:
        """Who costs least, by how much, and whether that is decided; "" where nothing competes."""
        return answer(self.summary)

    @property
    def runs(self) -> list[Run]:
        """Its finished jobs, in order."""
        return [Run(self.summary.address(job)) for job, _ in self.summary.results]

    def frame(self, rows: str = "jobs") -> pd.DataFrame:
        """The swept values and what came out.

        Args:
            rows: ``jobs``, with means over episodes, or ``episodes``.

        Raises:
            InputError: rows of another kind.
        """
        if one_of("rows", rows, ("jobs", "episodes")) == "episodes":
            return self.summary.episodes.copy()
        return pd.DataFrame(
            {
                **self.summary.values_of(job, results),
                "seed": results.seed,
                **{name: figure.mean for name, figure in results.metrics.items()},
            }
            for job, results in self.summary.results
        )

    def plot(self, measure: str | None = None) -> list[Axes]:
        """Draws a measure against the main swept key, a panel a combination of what is left;
        returns the panels' axes.

        Args:
            measure: a column of ``frame("episodes")``; None takes the sweep's own.

        Raises:
            InputError: nothing was swept, or no episode has the measure.
        """
        from xplain.report.plots import against_main_key

        name = one_of("measure", measure or self.summary.measure.name, TITLES)
        figure = against_main_key(self.summary, name)
        if figure is None:
            raise InputError("measure", name, "one that is known, of a sweep of several jobs")
        return figure.axes

    def _repr_html_(self) -> str:
        own = table(self.summary)
        return f"<p>{self.answer}</p><p>{own.about}</p>{own.html()}<p>{own.caption}</p>"


def run(*overrides: str, config_dir: str | None = None, **keys: Any) -> Run:
    """Runs one experiment in this process.

    Args:
        overrides: ``key=value`` each, as on the command line.
        config_dir: a folder with choices of one's own.
        keys: the same keys; ``trade_off`` is λ, ``users_count`` is ``users.count``. A component
            may be an object of its class instead of a name.

    Raises:
        XplainError: a key or value that is not allowed, in one line.
    """
    with _started():
        words, objects = _split(keys)
        several = {key: values for key, values in objects.items() if len(values) > 1}
        for key, values in several.items():
            raise InputError(key, values, "one value; xplain.sweep runs a job for each of several")
        with _composing([*overrides, *words], config_dir) as composed:
            cfg = composed([*overrides, *words])
            own = {key: value for key, (value,) in objects.items()}
            choices = dict(cfg.hydra.runtime.choices) | set_values(cfg, own)
            job, folder = Job.of(cfg, choices), Path(cfg.hydra.run.dir).absolute()
        require_as_loaded(job.config)
        if cfg.dry_run:
            raise InputError("dry_run", True, "false: nothing ran")
        there = folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        try:
            run_alone(job, folder, instantiate(cfg.tracking), stages(), shown=False)
        finally:
            if not there and not any(folder.iterdir()):
                folder.rmdir()
        return Run(folder)


def sweep(
    *overrides: str, config_dir: str | None = None, measure: str | None = None, **keys: Any
) -> Sweep:
    """Runs all combinations of what is listed; what is finished already is not run again.

    Args:
        overrides, config_dir, keys: as of :func:`run`; a list has the values of a key, as commas
            have on the command line. ``sweeps=NAME`` is a prepared sweep.
        measure: what jobs are compared by; None takes what is fair.

    Raises:
        XplainError: a key or value that is not allowed, in one line; nothing was run.
    """
    with _started():
        began = time.time()
        chosen, objects = _split(keys)
        words = [*overrides, *chosen]
        single = [one for one in words if not _parsed(one).is_sweep_override()]
        with _composing(words, config_dir) as composed:
            config = composed(single)
            config.hydra.overrides.task = words  # all of them
            alike = {key: values[0] for key, values in objects.items() if len(values) == 1}
            set_values(config, alike)
            file: Any = OmegaConf.to_container(config.hydra.sweeper)
            named = {key: value for key, value in file.items() if not key.startswith("_")}
            where = [one for one in single if one.startswith("hydra")]
            task = [one for one in words if one not in where]
            plan = Plan.of(config, named, task, objects, lambda own: composed([*where, *own]))
        for one in plan.todo.values():
            require_as_loaded(one.config)
        workers = config.hydra.launcher.get("n_jobs", 1)
        for key, values in objects.items():
            if workers != 1 and key in GROUPS and any(map(_is_of_this_program, values)):
                allowed = "a component from a file: workers of a sweep import it (or n_jobs=1)"
                raise InputError(key, values[0]["_target_"], allowed)

        def launch(batches: list[list[Listed]], _: Any) -> list[Any]:
            calls = [
                delayed(_run_batch)(
                    [(plan.todo[job.fingerprint], plan.folder.of(job)) for job in batch]
                )
                for batch in batches
            ]
            try:
                Parallel(n_jobs=workers, batch_size=1)(calls)
            finally:
                get_reusable_executor().shutdown()  # a worker has the code of its first job
            return []

        run_missing(plan, launch)
        if config.dry_run:
            raise InputError("dry_run", True, "false: nothing ran")
        outputs = plan.folder.path.parents[1]
        finish(plan.folder, instantiate(config.tracking), outputs, began, log.info, shown=False)
        return Sweep(plan.folder.path, measure)


def _run_batch(batch: Sequence[tuple[Job, Path]]) -> None:
    for job, folder in batch:
        run_in_sweep(job, folder, folder.name)


def discover(
    data: str | Path | pd.DataFrame, *overrides: str, config_dir: str | None = None, **keys: Any
) -> Discovery:
    """Finds the user types in people's labels.

    Args:
        data: a table with the columns observer, messages, label and features: a file, or a frame.
        overrides, config_dir, keys: of conf/discover.yaml, as of :func:`run`. Files are written
            where ``output`` is given.

    Raises:
        XplainError: a table, key or value that is not allowed, in one line.
    """
    with _started(), tempfile.TemporaryDirectory() as place:
        path = Path(place) / "labels.csv"
        if isinstance(data, pd.DataFrame):
            data.to_csv(path, index=False)
        words, objects = _split(keys, "discover")
        known = _composing([*overrides, *words], config_dir, "discover")
        with known as composed:
            cfg = composed([*overrides, *words])
        given = path if isinstance(data, pd.DataFrame) else data
        set_values(cfg, {"data": str(given), **{key: own[0] for key, own in objects.items()}})
        if "output" in objects:
            require_writable(Path(cfg.output))
        found = discovery(cfg)
        if "output" in objects:
            found.save(Path(cfg.output))
        return found


def load(folder: str | Path, measure: str | None = None) -> Run | Sweep:
    """A run or sweep that is on disk.

    Raises:
        InputError: the folder is none.
    """
    path = Path(folder)
    if (path / SWEEP).exists():
        return Sweep(path, measure)
    if (path / RESULTS).exists():
        return Run(path)
    raise InputError("folder", str(folder), "of a run or a sweep, below outputs/")


_ONE_AT_A_TIME = threading.RLock()
"""Hydra keeps what it composes in globals of the process: a second thread waits."""


@contextmanager
def _started() -> Iterator[None]:
    """Errors of the caller's making are one line; what it is at goes to standard error, unless the
    program has logging of its own."""
    own = logging.getLogger("xplain")
    quiet = bool(logging.getLogger().handlers or own.handlers)
    handler, level = logging.StreamHandler(sys.stderr), own.level
    with _ONE_AT_A_TIME:
        clear_caches()  # a component may have been edited since the last call
        try:
            if not quiet:
                own.addHandler(handler)
                own.setLevel(logging.INFO)
            yield
        except XplainError:
            raise
        except (HydraException, OmegaConfBaseException, YAMLError, OSError) as error:
            text = one_line(error)
            if text is None:
                raise
            raise XplainError(text) from None
        finally:
            if not quiet:
                own.removeHandler(handler)
                own.setLevel(level)


@contextmanager
def _composing(words: Sequence[str], config_dir: str | None, name: str = "config") -> Iterator[Any]:
    """Hydra's composition, from overrides to a configuration with the ``hydra`` node."""
    where = []
    if config_dir is not None:
        if not Path(config_dir).is_dir():
            raise InputError("config_dir", config_dir, "a folder with choices of your own")
        where = [f"hydra.searchpath=[{quoted(f'file://{Path(config_dir).absolute()}')}]"]
    register()
    require_names(words)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield lambda own: compose(name, [*where, *own], return_hydra_config=True)


def _parsed(word: str) -> Any:
    return OverridesParser.create().parse_override(word)


def _split(keys: Mapping[str, Any], of: str = "config") -> tuple[list[str], dict[str, list[Any]]]:
    """Choices by name, as overrides, and values that Python gives, a list each."""
    words, objects = list[str](), dict[str, list[Any]]()
    for name, given in keys.items():
        key = _key(name, of)
        value = given.tolist() if isinstance(given, np.ndarray | np.generic) else given
        several = list(value) if isinstance(value, list | tuple | range) else [value]
        groups = (*GROUPS, "tracking", "sweeps")
        if key in groups and all(isinstance(one, str | None) for one in several):
            words.append(f"{key}={','.join('null' if one is None else one for one in several)}")
        else:
            objects[key] = [_plain(key, one) for one in several]
    return words, objects


def _key(name: str, of: str) -> str:
    """A keyword as a key of the configuration: ``users_count`` is ``users.count``."""
    known = known_keys(of)
    group, _, inside = name.partition("_")
    if name in PYTHON:
        return PYTHON[name]
    if name not in known and inside in known.get(group, {}):
        return f"{group}.{inside}"
    if name.partition(".")[0] not in (*known, "hydra"):
        names = [*PYTHON, *known, *(f"{key}_{one}" for key in known for one in known[key])]
        hint = did_you_mean(name, names)
        raise XplainError(f"{name}: no such key;{hint or ' allowed: ' + ', '.join(known)}")
    return name


def _plain(key: str, value: Any) -> Any:
    """A value as a configuration holds it; of an object its class and its constructor's arguments.

    Raises:
        InputError: an object whose class cannot be found by its name.
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(name): _plain(key, own) for name, own in value.items()}
    if isinstance(value, Sequence):
        return [_plain(key, own) for own in value]
    kind = type(value)
    path = f"{kind.__module__}.{kind.__qualname__}"
    if not is_dataclass(value) or locate(path) is not kind:
        allowed = "a name, or an object of a dataclass that stands in a module or script by itself"
        raise InputError(key, value, allowed)
    own = {one.name: _plain(key, getattr(value, one.name)) for one in fields(value) if one.init}
    return {"_target_": path, **own}


def _is_of_this_program(node: Any) -> bool:
    """Whether workers cannot import a component: its class stands in the script or notebook."""
    return isinstance(node, Mapping) and str(node.get("_target_")).startswith("__main__.")
