"""Measures `python -m xplain serve` under load: many open sessions, answers at a steady rate, and
kill -9.

    python benchmarks/service_load.py            1,000 open sessions, 60 s; 10,000 sessions
    python benchmarks/service_load.py --quick    a smoke run

For each task the script prints percentiles of the time from an answer's due time to the last byte
of its reply. Answers come at random times (a Poisson process), also before earlier answers have a
reply. A new session replaces a finished session; its start is timed separately. Then the script
creates sessions, kills the service meanwhile, and starts it again. Every acknowledged session must
still exist, with the same reply. The exit code is 1 after any error. The clients run on
the same machine.
"""

import argparse
import http.client
import json
import random
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from study_load import percentiles

Json = dict[str, Any]
CLIENTS = 16
"""Number of connections that are used at the same time."""
SMALL = ("points=5", "queries=independent", "labeler=tree", "clusterer=perfect")
"""Changes for a smoke run: types are learned quickly."""
LABEL_1 = 0.85
"""Probability that a label is 1. No type answers like this, so the belief keeps changing."""


class Service:
    """The service in a separate process, which can be killed and started again."""

    def __init__(self, domain: str, folder: Path, *small: str) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = int(free.getsockname()[1])
        self.database = folder / f"{domain}.sqlite"
        self.command = [sys.executable, "-m", "xplain", "serve", f"domain={domain}"]
        self.command += [f"port={self.port}", f"database={self.database}", *small]
        self.local = threading.local()
        self.start()

    def start(self) -> None:
        """Starts the service, and waits until it replies."""
        self.process = subprocess.Popen(self.command, stderr=subprocess.DEVNULL)
        while self.process.poll() is None:
            try:
                self.call("GET", "/task")
                return
            except OSError:
                time.sleep(0.2)
        sys.exit(f"{' '.join(self.command)} ended with {self.process.returncode}")

    def kill(self) -> None:
        """Kills the service as a power cut would."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def connect(self) -> http.client.HTTPConnection:
        """Opens a new connection."""
        return http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)

    def call(self, method: str, path: str, content: Json | None = None) -> Json:
        """Sends one request on this thread's connection, and returns the reply.

        Raises:
            OSError: there was no reply.
            RuntimeError: the service refused the request.
        """
        body = None if content is None else json.dumps(content)
        kept: list[http.client.HTTPConnection] = self.local.__dict__.pop("kept", [])
        for connection in [*kept, self.connect()]:
            try:
                connection.request(method, path, body)
                reply = connection.getresponse()
                text = reply.read()
                break
            except (http.client.HTTPException, OSError) as error:
                lost = error  # the kept connection was idle for too long, or the service is gone
        else:
            raise OSError(str(lost)) from lost
        self.local.kept = [connection]
        if reply.status >= 400:
            raise RuntimeError(f"{reply.status} {text[:200]!r}")
        found: Json = json.loads(text)
        return found


class Crowd:
    """People whose sessions are open, one session each."""

    def __init__(self, service: Service, seed: int) -> None:
        self.service, self.rng, self.lock = service, random.Random(seed), threading.Lock()
        self.traces: list[list[int]] = service.call("GET", "/task")["traces"]
        self.free: list[Json] = []
        self.begun: list[float] = []
        self.answered: list[float] = []
        self.number = 0

    def begin(self) -> None:
        """Opens a session with somebody new."""
        with self.lock:
            self.number += 1
            content = {"person": f"p{self.number}", "trace": self.rng.choice(self.traces)}
        start = time.perf_counter()
        talk = self.service.call("POST", "/sessions", content)
        with self.lock:
            self.begun.append(time.perf_counter() - start)
            self.free.append(talk)

    def answer(self, due: float) -> None:
        """Answers the open action of a person; after the end of the trace, a new person begins."""
        with self.lock:
            talk = self.free.pop(self.rng.randrange(len(self.free)))
            now = talk["next"]
            labels = [int(self.rng.random() < LABEL_1) for _ in range(now.get("step") or 0)]
        content = {"number": now["number"], "labels": labels}
        talk = self.service.call("POST", f"/sessions/{talk['id']}/answers", content)
        with self.lock:
            self.answered.append(time.perf_counter() - due)
        if talk["next"]["kind"] == "wait":
            self.begin()
        else:
            with self.lock:
                self.free.append(talk)


def load(service: Service, people: int, rate: float, seconds: float) -> int:
    """Sends answers at a steady rate. Returns the number of errors."""
    crowd = Crowd(service, seed=0)
    with ThreadPoolExecutor(CLIENTS) as pool:
        list(pool.map(lambda _: crowd.begin(), range(people)))
        print(f"  {people} sessions opened:  {percentiles(crowd.begun)}")
        crowd.begun.clear()
        sent, due, end = [], time.perf_counter(), time.perf_counter() + seconds
        while (due := due + crowd.rng.expovariate(rate)) < end:
            time.sleep(max(0.0, due - time.perf_counter()))
            sent.append(pool.submit(crowd.answer, due))
    errors = [str(one.exception()) for one in sent if one.exception()]
    print(f"  {len(crowd.answered)} answers:  {percentiles(crowd.answered)}")
    if crowd.begun:
        print(f"  {len(crowd.begun)} opened meanwhile:  {percentiles(crowd.begun)}")
    print(f"  {len(errors)} errors  {'; '.join(sorted(set(errors))[:5])}")
    return len(errors)


def killed(service: Service, sessions: int, kills: int) -> int:
    """Creates sessions under kill -9. Returns the number of acknowledged sessions that changed or
    are lost."""
    traces = service.call("GET", "/task")["traces"]
    acknowledged: dict[str, Json] = {}
    back = threading.Event()
    back.set()

    def create(number: int) -> None:
        content = {"person": f"k{number}", "trace": traces[number % len(traces)]}
        while True:
            try:
                talk = service.call("POST", "/sessions", content)
                acknowledged[talk["id"]] = talk["next"]
                return
            except OSError:
                time.sleep(0.1)
                back.wait()

    start = time.perf_counter()
    with ThreadPoolExecutor(CLIENTS) as pool:
        pending = [pool.submit(create, number) for number in range(sessions)]
        for part in range(1, kills + 1):
            while len(acknowledged) < sessions * part // (kills + 1):
                time.sleep(0.05)
            back.clear()
            service.kill()
            service.start()
            back.set()
        for one in pending:
            one.result()
    took = time.perf_counter() - start
    service.kill()
    with closing(sqlite3.connect(service.database)) as stored:
        sql = "SELECT participant, state, payload ->> 'person' FROM event WHERE kind = 'begin'"
        rows = stored.execute(sql).fetchall()
    kept = {which: json.loads(decided) for which, decided, _ in rows}
    wrong = sum(kept.get(which) != decided for which, decided in acknowledged.items())
    wrong += len(rows) - len({person for _, _, person in rows})
    service.start()
    again = random.Random(0).sample(sorted(acknowledged), min(200, len(acknowledged)))
    for which in again:  # the service decides the same from the events
        wrong += service.call("GET", f"/sessions/{which}")["next"] != acknowledged[which]
    print(f"  {len(acknowledged)} sessions, {kills} kill -9, {took:.0f} s: {wrong} wrong")
    return wrong + sessions - len(acknowledged)


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--domain", choices=["rescue", "four_rooms"])
    given = parser.parse_args()
    people, seconds, sessions, kills = (4, 1.0, 20, 1) if given.quick else (1000, 60.0, 10_000, 3)
    domains = ["rescue"] if given.quick else ["rescue", "four_rooms"]
    small = SMALL if given.quick else ()
    errors = 0
    for domain in [given.domain] if given.domain else domains:
        print(f"{domain}: 20 answers a second")
        with tempfile.TemporaryDirectory() as folder:
            service = Service(domain, Path(folder), *small)
            try:
                errors += load(service, people, 20.0, seconds)
                errors += killed(service, sessions, kills)
            finally:
                service.kill()
    sys.exit(errors > 0)


if __name__ == "__main__":
    main()
