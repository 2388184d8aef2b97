"""A study server in a separate process, as a lab starts it, for tests and benchmarks; and any
application in a thread."""

from __future__ import annotations

import re
import socket
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path
from threading import Thread
from typing import Any

import uvicorn

from tests import forked
from xplain.people.flow import Flow
from xplain.people.store import Store

ROOT = Path(__file__).parent.parent.parent


def free_port() -> int:
    """Finds a port that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class ServerProcess:
    """``xplain study``, or another command, on 127.0.0.1. Its database has a plan, or gets the
    plan of the overrides."""

    def __init__(self, database: Path, *overrides: str, command: str = "study") -> None:
        self.command = command
        self.database, self.port, self.overrides = database, free_port(), overrides
        self.url = f"http://127.0.0.1:{self.port}"
        self.key = ""
        self._process: BaseProcess | None = None
        self._log = database.with_suffix(".log")

    def start(self) -> None:
        """Returns when the server answers."""
        self._process = forked.start(
            self.database.parent,
            *(self.command, f"port={self.port}", f"database={self.database}", *self.overrides),
            output=self._log.name,
        )
        until = time.monotonic() + 120  # a plan is perhaps prepared first
        while time.monotonic() < until:
            try:
                with urllib.request.urlopen(self.url, timeout=2):
                    break
            except OSError:
                if self._process.exitcode is not None:
                    raise RuntimeError(self.log()) from None
                time.sleep(0.05)
        else:
            raise RuntimeError(f"no answer: {self.log()}")
        self.key = "".join(re.findall(r"page: /researcher, key (\w+)", self.log()))

    def log(self) -> str:
        """Returns the server's output."""
        return self._log.read_text(encoding="utf-8")

    def kill(self) -> None:
        """Kills the server with -9, at any moment."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None

    def stop(self) -> None:
        """Sends SIGTERM: the server completes the requests that have begun, then ends. It would
        wait for connections that browsers keep open; here it is killed after one second."""
        if self._process is not None:
            self._process.terminate()
            self._process.join(1)
            self.kill()

    def __enter__(self) -> ServerProcess:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()


def serving(database: Path, flow: Flow[Any, Any], *overrides: str) -> ServerProcess:
    """A server of a flow, whose database has the flow's plan."""
    Store(database, flow).close()
    command = flow.PACKAGE.rpartition(".")[2]
    return ServerProcess(database, *overrides, command=command)


@contextmanager
def running(app: Any, **settings: Any) -> Iterator[str]:
    """Serves an application in a thread of this process; yields its address."""
    port = free_port()
    server = uvicorn.Server(uvicorn.Config(app, port=port, log_level="error", **settings))
    thread = Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    try:
        yield f"http{'s' if settings else ''}://127.0.0.1:{port}"
    finally:
        server.should_exit = True
        thread.join()
