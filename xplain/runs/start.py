"""Starts what Hydra composes, from the command line and from Python alike: one run, or a sweep.

Nothing heavy is imported before the configuration is known to be one.
"""

from __future__ import annotations

import itertools
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import DictConfig

from xplain.errors import InputError, left_at_once
from xplain.experiment.config import CONF, GROUPS, named
from xplain.experiment.fingerprint import clear_caches
from xplain.experiment.progress import is_terminal
from xplain.runs import hydra_plugins


def start(
    overrides: list[str],
    multirun: bool | None = None,
    config_dir: str | None = None,
    logs: bool = True,
    config_name: str | None = None,
) -> Path | None:
    """Runs the experiment, or the sweep.

    Args:
        overrides: ``key=value`` each, as Hydra has them.
        multirun: whether it is a sweep; None lets the configuration decide (``sweeps=NAME``).
        config_dir: a folder with choices of one's own.
        logs: whether to set up logging, on the terminal and into the folders.
        config_name: of a primary configuration of one's own; None is conf/config.yaml.

    Returns:
        The folder of the run or sweep; None where nothing ran (``dry_run=true``), or another
        sweeper than ours knows it.

    Raises:
        XplainError, HydraException, OmegaConfBaseException: the configuration is wrong.
    """
    hydra_plugins.register()
    path = create_config_search_path(str(CONF))
    if config_dir is not None:
        own = Path(config_dir).absolute()
        if not own.is_dir():
            raise InputError("--config-dir", config_dir, "a folder with choices of your own")
        path.prepend("command-line", f"file://{own}", anchor=SearchPathQuery(provider="schema"))
    theirs = GlobalHydra.instance().hydra  # of a program that uses Hydra itself
    GlobalHydra.instance().clear()
    hydra = Hydra.create_main_hydra2("xplain", path)
    words, name = named(overrides), config_name or "config"
    parsed = OverridesParser.create().parse_overrides(words)
    for given in parsed:
        if given.key_or_group in (*GROUPS, "tracking") and given.value() is None:
            allowed = "none" if given.key_or_group == "tracking" else "the name of a choice"
            raise InputError(given.key_or_group, "null", allowed)
    clear_caches()
    try:
        if multirun is None:
            # It is composed for the answer; nothing else than these can make it a sweep.
            asked = bool(config_dir or config_name) or any(
                "sweeps" in w or "hydra" in w for w in words
            )
            multirun = bool(asked) and hydra.get_mode(name, words) == RunMode.MULTIRUN
        if multirun:
            done = hydra.multirun(name, job, words, logs)
            if isinstance(done, list):  # of Hydra's own sweeper
                for one in itertools.chain(*done):
                    _ = one.return_value  # raises what the job raised
            return done if isinstance(done, Path) else None
        for given in parsed:
            if given.is_sweep_override():
                allowed = "one value; to run one job for each of several, add -m (xplain.sweep)"
                several = (given.input_line or "").partition("=")[2]
                raise InputError(given.key_or_group, several, allowed)
        done = hydra.run(name, job, words, logs)
        if isinstance(done.return_value, BaseException):
            raise done.return_value
        assert done.hydra_cfg is not None
        made = Path(done.hydra_cfg.hydra.runtime.output_dir)
        return made if made.exists() else None
    finally:
        GlobalHydra.instance().hydra = theirs


def job(cfg: DictConfig) -> Any:
    """What launchers ship to workers: one job (:func:`xplain.runs.job.run_job`). Hydra prints lines
    of its own about an error that leaves a run, so it is returned."""
    from xplain.report.stages import stages

    alone = HydraConfig.get().mode == RunMode.RUN
    try:
        shown = stages().stage("loading") if alone and is_terminal(sys.stderr) else nullcontext()
        with shown, left_at_once():
            from xplain.runs.job import run_job

        return run_job(cfg)
    except Exception as error:
        if alone:
            return error
        raise
