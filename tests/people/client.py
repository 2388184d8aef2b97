"""A browser without a network: requests go directly to an application."""

import asyncio
import threading
from http.cookies import SimpleCookie
from json import dumps, loads
from typing import Any
from urllib.parse import unquote, urlencode, urlsplit

import anyio.to_thread
from starlette.datastructures import Headers

LOCAL = threading.local()
"""An event loop for each thread."""
_in_a_thread = anyio.to_thread.run_sync


async def _at_once(function: Any, *args: Any, **more: Any) -> Any:
    """Calls a handler in the client's thread, because new threads would take half of the time."""
    if hasattr(LOCAL, "runner"):
        return function(*args)
    return await _in_a_thread(function, *args, **more)


anyio.to_thread.run_sync = _at_once


class Reply:
    """The response to a request."""

    def __init__(self, status: int, headers: list[tuple[bytes, bytes]], data: bytes) -> None:
        self.status_code, self.headers, self.data = status, Headers(raw=headers), data

    @property
    def text(self) -> str:
        return self.data.decode()

    def json(self) -> Any:
        return loads(self.data)


class Client:
    """A client that keeps cookies, unless it is created without."""

    def __init__(self, app: Any, cookies: bool = True) -> None:
        self.app, self.keeps, self.cookies = app, cookies, dict[str, tuple[str, str]]()

    def set_cookie(self, name: str, value: str) -> None:
        self.cookies[name] = value, "/"

    def get(self, path: str, **more: Any) -> Reply:
        return self.open(path, **more)

    def post(self, path: str, **more: Any) -> Reply:
        return self.open(path, method="POST", **more)

    def open(
        self,
        path: str,
        method: str = "GET",
        data: Any = None,
        json: Any = None,
        headers: dict[str, str] | None = None,
        base_url: str = "http://localhost",
        follow_redirects: bool = False,
    ) -> Reply:
        body = data if isinstance(data, bytes) else (data or "") if isinstance(data, str) else b""
        if json is not None:
            body = dumps(json)
        elif not isinstance(data, bytes | str):
            body = urlencode(data or (), doseq=True, errors="surrogatepass")
        content = body.encode() if isinstance(body, str) else body
        url, outside = urlsplit(path), urlsplit(base_url)
        sent = {"host": outside.netloc, **{k.lower(): v for k, v in (headers or {}).items()}}
        kept = [f"{n}={v}" for n, (v, below) in self.cookies.items() if url.path.startswith(below)]
        if kept and "cookie" not in sent:
            sent["cookie"] = "; ".join(kept)
        scope = {
            "type": "http",
            "http_version": "1.1",
            "method": method,
            "scheme": outside.scheme,
            "path": unquote(url.path),
            "raw_path": url.path.encode(),
            "query_string": url.query.encode(),
            "root_path": "",
            "headers": [(k.encode("latin-1"), v.encode("latin-1")) for k, v in sent.items()],
            "client": ("127.0.0.1", 1),
            "server": ("localhost", 80),
        }
        reply = self._run(scope, content)
        for cookie in SimpleCookie("\r\n".join(reply.headers.getlist("set-cookie"))).values():
            self.cookies[cookie.key] = cookie.value, cookie["path"]
            if not self.keeps or cookie["max-age"] == "0":
                del self.cookies[cookie.key]
        if follow_redirects and reply.status_code == 303:
            return self.get(reply.headers["location"], base_url=base_url, follow_redirects=True)
        return reply

    def _run(self, scope: dict[str, Any], content: bytes) -> Reply:
        came: list[dict[str, Any]] = [{"type": "http.request", "body": content}]
        parts: list[dict[str, Any]] = []

        async def receive() -> dict[str, Any]:
            return came.pop() if came else await asyncio.Event().wait()  # type: ignore[return-value]

        async def send(message: dict[str, Any]) -> None:
            parts.append(message)

        if not hasattr(LOCAL, "runner"):
            LOCAL.runner = asyncio.Runner()
        LOCAL.runner.run(self.app(scope, receive, send))
        data = b"".join(part.get("body", b"") for part in parts)
        return Reply(parts[0]["status"], parts[0]["headers"], data)
