"""Serves the user study: ``xplain study port=8080 rules.per_cell=10``.

The first start fixes the study in its database; later starts go on with it. One worker process
with threads: it alone has the database open. How a lab runs a study: docs/study.md.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf

from xplain.config import composed
from xplain.errors import InputError
from xplain.participants.settings import fixed

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from xplain.participants.server.http import Server
    from xplain.participants.server.protocol import Protocol
    from xplain.participants.stored import Plan


def main(arguments: list[str]) -> None:
    """Serves the study that overrides of conf/study.yaml describe."""
    serve(composed("study", arguments))


def serve(cfg: DictConfig) -> None:
    """Blocks until the server is stopped.

    Raises:
        XplainError: the configuration or the database cannot be used.
    """
    # Imported late: a key that cannot be is refused at once.
    path, server = checked(cfg)
    from xplain.study.policies import study_of
    from xplain.study.prepare import study_plan
    from xplain.study.protocol.plan import StudyPlan
    from xplain.study.server.protocol import StudyProtocol

    plan = running(cfg, path, StudyPlan, study_plan)
    run_server(StudyProtocol(study_of(plan)), server, path, cfg)


def checked(cfg: DictConfig) -> tuple[Path, Server]:
    """The database and how the pages are served, before the work of a plan.

    Raises:
        InputError: a key that cannot be.
    """
    check_address(cfg)
    return database_of(cfg), server_of(cfg)


def database_of(cfg: DictConfig) -> Path:
    """The database's path, in a folder that is there.

    Raises:
        InputError: it cannot be written to.
    """
    path = Path(cfg.database).absolute()
    path.parent.mkdir(parents=True, exist_ok=True)
    if not os.access(path.parent, os.W_OK):
        raise InputError("database", str(path), "a file in a folder that can be written to")
    return path


def server_of(cfg: DictConfig) -> Server:
    """How the pages are served; links lead to host and port where no other address is given."""
    from xplain.participants.server.http import Server

    given: Any = OmegaConf.to_container(cfg.server, resolve=True)
    address = given.get("address") or f"http://{cfg.host}:{cfg.port}"
    return Server(**{k: v for k, v in given.items() if k != "_target_"} | {"address": address})


def check_address(cfg: DictConfig) -> None:
    """Raises InputError: a port or a number of threads that cannot be."""
    if not isinstance(cfg.port, int) or not 0 < cfg.port < 65536:
        raise InputError("port", cfg.port, "a whole number from 1 to 65535")
    if not isinstance(cfg.threads, int) or not 1 <= cfg.threads <= 256:
        raise InputError("threads", cfg.threads, "a whole number from 1 to 256")


def running(
    cfg: DictConfig,
    path: Path,
    kind: type[Plan],
    new: Callable[[DictConfig], Plan],
) -> Plan:
    """The plan in the database, or a new one. Names the keys of ``cfg`` that it does not follow."""
    from xplain.participants.stored import read_plan, renamed

    plan = read_plan(path, kind)
    if plan is None:
        print(f"{kind.COMMAND}: preparing {kind.OF} …", file=sys.stderr)
        return new(cfg)
    now = fixed(cfg)
    if now["seed"] is None:
        del now["seed"]  # drawn once, at the first start
    ignored = [key for key in now if now[key] != renamed(plan.config.get(key))]
    if ignored:
        print(
            f"{kind.COMMAND}: goes on as it was started; these keys differ now and are ignored: "
            f"{', '.join(ignored)}",
            file=sys.stderr,
        )
    return plan


def run_server(protocol: Protocol, server: Server, path: Path, cfg: DictConfig) -> None:
    """Serves until it is stopped."""
    from gunicorn.app.base import BaseApplication  # type: ignore[import-untyped]

    from xplain.participants.server.app import create_app
    from xplain.participants.server.store import Store

    name = protocol.plan.COMMAND

    class Application(BaseApplication):  # type: ignore[misc]
        def load_config(self) -> None:
            for key, value in {
                "bind": f"{cfg.host}:{cfg.port}",
                "workers": 1,
                "worker_class": "gthread",
                "threads": cfg.threads,
                "worker_connections": 2000,
                "backlog": 512,
                "keepalive": 30,
                "timeout": 60,
                "graceful_timeout": 10,
                "limit_request_line": 4094,
                "limit_request_fields": 60,
                "max_requests": 0,
                "accesslog": None,
                "loglevel": "warning",
                "proc_name": f"xplain-{name}",
                "control_socket_disable": True,
            }.items():
                if key in self.cfg.settings:
                    self.cfg.set(key, value)

        def load(self) -> Any:
            # In the worker: a connection to SQLite must not be carried over a fork.
            return create_app(Store(path, protocol), server)

    # Opened once before the server starts, so that what is wrong with it is one clear line.
    store = Store(path, protocol)
    key = _researcher_key(store)
    store.close()
    print(
        f"{name}: http://{cfg.host}:{cfg.port}/  ·  researcher's page: /researcher, key {key}\n"
        f"{name}: database {path}, plan {protocol.plan.hash[:16]}",
        file=sys.stderr,
        flush=True,
    )
    Application().run()


def _researcher_key(store: Any) -> str:
    from xplain.participants.server.security import Keys

    return Keys(store.secret).researcher
