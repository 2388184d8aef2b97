"""Fixtures for all tests: commands that run as a user runs them, in separate folders."""

import gc
import logging
import os
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra.core.global_hydra import GlobalHydra
from hypothesis import settings

from tests import forked, processes
from tests.chromium import Driver, browser, missing
from xplain.cli.main import THRESHOLDS, main

ROOT = Path(__file__).parent.parent
processes.end_as_on_ctrl_c()
gc.set_threshold(*THRESHOLDS)
settings.register_profile("untimed", deadline=None)  # a machine may be busy
settings.load_profile("untimed")

Run = Callable[..., tuple[int, str, str]]

LONGEST = (
    "solvers/test_optimum.py",
    "runs/test_sweep.py",
    "runs/test_interrupted.py",
    "fixed/test_fixed.py",
    "runs/test_saved.py",
    "runs/test_api.py",
    "people/test_dry_runs.py",
    "test_docs.py",
    "conformance/test_shipped.py",
    "runs/test_kill.py",
    "service/test_service.py",
    "report/test_report.py",
    "people/collect/test_protocol.py",
    "test_tables.py",
    "people/test_browser.py",
    "people/test_collect_browser.py",
    "report/test_browser.py",
    "people/test_lab_browser.py",
)
"""Files that take long. The first compiles the kernels of the searches, and the next two need none.
When the fourth begins, it loads those, and compiles the others: no two processes compile the same
kernel."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Starts the longest files first, so that none runs alone at the end."""
    gc.freeze()  # what was imported and collected stays, and is not searched for garbage again
    first = {ROOT / "tests" / file: place for place, file in enumerate(LONGEST)}
    items.sort(key=lambda item: first.get(item.path, len(first)))


def pytest_make_parametrize_id(val: object, argname: str) -> str | None:
    """Names bytes by their argument: gzip writes the time, and all processes need one name."""
    return argname if isinstance(val, bytes) else None


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish() -> None:
    """Runs after the fixtures are removed."""
    processes.kill_all()


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    if config.getoption("markexpr") == "not slow and not browser":
        terminalreporter.write_line(
            "left out: what is slow (make test-slow) or needs a browser (make browser-test)"
        )


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes(config: pytest.Config, specs: list[object]) -> None:
    """Prints a line, because the terminal would otherwise show nothing for a while."""
    terminal = config.pluginmanager.get_plugin("terminalreporter")
    if terminal is not None:
        terminal.ensure_newline()
        terminal.write_line(
            f"{len(specs)} processes read all tests before the first one runs (20 s and more)",
            flush=True,
        )


@pytest.fixture(autouse=True)
def logging_left_alone() -> Iterator[None]:
    """Restores the root logger: Hydra's handlers would later write to a test's closed streams."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    for handler in [one for one in root.handlers if one not in handlers]:
        root.removeHandler(handler)
        handler.close()
    root.setLevel(level)


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Saves figures as files without content (:func:`tests.forked.leave_out_pictures`)."""
    forked.leave_out_pictures(monkeypatch.setattr)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """``run("study replay", path)`` runs ``xplain study replay PATH`` in an empty folder, in this
    process. Returns the exit code, standard output and standard error."""

    def command(words: str, *arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr("sys.argv", ["xplain", *words.split(), *map(str, arguments)])
        GlobalHydra.instance().clear()
        code: int | str | None = 0
        try:
            main()
        except SystemExit as error:
            code = error.code
        out, err = capsys.readouterr()
        return code if isinstance(code, int) else 1, out, err

    return command


@pytest.fixture(scope="session")
def chromium() -> Iterator[Driver]:
    """A Chromium with an empty profile, for all tests of a process: its start takes seconds."""
    if what := missing():
        pytest.skip(f"no browser to drive: install {what}")
    with browser() as opened:
        opened.implicitly_wait(0)  # what is looked for and is not there is known at once
        yield opened


@pytest.fixture
def driver(chromium: Driver) -> Driver:
    """Chromium, which remembers no test before."""
    chromium.get("about:blank")
    chromium.execute_cdp_cmd("Network.clearBrowserCookies", {})
    chromium.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    chromium.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    chromium.get_log("browser")
    return chromium


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20)


@pytest.fixture
def rng_of_the_day() -> np.random.Generator:
    """Makes a generator with another seed each day, for properties that always hold. The output of
    a failed test has the seed; XPLAIN_TEST_SEED sets it again."""
    seed = int(os.environ.get("XPLAIN_TEST_SEED") or datetime.now(UTC).strftime("%Y%m%d"))
    print(f"XPLAIN_TEST_SEED={seed}")
    return np.random.default_rng(seed)
