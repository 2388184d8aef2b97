"""Processes in separate sessions, which end with the tests.

Such a process gets no signal when the terminal of the tests is closed, or on Ctrl-C.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Sequence
from typing import Any

_started: list[subprocess.Popen[str]] = []


def start(command: Sequence[str], **how: Any) -> subprocess.Popen[str]:
    """As ``subprocess.Popen``; the process leads a session, and is killed with its group when
    the tests end before it does."""
    process: subprocess.Popen[str] = subprocess.Popen(
        command, text=True, start_new_session=True, **how
    )
    _started.append(process)
    return process


def kill(process: subprocess.Popen[str]) -> None:
    """kill -9 of the process and of all that it started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def kill_all() -> None:
    """kill -9 of those that still run."""
    while _started:
        process = _started.pop()
        if process.poll() is None:
            kill(process)


def end_as_on_ctrl_c() -> None:
    """SIGTERM and a closed terminal end the tests as Ctrl-C does: what they opened is closed."""
    # A shell's background job ignores Ctrl-C, and so would all that the tests start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in _ENDS:
        if signal.getsignal(number) == signal.SIG_DFL:  # nohup ignores a closed terminal
            signal.signal(number, _end)


_ENDS = (signal.SIGTERM, signal.SIGHUP)


def _end(*_: object) -> None:
    """The kernel tells of a closed terminal, and then the shell does: once is enough."""
    for number in _ENDS:
        signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt
