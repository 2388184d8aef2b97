"""Runs and sweeps from Python: the same configuration, cache, folders and MLflow as on the command
line.

    run = xplain.run("solver=pomcp", domain="rescue", trade_off=1.5)
    sweep = xplain.sweep("solver=qmdp,qhr", trade_off=[0.5, 1, 2])
    sweep.frame()

See docs/python.md.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property
from pathlib import Path
from pydoc import locate
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from joblib.externals.loky import get_reusable_executor
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from xplain.errors import InputError, XplainError, one_of, quoted
from xplain.experiment.config import known_keys, one_line
from xplain.experiment.results import Results, load_results
from xplain.report.comparison import answer, main_table
from xplain.report.measure import TITLES
from xplain.report.summary import Summary
from xplain.runs.start import start
from xplain.runs.terminal import without_tables

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
        from xplain.report.traces import draw_typical

        figure, _, _ = draw_typical(self.folder, self.results.scene)
        return figure.axes

    def _repr_html_(self) -> str:
        figures = {name: vars(figure) for name, figure in self.results.metrics.items()}
        shown = pd.DataFrame(figures).T.round(3).to_html(na_rep="", border=0)
        return f"<p>{self.results.name}</p>{shown}"


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
        """What its jobs say (:class:`xplain.report.summary.Summary`)."""
        return Summary(self.folder, self.measure)

    @property
    def answer(self) -> str:
        """Who costs least, by how much, and whether that is decided; "" where nothing competes."""
        return answer(self.summary)

    @property
    def runs(self) -> list[Run]:
        """Its finished jobs, in order."""
        return [Run(self.summary.folder_of(job)) for job, _ in self.summary.results]

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
        from xplain.report.sweep_plots import against_main_key

        name = one_of("measure", measure or self.summary.measure.name, TITLES)
        figure = against_main_key(self.summary, name, TITLES[name])
        if figure is None:
            raise InputError("measure", name, "one that is known, of a sweep of several jobs")
        return figure.axes

    def _repr_html_(self) -> str:
        table = main_table(self.summary)
        rows = [[table.text(cell) for cell in row] for row in table.body]
        shown = pd.DataFrame(rows, columns=[*table.heads]).to_html(index=False, border=0)
        return f"<p>{self.answer}</p><p>{table.about}</p>{shown}<p>{table.caption}</p>"


def run(*overrides: str, config_dir: str | None = None, **keys: Any) -> Run:
    """Runs one experiment.

    Args:
        overrides: ``key=value`` each, as on the command line.
        config_dir: a folder with choices of one's own.
        keys: the same keys; ``trade_off`` is λ, ``users_count`` is ``users.count``. A component
            may be an object of its class instead of a name.

    Raises:
        XplainError: a key or value that is not allowed, in one line.
    """
    return Run(_started([*overrides, *_words(keys)], False, config_dir))


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
    return Sweep(_started([*overrides, *_words(keys)], True, config_dir), measure)


def load(folder: str | Path, measure: str | None = None) -> Run | Sweep:
    """A run or sweep that is on disk.

    Raises:
        InputError: the folder is none.
    """
    path = Path(folder)
    if (path / "sweep.json").exists():
        return Sweep(path, measure)
    if (path / "results.json").exists():
        return Run(path)
    raise InputError("folder", str(folder), "of a run or a sweep, below outputs/")


_ONE_AT_A_TIME = threading.RLock()
"""Hydra keeps what runs in globals of the process: a second thread waits."""


def _started(words: list[str], multirun: bool, config_dir: str | None) -> Path:
    """The folder; tables, which the result shows itself, are not printed."""
    try:
        with _ONE_AT_A_TIME, _told(), without_tables():
            try:
                folder = start(words, multirun, config_dir, logs=False)
            finally:
                if multirun:  # a worker has the code of its first job
                    get_reusable_executor().shutdown()
        if folder is None:
            raise InputError("dry_run", True, "false: nothing ran")
        return folder
    except XplainError:
        raise
    except (HydraException, OmegaConfBaseException, YAMLError, OSError) as error:
        text = one_line(error)
        if text is None:
            raise
        raise XplainError(text) from None


@contextmanager
def _told() -> Iterator[None]:
    """What it is at goes to standard error, unless the program has logging of its own."""
    log = logging.getLogger("xplain")
    if logging.getLogger().handlers or log.handlers:
        yield
        return
    handler, level = logging.StreamHandler(sys.stderr), log.level
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)


def _words(keys: Mapping[str, Any]) -> list[str]:
    """``key=value`` of keywords."""
    plain = {
        key: value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        for key, value in keys.items()
    }
    several = {
        key: value if isinstance(value, list | tuple | range) else [value]
        for key, value in plain.items()
    }
    return [
        f"{_key(key)}={','.join(_text(key, one) for one in values)}"
        for key, values in several.items()
    ]


def _key(key: str) -> str:
    """A keyword as a key of the configuration: ``users_count`` is ``users.count``."""
    group, _, inside = key.partition("_")
    known = known_keys()
    if key not in known and inside in known.get(group, {}):
        return f"{group}.{inside}"
    return PYTHON.get(key, key)


def _text(key: str, value: Any) -> str:
    """A value as it is written on the command line."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float):
        return json.dumps(value)
    if isinstance(value, str | Path):
        value = str(value)
        if re.fullmatch(r"[\w.@/+-]+", value):
            return value
        return quoted(value)
    if isinstance(value, list | tuple) and not any(map(is_dataclass, value)):
        return f"[{','.join(_text(key, one) for one in value)}]"
    if isinstance(value, Mapping):
        inside = ", ".join(f"{name}: {_text(key, own)}" for name, own in value.items())
        return f"{{{inside}}}"
    node = _node(key, value)
    digest = hashlib.sha256(json.dumps(node, sort_keys=True).encode()).hexdigest()
    name = f"{type(value).__name__}_{digest[:4]}"
    ConfigStore.instance().store(name=name, node=node, group=key)
    return name


def _node(key: str, value: Any) -> Any:
    """What a configuration holds of an object: its class and its constructor's arguments."""
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, Mapping):
        return {str(name): _node(key, own) for name, own in value.items()}
    if isinstance(value, Sequence):
        return [_node(key, own) for own in value]
    kind = type(value)
    path = f"{kind.__module__}.{kind.__qualname__}"
    if not is_dataclass(value) or locate(path) is not kind or kind.__module__ == "__main__":
        allowed = (
            "a name, or an object of a dataclass in a module: its sources are part of a result"
        )
        raise InputError(key, value, allowed)
    own = {
        field.name: _node(key, getattr(value, field.name)) for field in fields(value) if field.init
    }
    return {"_target_": path, **own}
