"""A real Chromium behind a proxy that answers for the server: no entered text is lost."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import requests

from tests.chromium import Driver, choose, go_in, press, sequence, wait
from tests.people.server_process import ServerProcess
from xplain.people.bots import Researcher
from xplain.people.store import Store
from xplain.people.study.flow import Study

pytest.importorskip("selenium", reason="selenium is not installed")
pytestmark = pytest.mark.browser


class Proxy(ThreadingHTTPServer):
    """Forwards requests, or answers in place of the server.

    Attributes:
        status: status of the proxy's own answers to forms; 0 forwards forms.
        answered: number of the proxy's own answers.
    """

    def __init__(self, target: str) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.target, self.status, self.answered = target, 0, 0


class Handler(BaseHTTPRequestHandler):
    server: Proxy

    def do_GET(self) -> None:
        self.hand_on(b"")

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if self.server.status and self.path == "/study":
            self.server.answered += 1
            self.send_response(self.server.status)
            self.send_header("Location", "/elsewhere")
            self.send_header("Content-Length", "0")
            self.end_headers()
        else:
            self.hand_on(body)

    def hand_on(self, body: bytes) -> None:
        address = self.server.target + self.path
        reply = requests.request(
            self.command, address, data=body, headers=dict(self.headers), allow_redirects=False
        )
        self.send_response(reply.status_code)
        for name, value in reply.headers.items():
            if name.lower() not in ("connection", "transfer-encoding", "content-length"):
                self.send_header(name, value)
        self.send_header("Content-Length", str(len(reply.content)))
        self.end_headers()
        self.wfile.write(reply.content)

    def log_message(self, format: str, *args: object) -> None:
        pass


@contextmanager
def proxied(target: str) -> Iterator[Proxy]:
    proxy = Proxy(target)
    threading.Thread(target=proxy.serve_forever, daemon=True).start()
    try:
        yield proxy
    finally:
        proxy.shutdown()
        proxy.server_close()


def test_an_answer_outlives_what_a_proxy_says(driver: Driver, study: Study, tmp_path: Path) -> None:
    path, statuses = tmp_path / "s.sqlite", (302, 403, 404, 502, 503)
    Store(path, study).close()
    with ServerProcess(path) as server, proxied(server.url) as proxy:
        invitations = Researcher(server.url, server.key).invite(len(statuses))
        for token, status in zip(invitations, statuses, strict=True):
            go_in(driver, f"http://127.0.0.1:{proxy.server_address[1]}", token)
            proxy.status, proxy.answered = status, 0
            choose(driver, [("agree", "1")])
            press(driver)
            wait(lambda: proxy.answered > 1)
            assert "no connection" in driver.find_element("id", "connection").text, status
            assert sequence(driver) == "0"
            proxy.status = 0
            wait(lambda: sequence(driver) == "1")
