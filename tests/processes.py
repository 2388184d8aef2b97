"""Processes in separate sessions, which end with the tests.

Such a process gets no signal on Ctrl-C, or when the tests' terminal is closed.
"""

import contextlib
import os
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

_started: list[subprocess.Popen[str]] = []


def start(command: Sequence[str], **how: Any) -> subprocess.Popen[str]:
    """Starts a process like ``subprocess.Popen``. The process leads a session, and is killed with
    its group if the tests end first."""
    process: subprocess.Popen[str] = subprocess.Popen(
        command, text=True, start_new_session=True, **how
    )
    _started.append(process)
    return process


def kill(process: subprocess.Popen[str]) -> None:
    """Kills the process, and all processes that it started, with kill -9."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def group_of(leader: int) -> dict[int, str]:
    """Returns ``{process: command line}`` of a process group, except for ended processes."""
    found = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended
            state, _, group, *_ = stat.read_text().rpartition(")")[2].split()  # see proc(5)
            if int(group) == leader and state != "Z":
                found[int(stat.parent.name)] = (stat.parent / "cmdline").read_text()
    return found


def kill_all() -> None:
    """Kills the processes that still run with kill -9."""
    while _started:
        process = _started.pop()
        if process.poll() is None:
            kill(process)


def end_as_on_ctrl_c() -> None:
    """Makes SIGTERM and a closed terminal end the tests like Ctrl-C, so that everything open is
    closed."""
    # A shell's background job ignores Ctrl-C, and so would all that the tests start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in _ENDS:
        if signal.getsignal(number) == signal.SIG_DFL:  # nohup ignores a closed terminal
            signal.signal(number, _end)


_ENDS = (signal.SIGTERM, signal.SIGHUP)


def _end(*_: object) -> None:
    """Ends the tests once, although both the kernel and the shell report a closed terminal."""
    for number in _ENDS:
        signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt
