"""Tests that are ended leave no process behind."""

import os
import signal
import sys
import time
from pathlib import Path

import pytest

from tests import processes

ROOT = Path(__file__).parents[1]
TOY = """
import sys, time
from pathlib import Path
import pytest
from tests import processes

@pytest.mark.parametrize("number", range(2))
def test_that_waits(number):
    server = "import os, subprocess; subprocess.run(['sleep', '300'])"
    process = processes.start([sys.executable, "-c", server])
    Path(f"{number}.pid").write_text(str(process.pid))
    try:
        time.sleep(300)
    finally:
        Path(f"{number}.closed").touch()
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
@pytest.mark.skipif(
    signal.getsignal(signal.SIGHUP) == signal.SIG_IGN,
    reason="under nohup, closed terminals are ignored, as they should be",
)
def test_a_closed_terminal_leaves_nothing_behind(tmp_path: Path) -> None:
    """A terminal that closes sends SIGHUP to all of its processes, but not to other sessions."""
    (tmp_path / "test_toy.py").write_text(TOY)
    with (tmp_path / "output.txt").open("w") as output:
        tests = processes.start(
            [sys.executable, "-m", "pytest", "-p", "tests.conftest", "-n", "2", "test_toy.py"],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=output,
            stderr=output,
        )
    until = time.monotonic() + 120
    while len(began := [*tmp_path.glob("*.pid")]) < 2 and tests.poll() is None:
        assert time.monotonic() < until
        time.sleep(0.1)
    said = (tmp_path / "output.txt").read_text()
    assert "2 processes read all tests" in said
    groups = [int(path.read_text()) for path in began]
    assert len(groups) == 2, said
    assert all(processes.group_of(one) for one in groups)
    for _ in range(2):  # as the kernel and the shell do
        os.killpg(tests.pid, signal.SIGHUP)
    tests.wait(60)
    while (
        any(left := [processes.group_of(one) for one in (*groups, tests.pid)])
        and time.monotonic() < until
    ):
        time.sleep(0.1)
    assert not any(left)
    assert len([*tmp_path.glob("*.closed")]) == 2  # whatever was open was closed, not cut off
