"""A service in a thread whose replies may be lost, and its task."""

from __future__ import annotations

import random
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import requests
import uvicorn

from xplain.experiment.config import compose_config
from xplain.people.service.app import create_app
from xplain.people.service.served import Served, make_served
from xplain.people.service.talks import Talks


@pytest.fixture(scope="session")
def task() -> Served:
    return make_served(compose_config("serve", ["questions=8", "ask=clips"]))


@pytest.fixture
def talks(task: Served, tmp_path: Path) -> Iterator[Talks]:
    opened = Talks(tmp_path / "service.sqlite", task)
    yield opened
    opened.close()


def free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


class Running:
    """The service in a thread; ``lose`` of the replies are lost on their way."""

    def __init__(self, talks: Talks, **settings: Any) -> None:
        self.url, self.lose = f"http://127.0.0.1:{(port := free_port())}", 0.0
        app, draw = create_app(talks, **settings), random.Random(0)

        @app.middleware("http")
        async def lossy(request: Any, call_next: Any) -> Any:
            reply = await call_next(request)
            if draw.random() < self.lose:
                reply.status_code = 502
            return reply

        config = uvicorn.Config(app, port=port, log_level="error")
        self.server = uvicorn.Server(config)
        self.thread = threading.Thread(target=self.server.run)
        self.thread.start()
        while not self.server.started:
            time.sleep(0.01)

    def stop(self) -> None:
        self.server.should_exit = True
        self.thread.join()

    def post(self, path: str, **content: Any) -> requests.Response:
        return requests.post(f"{self.url}/{path}", json=content, timeout=20)


@pytest.fixture
def running(talks: Talks) -> Iterator[Running]:
    service = Running(talks, origins=["https://lab.example.org", "null"])
    yield service
    service.stop()
