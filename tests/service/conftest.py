"""A service, called directly or in a thread, and what it serves."""

import json
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.people.server_process import running
from tests.people.visitors import Client, Reply
from xplain.experiment.config import compose_config
from xplain.people.service.app import create_app
from xplain.people.service.served import ServedTask, make_served
from xplain.people.service.talks import Talks


@pytest.fixture(scope="session")
def task() -> ServedTask:
    return make_served(compose_config("serve", ["questions=8", "ask=clips"]))


@pytest.fixture
def talks(task: ServedTask, tmp_path: Path) -> Iterator[Talks]:
    opened = Talks(tmp_path / "service.sqlite", task)
    yield opened
    opened.close()


class Direct:
    """The service without a network; ``lose`` of the replies are lost on their way."""

    def __init__(self, talks: Talks, **settings: Any) -> None:
        self.client, self.lose = Client(create_app(talks, **settings)), 0.0
        self.draw = random.Random(0)

    def send(self, method: str, path: str, data: Any = None, **headers: str) -> Reply:
        reply = self.client.open(f"/{path}", method=method, data=data, headers=headers)
        if self.draw.random() < self.lose:
            reply.status_code = 502
        return reply

    def get(self, path: str) -> Reply:
        return self.send("GET", path)

    def post(self, path: str, **content: Any) -> Reply:
        return self.send("POST", path, json.dumps(content))


@pytest.fixture
def service(talks: Talks) -> Direct:
    return Direct(talks, origins=["https://lab.example.org", "null"])


@pytest.fixture
def url(talks: Talks) -> Iterator[str]:
    """The address of the service, in a thread."""
    with running(create_app(talks)) as address:
        yield address
