"""Runs and sweeps from Python, with the same configuration, cache, folders and MLflow as on the
command line.

    run = xplain.run("solver=pomcp", domain="rescue", trade_off=1.5)
    sweep = xplain.sweep("solver=qmdp,qhr", trade_off=[0.5, 1, 2])
    sweep.frame()

See docs/python.md.
"""

from __future__ import annotations

import json
import logging
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property
from pathlib import Path
from pydoc import locate
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from hydra.core.override_parser.types import Override
from hydra.utils import instantiate
from joblib import Parallel, delayed
from joblib.externals.loky import get_reusable_executor
from omegaconf import DictConfig

from xplain.errors import InputError, XplainError, escape, one_of
from xplain.experiment.config import (
    GROUPS,
    PYTHON,
    USER_ERRORS,
    compose_config,
    did_you_mean,
    one_line,
    require_names,
    search_path,
)
from xplain.experiment.fingerprint import clear_caches, require_as_loaded
from xplain.experiment.results import RESULTS, Results, load_results
from xplain.report.claims import answer
from xplain.report.compare import table
from xplain.report.folder import SWEEP
from xplain.report.frame import TITLES, Summary, warning_about_oracle
from xplain.report.stages import Stages
from xplain.runs.job import Job, run_alone, run_batch
from xplain.runs.labels import Discovery, discovery
from xplain.runs.plan import Compose, Plan, compose_values, make_overrides, parse
from xplain.runs.sweep import finish, run_missing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Run:
    """A run on disk.

    Attributes:
        folder: folder of its files.
    """

    folder: Path

    @cached_property
    def results(self) -> Results:
        """All figures, and the configuration (:class:`xplain.experiment.results.Results`)."""
        return load_results(self.folder)

    def frame(self) -> pd.DataFrame:
        """Makes a row for each episode of the solver and its references; costs are undiscounted."""
        return pd.DataFrame([vars(episode) for episode in self.results.episodes])

    def plot(self) -> list[Axes]:
        """Draws the episode of median cost. Returns the axes; their ``figure`` is the drawing."""
        from xplain.report.trace import draw_typical

        figure, _, _ = draw_typical(self.folder, self.results)
        return figure.axes

    def _repr_html_(self) -> str:
        figures = {name: vars(figure) for name, figure in self.results.metrics.items()}
        shown = pd.DataFrame(figures).T.round(3).to_html(na_rep="", border=0)
        said = warning_about_oracle(self.results.learning, self.results.regret)
        return f"<p>{self.results.name}</p>{shown}<p>{said}</p>"


@dataclass(frozen=True)
class Sweep:
    """A sweep on disk, with its finished jobs.

    Attributes:
        folder: folder of its files; ``report/index.html`` is its report.
        measure: the measure that compares the jobs; None chooses a measure that is fair to all.
    """

    folder: Path
    measure: str | None = None

    @cached_property
    def summary(self) -> Summary:
        """The results of the sweep's jobs (:class:`xplain.report.frame.Summary`)."""
        return Summary(self.folder, self.measure)

    @property
    def answer(self) -> str:
        """Sentences that say which solver or setting costs least, by how much, and if the 95 %
        interval of the difference excludes 0; "" if there is nothing to compare."""
        return answer(self.summary)

    @property
    def runs(self) -> list[Run]:
        """The runs of the finished jobs, in the order of the sweep's list of jobs."""
        return [Run(self.summary.folder.address(job)) for job, _ in self.summary.results]

    def frame(self, rows: str = "jobs") -> pd.DataFrame:
        """Makes a table of the swept values and the results.

        Args:
            rows: ``jobs`` makes a row for each job, with means over its episodes; ``episodes``
                makes a row for each episode.

        Raises:
            InputError: ``rows`` is another word.
        """
        if one_of("rows", rows, ("jobs", "episodes")) == "episodes":
            return self.summary.episodes.copy()
        metrics = [one.metrics.items() for _, one in self.summary.results]
        means = [{name: figure.mean for name, figure in own} for own in metrics]
        return self.summary.swept.join(pd.DataFrame(means))

    def plot(self, measure: str | None = None) -> list[Axes]:
        """Draws a measure against the main swept key, with a panel for each combination of the
        other keys. Returns the panels' axes.

        Args:
            measure: a column of ``frame("episodes")``; None takes the sweep's measure.

        Raises:
            InputError: nothing was swept, or no episode has the measure.
        """
        from xplain.report.plots import against_main_key

        name = one_of("measure", measure or self.summary.measure.name, TITLES)
        figure = against_main_key(self.summary, name)
        if figure is None:
            raise InputError(
                "measure", name, "a measure that the jobs have, and a sweep of several jobs"
            )
        return figure.axes

    def _repr_html_(self) -> str:
        own = table(self.summary)
        return f"<p>{self.answer}</p><p>{own.about}</p>{own.html()}<p>{own.caption}</p>"


def run(*overrides: str, config_dir: str | None = None, **keys: Any) -> Run:
    """Runs one experiment in this process.

    Args:
        overrides: texts ``key=value``, as on the command line.
        config_dir: a folder with your own choices.
        keys: keys and values as keyword arguments; ``trade_off`` is λ, ``users_count`` is
            ``users.count``. A component may be an object of its class instead of a name.

    Raises:
        XplainError: a key or value is not allowed; the text is one line.
    """
    with _open_request(overrides, keys, config_dir) as (_, axes, compose):
        cfg = _compose_single(axes, compose)
        job = Job.of(cfg, cfg.hydra.runtime.choices)
        _require_runnable([job], cfg)
        folder = Path(cfg.hydra.run.dir).absolute()
        run_alone(job, folder, instantiate(cfg.tracking), Stages(), shown=False)
        return Run(folder)


def sweep(
    *overrides: str, config_dir: str | None = None, measure: str | None = None, **keys: Any
) -> Sweep:
    """Runs all combinations of the listed values. Finished jobs are not run again.

    Args:
        overrides, config_dir, keys: as in :func:`run`; a list has the values of a key, like commas
            on the command line. ``sweeps=NAME`` is a prepared sweep.
        measure: the measure that compares jobs; None chooses a measure that is fair to all.

    Raises:
        XplainError: a key or value is not allowed, and no job was run; the text is one line.
    """
    with _open_request(overrides, keys, config_dir) as (words, axes, compose):
        began = time.time()
        config = compose_values(compose, [own[0] for own in axes.values() if len(own) == 1])
        config.hydra.overrides.task = words  # with the swept overrides
        plan = Plan.of(config, axes, compose)
        _require_runnable(plan.todo.values(), config)
        workers = config.hydra.launcher.get("n_jobs", 1)
        for key in GROUPS if workers != 1 else ():
            for value in (one.value() for one in axes.get(key, ())):
                if isinstance(value, dict) and value["_target_"].startswith("__main__."):
                    allowed = "a component from a file that the workers can import (or n_jobs=1)"
                    raise InputError(key, value["_target_"], allowed)

        def launch(batches: Sequence[Path]) -> None:
            try:
                Parallel(workers, batch_size=1)(delayed(run_batch)(path) for path in batches)
            finally:
                get_reusable_executor().shutdown()  # workers keep the code of their first job

        run_missing(plan, launch)
        outputs = plan.folder.path.parents[1]
        finish(plan.folder, instantiate(config.tracking), outputs, began, log.info, shown=False)
        return Sweep(plan.folder.path, measure)


def discover(
    data: str | Path | pd.DataFrame, *overrides: str, config_dir: str | None = None, **keys: Any
) -> Discovery:
    """Finds the user types in people's labels.

    Args:
        data: a table with the columns observer, messages, label and features: a file, or a frame.
        overrides, config_dir, keys: as in :func:`run`, with the keys of conf/discover.yaml. A list
            is one value, such as ``features=["row", "column"]``. Files are written only if
            ``output`` is given.

    Raises:
        XplainError: a table, key or value is not allowed; the text is one line.
    """
    values = {key: [own] if isinstance(own, list | tuple) else own for key, own in keys.items()}
    request = _open_request(overrides, values, config_dir, "discover")
    with request as (_, axes, compose), tempfile.TemporaryDirectory() as place:
        if isinstance(data, pd.DataFrame):
            frame, data = data, Path(place) / "labels.csv"
            frame.to_csv(data, index=False)
        path = make_overrides("data", _make_plain("data", Path(data)))
        cfg = _compose_single(axes | {"data": path}, compose)
        return discovery(cfg, Path(cfg.output) if "output" in axes else None)


def load(folder: str | Path, measure: str | None = None) -> Run | Sweep:
    """Loads a run or sweep from disk.

    Raises:
        InputError: the folder contains neither a run nor a sweep.
    """
    path = Path(folder)
    if (path / SWEEP).exists():
        return Sweep(path, measure)
    if (path / RESULTS).exists():
        return Run(path)
    raise InputError("folder", str(folder), "the folder of a run or a sweep, below outputs/")


_ONE_AT_A_TIME = threading.RLock()
"""A lock, because Hydra's composition uses global variables."""

Request = tuple[list[str], dict[str, list[Override]], Compose]
"""The overrides of a call; the values of each key, including the keywords; and Hydra's
composition."""


@contextmanager
def _open_request(
    overrides: Sequence[str], keys: Mapping[str, Any], config_dir: str | None, of: str = "config"
) -> Iterator[Request]:
    """Opens a context in which a function of this module composes configurations. An error in the
    ``with`` block that the caller can correct is raised as an XplainError with a text of one line.
    Progress is logged to standard error, unless the program configures logging itself."""
    own = logging.getLogger("xplain")
    quiet, level = bool(logging.getLogger().handlers or own.handlers), own.level
    handler = logging.NullHandler() if quiet else logging.StreamHandler(sys.stderr)
    with _ONE_AT_A_TIME:
        clear_caches()  # a component may have been edited since the last call
        try:
            own.addHandler(handler)
            own.setLevel(level if quiet else logging.INFO)
            where = search_path("config_dir", config_dir)

            def compose(words: list[str]) -> DictConfig:
                return compose_config(of, [*where, *words], with_hydra=True)

            known, given = [*map(str, compose([])), "sweeps"], dict[str, list[Override]]()
            for name, value in keys.items():
                key = _find_key(name, known)
                given[key] = make_overrides(key, _make_plain(key, value))
            words = [*overrides]
            for key, values in given.items():
                if texts := [one.get_value_string() for one in values if one.input_line]:
                    words.append(f"{key}={','.join(texts)}")
            require_names(words)
            yield words, parse(overrides) | given, compose
        except USER_ERRORS as error:
            text = one_line(error)
            if text is None:
                raise
            raise XplainError(text) from None
        finally:
            own.removeHandler(handler)
            own.setLevel(level)


def _require_runnable(jobs: Iterable[Job], cfg: DictConfig) -> None:
    """Refuses jobs whose code was edited after it was loaded, and ``dry_run``, which runs no
    job."""
    if cfg.dry_run:
        raise InputError("dry_run", True, "false: only the command line has dry runs")
    for job in jobs:
        require_as_loaded(job.config)


def _compose_single(axes: Mapping[str, Sequence[Override]], compose: Compose) -> DictConfig:
    """Composes the configuration of a call that allows one value of each key.

    Raises:
        InputError: a key has several values.
    """
    for key, own in axes.items():
        if len(own) != 1:
            values = [one.value() for one in own]
            raise InputError(key, values, "one value; xplain.sweep accepts several values")
    return compose_values(compose, [one for own in axes.values() for one in own])


def _find_key(name: str, known: Sequence[str]) -> str:
    """Returns the configuration key of a keyword: ``users_count`` is ``users.count``."""
    name = PYTHON.get(name, name)
    group, _, inside = name.partition("_")
    if name not in known and inside and group in known:
        return f"{group}.{inside}"
    if name.partition(".")[0] not in known:
        hint = did_you_mean(name, [*PYTHON, *known])
        raise XplainError(f"{name}: no such key;{hint or ' allowed: ' + ', '.join(known)}")
    return name


def _make_plain(key: str, value: Any) -> Any:
    """Converts a value to plain data for a configuration. An object becomes the path of its class
    with the arguments of its constructor.

    Raises:
        InputError: the class of an object cannot be found by its name.
    """

    def describe(own: Any) -> Any:  # what JSON has no form for
        if isinstance(own, np.generic | np.ndarray):
            return own.tolist()
        if isinstance(own, Path):
            return str(own)
        if isinstance(own, Sequence):
            return list(own)
        if isinstance(own, Mapping):
            return dict(own)
        path = f"{type(own).__module__}.{type(own).__qualname__}"
        described = is_dataclass(own) or hasattr(own, "get_params")
        if isinstance(own, type) or locate(path) is not type(own) or not described:
            allowed = "a name, or an object of a dataclass at the top level of a module or script"
            raise InputError(key, own, allowed)
        if is_dataclass(own):
            return {"_target_": path} | {
                f.name: getattr(own, f.name) for f in fields(own) if f.init
            }
        return {"_target_": path, **own.get_params(deep=False)}  # a model of scikit-learn

    return escape(json.loads(json.dumps(value, default=describe)))
