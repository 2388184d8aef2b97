"""A study server in a separate process, as a lab starts it, for tests and benchmarks."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from types import TracebackType

from filelock import FileLock

from tests import processes

ROOT = Path(__file__).parent.parent.parent


def free_port() -> int:
    """Finds a port that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class ServerProcess:
    """``python -m xplain study`` (or ``collect``) on 127.0.0.1, with a database that has a plan, or
    gets the plan of the overrides."""

    def __init__(self, database: Path, *overrides: str, command: str = "study") -> None:
        self.command = command
        self.database, self.port, self.overrides = database, free_port(), overrides
        self.url = f"http://127.0.0.1:{self.port}"
        self.key = ""
        self._process: subprocess.Popen[str] | None = None
        self._log = database.with_suffix(".log")

    def start(self) -> None:
        """Returns when the server answers."""
        command = [
            *(sys.executable, "-m", "xplain", self.command, f"port={self.port}"),
            *(f"database={self.database}", *self.overrides),
        ]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        with self._log.open("w", encoding="utf-8") as log:
            self._process = processes.start(
                command, cwd=self.database.parent, env=environment, stderr=log, stdout=log
            )
        until = time.monotonic() + 120  # a plan is perhaps prepared first
        while time.monotonic() < until:
            try:
                with urllib.request.urlopen(f"{self.url}/alive", timeout=2):
                    break
            except OSError:
                if self._process.poll() is not None:
                    raise RuntimeError(self.log()) from None
                time.sleep(0.05)
        else:
            raise RuntimeError(f"no answer: {self.log()}")
        found = re.search(r"key (\w+)", self.log())
        assert found, self.log()
        self.key = found.group(1)

    def log(self) -> str:
        """Returns the server's output."""
        return self._log.read_text(encoding="utf-8")

    def kill(self) -> None:
        """Kills the server and its worker with -9, at any moment."""
        if self._process is not None:
            processes.kill(self._process)
            self._process = None

    def stop(self) -> None:
        """Sends SIGTERM: the server completes the requests that have begun, then ends. It would
        wait ten seconds for connections that browsers keep open, and then kill its worker; here
        both are killed after one second."""
        if self._process is not None:
            self._process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(timeout=1)
            self.kill()
            with FileLock(f"{self.database}.lock", timeout=30):
                pass  # the worker, which is not our child, has let go of it

    def __enter__(self) -> ServerProcess:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()
