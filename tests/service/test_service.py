"""The service: each answer counts once, nothing acknowledged is lost, refusals give a reason."""

import csv
import json
import random
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

from tests.chromium import wait
from tests.conftest import ROOT
from tests.people.server_process import ServerProcess
from tests.service.conftest import Direct
from xplain import discover
from xplain.learning.data.label_file import read_table
from xplain.people.service.served import ServedTask
from xplain.people.service.talks import ExplanationTalk, QuestionnaireTalk, Talks

Json = dict[str, Any]
KINDS = ("session", "questionnaire")


def reaction(
    task: ServedTask, decided: Json, trace: list[int], said: set[str], wrong: set[str]
) -> Json:
    """Returns the reaction of a person who believes these facts incorrectly until their
    messages."""
    if decided["kind"] == "ask" and "question" in decided:
        texts = [row["text"] for row in task.description["transitions"]]
        return {"answer": task.labels(list(wrong), list(said))[texts.index(decided["about"])]}
    labels = task.labels(list(wrong), list(said | {*decided["messages"]}))
    if decided["kind"] == "ask":
        labels = task.labels(list(wrong), decided["messages"])
        return {"answer": labels[decided["transition"]]}
    return {"labels": [labels[t] for t in trace[: decided["step"]]]}


def go_through(
    talks: Talks, kind: str, person: str, wrong: set[str], anew: Any = None, steps: int = 99
) -> list[Json]:
    """Returns all decisions of a dialogue with a person; ``anew`` gives the talks for each step."""
    trace, said, decisions = list(talks.task.traces[0])[:steps], set[str](), []
    half = len(trace) // 2
    begun = {"trace": trace[:half], "expected_steps": 0} if kind == "session" else {}
    which, now = talks.begin(kind, person, begun)
    while now["kind"] != "end":
        decisions.append(now)
        talks = anew() if anew else talks
        if now["kind"] == "wait":
            if now["step"] == len(trace):
                break
            more = {"transitions": trace[half:]}
            now = talks.receive(kind, which, f"trace {half}", more)
        else:
            came = reaction(talks.task, now, trace, said, wrong)
            said |= {*now.get("messages", ())} if kind == "session" else set()
            now = talks.receive(kind, which, f"answer {now['number']}", came)
    return [json.loads(json.dumps(one)) for one in decisions]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("wrong", [set(), {"fire", "rubble"}])
def test_a_talk_restored_before_every_request_goes_on_as_one_that_never_stopped(
    task: ServedTask,
    talks: Talks,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    wrong: set[str],
) -> None:
    opened: list[Talks] = []

    def anew() -> Talks:
        for one in opened:
            one.close()
        opened.append(Talks(tmp_path / "restored.sqlite", task))
        return opened[-1]

    with monkeypatch.context() as patch:  # what is in memory is not restored
        for one in (ExplanationTalk, QuestionnaireTalk):
            patch.setattr(one, "repeat", None)
        whole = go_through(talks, kind, "anna", wrong, steps=10)
    assert go_through(anew(), kind, "anna", wrong, anew, 10) == whole
    assert len(whole) > 4
    sentences = [task.description[key] for key in ("messages", "beliefs")]
    assert all(text.endswith(".") for one in sentences for text in one.values())
    assert sentences[0].keys() == sentences[1].keys() == {*task.types.messages}
    opened[-1].close()


def test_what_is_sent_again_counts_once_whatever_replies_were_lost(
    service: Direct, task: ServedTask
) -> None:
    service.lose = 0.4
    trace, sent = list(range(5)), 0

    def surely(path: str, **content: Any) -> Json:
        while (got := service.post(path, **content)).status_code == 502:
            pass
        found: Json = got.json()
        assert got.status_code < 300, found
        return found

    for person in map(str, range(8)):
        talk = surely("questionnaires", person=person)
        while talk["next"]["kind"] == "ask":
            number = talk["next"]["number"]
            talk = surely(f"questionnaires/{talk['id']}/answers", number=number, answer=1)
            sent += 1
        session = surely("sessions", person=person, trace=trace)
        while (now := session["next"])["kind"] != "wait":
            came = {"answer": 1} if now["kind"] == "ask" else {"labels": [1] * now["step"]}
            path = f"sessions/{session['id']}/answers"
            session = surely(path, number=now["number"], **came)
    service.lose = 0
    assert len(service.get("labels.csv").text.splitlines()) - 1 == sent <= 8 * task.questions


def test_labels_are_what_discover_reads(service: Direct, tmp_path: Path, talks: Talks) -> None:
    for person in range(8):
        go_through(talks, "questionnaire", f"p{person}", {"fire"} if person % 2 else {"fence"})
    table = tmp_path / "labels.csv"
    table.write_text(service.get("labels.csv").text, encoding="utf-8")
    assert "" not in table.read_text(encoding="utf-8").split("\n")[0].split(",")  # of columns
    hypotheses = talks.task.questionnaire.hypotheses
    hypotheses.save(tmp_path / "hypotheses.npz")
    assert {*read_table(table).feature_names} <= {*hypotheses.feature_names}  # alone as well
    found = discover(
        table,
        labeler="hypotheses",
        hypotheses=str(tmp_path / "hypotheses.npz"),
        output=str(tmp_path / "types"),
    )
    assert found is not None
    with (tmp_path / "types" / "assignment.csv").open(encoding="utf-8") as file:
        types = {row["observer"]: row["type"] for row in csv.DictReader(file)}
    assert len({types[f"p{person}"] for person in range(0, 8, 2)}) == 1
    summary = json.loads((tmp_path / "types" / "summary.json").read_text(encoding="utf-8"))
    assert summary["evidence"]["verdict"] == str(found.types.evidence)
    assert types["p0"] != types["p1"]


def test_another_answer_number_or_trace_is_a_conflict(service: Direct) -> None:
    talk = service.post("questionnaires", person="p").json()
    path = f"questionnaires/{talk['id']}/answers"
    assert service.post(path, number=2, answer=1).status_code == 409
    first = service.post(path, number=1, answer=1).json()
    assert service.post(path, number=1, answer=0).status_code == 409
    assert service.post(path, number=1, answer=1).json() == first
    talk = service.post("sessions", person="p", trace=[0, 1]).json()
    assert service.post("sessions", person="p", trace=[2]).status_code == 409
    # More of a trace comes once, and leaves what is open.
    path = f"sessions/{talk['id']}/trace"
    longer = service.post(path, after=2, transitions=[2, 3]).json()
    assert longer["next"] == talk["next"]
    assert service.post(path, after=2, transitions=[2, 3]).json() == longer
    assert service.post(path, after=2, transitions=[4]).status_code == 409
    assert service.post(path, after=7, transitions=[4]).status_code == 409
    state = service.get(f"sessions/{talk['id']}").json()
    assert (state["known"], state["next"]) == (4, talk["next"])


def test_a_person_like_no_observer_is_noticed(task: ServedTask, talks: Talks) -> None:
    """A person of a found type fits; a person who believes all facts incorrectly does not."""
    trace, names, fits = list(task.traces[0]), task.types.messages, []
    found = {name for j, name in enumerate(names) if task.types.labelers[0].wrong[j] > 0.5}
    for person, wrong in (("known", found), ("unknown", {*names})):
        go_through(talks, "session", person, wrong)
        begun = {"trace": trace[: len(trace) // 2], "expected_steps": 0}
        which, _ = talks.begin("session", person, begun)
        fits.append(talks.read("session", which)[1]["fit"])
    assert fits[0] > 0.5 > fits[1]


def test_reading_writes_nothing(service: Direct, tmp_path: Path) -> None:
    which = {kind: service.post(f"{kind}s", person="p").json()["id"] for kind in KINDS}
    with closing(sqlite3.connect(tmp_path / "service.sqlite")) as other:
        (before,) = other.execute("PRAGMA data_version").fetchone()
        paths = [f"{kind}s/{one}" for kind, one in which.items()]
        paths += ["task", "labels.csv", f"{paths[1]}/labels.csv", "openapi.json", "", "docs"]
        for path in [*paths, "task/labels?wrong=fire"]:
            assert service.get(path).status_code == 200, path
        assert other.execute("PRAGMA data_version").fetchone() == (before,)
    assert service.get(f"sessions/{which['questionnaire']}").status_code == 404
    told = service.get("task").json()
    for way in ([told["transitions"][t] for t in trace] for trace in told["traces"]):
        # The robot goes on where it is, on the map.
        assert [one["to"] for one in way[:-1]] == [one["from"] for one in way[1:]]
        assert all(0 <= one["to"][0] < told["scene"]["rows"] for one in way)


@pytest.mark.parametrize(
    ("origin", "allowed"),
    [("https://lab.example.org", True), ("null", True), ("https://elsewhere.org", False)],
)
def test_pages_of_the_list_alone_may_call_it(service: Direct, origin: str, allowed: bool) -> None:
    asks = {
        "Access-Control-Request-Method": "POST",
        "Access-Control-Request-Headers": "content-type",
    }
    got = service.send("OPTIONS", "sessions", Origin=origin, **asks)
    assert (got.headers.get("Access-Control-Allow-Origin") == origin) == allowed
    assert (got.status_code < 400) == allowed


def test_the_key_is_taken_from_headers_and_from_the_body(talks: Talks) -> None:
    service, own = Direct(talks, key="secret key"), {"Authorization": "Bearer secret key"}
    assert service.post("sessions").status_code == 401
    assert service.post("sessions", key="wrong").status_code == 401
    # As a beacon sends it: as text.
    text = json.dumps({"key": "secret key", "trace": [1]})
    begun = service.send("POST", "sessions", text, **{"Content-Type": "text/plain"})
    assert begun.status_code == 201
    path = f"sessions/{begun.json()['id']}"
    for method, asked, allowed in (("GET", "labels.csv", 200), ("DELETE", path, 204)):
        assert service.send(method, asked).status_code == 401
        assert service.send(method, asked, **own).status_code == allowed
    assert service.get(path).status_code == 404


DEEP = "[" * 100_000 + "]" * 100_000
HOSTILE: list[tuple[str, str, Any]] = [
    ("POST", "sessions", body)
    for body in (
        *("", "null", "[]", "3", '"x"', "{", "\x00", DEEP, '{"trace": ' + DEEP + "}"),
        *('{"trace": null}', '{"trace": [null]}', '{"trace": [NaN]}', '{"trace": [[Infinity]]}'),
        *('{"trace": [[1, 2]]}', '{"trace": [-1]}', '{"trace": [1e99]}', '{"trace": [99999]}'),
        *('{"trace": [true]}', '{"trace": [1.5]}', '{"trace": ["0"]}', '{"trace": [{"a": 1}]}'),
        *('{"trace": [{"row": "\\ud800"}]}', '{"trace": [' + "0," * 2000 + "0]}"),
        *('{"expected_steps": -1}', '{"expected_steps": 1e9}', '{"unknown": 1}'),
        *(
            '{"person": ""}',
            '{"person": "=1+1"}',
            '{"person": "a\\u0000b"}',
            '{"person": "\\ud800"}',
        ),
        *('{"person": "a/../b"}', '{"person": 7}', json.dumps({"person": "x" * 101})),
        '{"key": "\\ud800"}',
        " " * (2 << 20),
    )
]
HOSTILE += [
    ("POST", f"sessions/{path}", body)
    for path in ("nobody/answers", "../sessions/x/answers", "%00/answers", "' OR 1=1 --/answers")
    for body in ('{"number": 1, "labels": [1]}', '{"number": 0}')
]
HOSTILE += [("GET", path, "") for path in (
    "sessions/nobody", "sessions/%ff", "sessions/' OR '1'='1", "questionnaires/nobody/labels.csv",
    "task/labels?wrong=nobody", "task/labels?wrong=%00", "../../etc/passwd", "%2e%2e/etc/passwd",
    "labels.csv/../task", "static/x",
)]  # fmt: skip
HOSTILE += [("DELETE", "sessions/nobody", ""), ("PUT", "sessions", "{}"), ("TRACE", "sessions", "")]
HOSTILE += [
    ("POST", "{session}/answers", body)
    for body in (
        *('{"number": 1}', '{"number": 1, "labels": []}', '{"number": 1, "answer": 2}'),
        *('{"number": 1, "labels": [1, 1]}', '{"number": 1, "answer": "x"}'),
        *('{"number": 1, "labels": [2]}', '{"number": 99999999999999999999, "answer": 1}'),
        *('{"number": 1, "answer": [1]}', '{"answer": 1}', '{"number": -1, "answer": 1}'),
    )
]


@pytest.fixture(scope="module")
def attacked(
    task: ServedTask, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Direct, str]]:
    opened = Talks(tmp_path_factory.mktemp("attacked") / "service.sqlite", task)
    service = Direct(opened)
    yield service, service.post("sessions", trace=[0, 1]).json()["id"]
    opened.close()


@pytest.mark.parametrize(("method", "path", "body"), HOSTILE)
def test_hostile_requests_change_nothing_and_are_refused_with_a_reason(
    attacked: tuple[Direct, str], method: str, path: str, body: str
) -> None:
    service, session = attacked
    own = f"sessions/{session}"
    before = service.get(own).json()
    got = service.send(method, path.format(session=own), body.encode("utf-8", "surrogatepass"))
    assert 400 <= got.status_code < 500
    assert got.headers["Content-Type"] == "application/problem+json"
    assert got.json()["detail"]
    assert service.get(own).json() == before


@pytest.mark.parametrize("kills", [1, pytest.param(20, marks=pytest.mark.slow)])
def test_what_was_acknowledged_survives_kill_9(
    task: ServedTask, tmp_path: Path, kills: int
) -> None:
    """Eight clients answer while the process is killed again and again."""
    known, stop = task.questionnaire.hypotheses, threading.Event()
    known.save(tmp_path / "hypotheses.npz")
    task.types.save(tmp_path / "types.npz")
    files = ("types=types.npz", "hypotheses=hypotheses.npz")  # so that nothing is learned again
    server = ServerProcess(tmp_path / "s.sqlite", *files, command="serve")
    acknowledged: dict[str, list[tuple[Json, Json]]] = {str(n): [] for n in range(8)}

    def surely(path: str, content: Json) -> Json:
        """Sends a request until it is acknowledged. Returns the reply, or {} after the end."""
        while not stop.is_set():
            try:
                sent = json.dumps(content).encode()
                with urlopen(f"{server.url}/{path}", sent, timeout=5) as got:
                    found: Json = json.load(got)
                    return found
            except HTTPError:
                raise
            except (OSError, HTTPException):
                time.sleep(0.25)
        return {}

    def client(person: str) -> None:
        draw, own = random.Random(person), acknowledged[person]
        while not stop.is_set():
            sent: Json = {"person": f"{person}-{len(own)}"}
            talk = surely("questionnaires", sent)
            while talk:
                own.append((sent, talk))
                if talk["next"]["kind"] == "end":
                    break
                sent = {"number": talk["next"]["number"], "answer": draw.randrange(2)}
                talk = surely(f"questionnaires/{talk['id']}/answers", sent)

    with server, ThreadPoolExecutor(8) as clients:
        running = [clients.submit(client, person) for person in acknowledged]
        try:
            for _ in range(kills):
                served = sum(map(len, acknowledged.values())) + 40
                wait(lambda n=served: sum(map(len, acknowledged.values())) >= n)  # type: ignore[misc]
                server.kill()
                server.start()
        finally:
            stop.set()
        for one in running:
            one.result()
    with closing(sqlite3.connect(server.database)) as stored:
        sql = "SELECT participant, kind, payload, state FROM event WHERE source = 'protocol'"
        rows = stored.execute(sql).fetchall()
    found = {row[:2]: (json.loads(row[2]), json.loads(row[3])) for row in rows}
    assert len(found) == len(rows)
    for sent, talk in (one for own in acknowledged.values() for one in own):
        came, decided = found[
            talk["id"], f"answer {sent['number']}" if "number" in sent else "begin"
        ]
        assert came.get("answer") == sent.get("answer")
        assert decided["number"] == talk["next"]["number"]


def test_the_examples_run_as_they_stand(url: str) -> None:
    def ran(*command: str) -> str:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    told = ran(sys.executable, str(ROOT / "examples/service/robot.py"), url)
    assert "belief:" in told
    lines = ran("bash", str(ROOT / "examples/service/curl.sh"), url).splitlines()
    assert lines == urlopen(f"{url}/labels.csv", timeout=9).read().decode().splitlines()
    assert len(lines) > 4
