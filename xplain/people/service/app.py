"""The service's routes: explanation sessions and questionnaires.

Errors are problem+json (RFC 9457) with ``key``, ``value`` and ``allowed``. GET never writes. A
repeated request gets the same reply.
"""

import json
import secrets
import sqlite3
from collections.abc import Callable, Sequence
from http import HTTPStatus
from importlib.resources import files
from typing import Annotated, Any, Literal

import pandas as pd
from fastapi import Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.middleware.cors import CORSMiddleware
from fastapi.responses import HTMLResponse, JSONResponse, PlainTextResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException

from xplain import __version__
from xplain.errors import XplainError
from xplain.people.flow import Conflict
from xplain.people.log import Unknown
from xplain.people.service.talks import Talks

LARGEST = 1 << 20
"""Maximum bytes of a request."""
Person = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.:@-]{0,99}$")]
Column = float | Annotated[str, Field(max_length=200, pattern=r"^[^\\x00]*$")]
Number = Annotated[float, Field(allow_inf_nan=False)]
Transition = Annotated[int, Field(strict=True, ge=0)] | list[Number] | dict[str, Column]
Trace = Annotated[list[Transition], Field(max_length=1000)]
Bit = Annotated[int, Field(ge=0, le=1)]
Kind = Literal["session", "questionnaire"]


def problem(status: int, detail: str, **about: Any) -> JSONResponse:
    """Makes an error response as in RFC 9457."""
    body = {"title": HTTPStatus(status).phrase, "status": status, "detail": detail, **about}
    return JSONResponse(body, status, media_type="application/problem+json")


def _report_not_allowed(_: Request, error: Exception) -> JSONResponse:
    about = {key: str(getattr(error, key, ""))[:200] for key in ("key", "value", "allowed")}
    return problem(422, str(error)[:500], **about)


def _report_not_understood(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"][1:]) or "body"
    about = {"key": key, "value": repr(first.get("input"))[:200], "allowed": first["msg"]}
    return problem(422, f"{key}: {first['msg']}", **about)


PROBLEMS: dict[Any, Callable[[Request, Exception], JSONResponse]] = {
    XplainError: _report_not_allowed,
    RequestValidationError: _report_not_understood,
    Unknown: lambda _, error: problem(404, "there is no such session or questionnaire"),
    Conflict: lambda _, error: problem(409, str(error)),
    sqlite3.Error: lambda _, error: problem(503, f"nothing was stored: {error}"),
    HTTPException: lambda _, error: problem(error.status_code, str(error.detail)),  # type: ignore[attr-defined]
}


class OnlyJson:
    """ASGI middleware that reads every body as JSON, even if it is sent as text (as beacons do). It
    refuses bodies of more than LARGEST bytes."""

    def __init__(self, app: Any) -> None:
        self.app = app

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Handles one request, as the ASGI specification requires."""
        size, kind = 0, (b"content-type", b"application/json")
        others = [one for one in scope.get("headers", ()) if one[0] != kind[0]]

        async def counted() -> Any:
            nonlocal size
            message = await receive()
            size += len(message.get("body", b""))
            if size > LARGEST:
                raise HTTPException(413, f"at most {LARGEST} bytes")
            return message

        await self.app({**scope, "headers": [*others, kind]}, counted, send)


class Body(BaseModel):
    """The body of a request. Every body may contain ``key``, the service's access key, because
    frames and beacons cannot send it in a header."""

    model_config = ConfigDict(extra="forbid")
    key: str = Field("", max_length=200)


class NewSession(Body):
    """A trace to explain to a new person; it may be empty at first."""

    person: Person | None = None
    trace: Trace = []
    expected_steps: Annotated[int, Field(ge=0, le=1000)] = 0


class NewQuestionnaire(Body):
    """A questionnaire for a new person."""

    person: Person | None = None


class Labels(Body):
    """The person's answer to an action.

    Attributes:
        number: number of the action that is answered.
        labels: labels of all shown transitions (1: it makes sense), as the answer to ``explain``.
        answer: 1 or 0, as the answer to ``ask``.
    """

    number: Annotated[int, Field(ge=1)]
    labels: Annotated[list[Bit], Field(max_length=1000)] | None = None
    answer: Bit | None = None


class More(Body):
    """The next transitions of a trace; ``after`` is the number of transitions sent earlier."""

    after: Annotated[int, Field(ge=0)]
    transitions: Annotated[Trace, Field(min_length=1)]


class Next(BaseModel):
    """The next action. Its answer must have the same ``number``.

    There are four kinds of actions:

        explain: give the messages, show the first ``step`` transitions, send their labels
        ask: ask the question, send its answer
        wait: all transitions sent so far are explained; more may be sent
        end: the questionnaire is over
    """

    model_config = ConfigDict(extra="allow")
    number: int
    kind: Literal["explain", "ask", "wait", "end"]
    messages: list[str] | None = None
    sentences: list[str] | None = None
    step: int | None = None
    text: str | None = None


class Reply(BaseModel):
    """The id of the talk and the next action."""

    id: str
    next: Next


def bearer(request: Request) -> str:
    """Returns the key in the request's headers; "" for none."""
    return request.headers.get("Authorization", "").removeprefix("Bearer ")


Key = Annotated[str, Depends(bearer)]


def create_app(talks: Talks, origins: Sequence[str] = (), key: str = "") -> FastAPI:
    """Makes the service as an ASGI application.

    Args:
        talks: the talks of a task, in an open file.
        origins: origins of pages that may call the service.
        key: required to begin a talk, and to read or erase answers; "" requires no key.
    """
    app = FastAPI(
        title="xplain",
        version=__version__,
        summary="What to say and what to ask next.",
        generate_unique_id_function=lambda route: route.name,  # names in generated clients
    )
    app.add_middleware(
        CORSMiddleware,
        allow_origins=list(origins),
        allow_methods=["GET", "POST", "DELETE"],
        allow_headers=["Authorization", "Content-Type"],
    )
    app.add_middleware(OnlyJson)
    for error, told in PROBLEMS.items():
        app.add_exception_handler(error, told)

    replies: Any = {"response_model": Reply, "response_model_exclude_unset": True}

    def check(own: str) -> None:
        if key and not secrets.compare_digest(own.encode(), key.encode()):
            raise HTTPException(401, "the key of this service, as `Authorization: Bearer KEY`")

    def begin(kind: str, person: str | None, request: dict[str, Any]) -> Any:
        which, decided = talks.begin(kind, person, request)
        return {"id": which, "next": decided}

    @app.post("/sessions", status_code=201, tags=["explain"], **replies)
    def new_session(body: NewSession, given: Key) -> Any:
        check(given or body.key)
        return begin("session", body.person, body.model_dump(include={"trace", "expected_steps"}))

    @app.post("/questionnaires", status_code=201, tags=["ask"], **replies)
    def new_questionnaire(body: NewQuestionnaire, given: Key) -> Any:
        check(given or body.key)
        return begin("questionnaire", body.person, {})

    @app.post("/{kind}s/{which}/answers", tags=["explain", "ask"], **replies)
    def answer(kind: Kind, which: str, body: Labels) -> Any:
        came = body.model_dump(include={"labels", "answer"}, exclude_none=True)
        return {"id": which, "next": talks.receive(kind, which, f"answer {body.number}", came)}

    @app.post("/sessions/{which}/trace", tags=["explain"], **replies)
    def more(which: str, body: More) -> Any:
        came = body.model_dump(include={"transitions"})
        return {"id": which, "next": talks.receive("session", which, f"trace {body.after}", came)}

    @app.get("/{kind}s/{which}", tags=["explain", "ask"])
    def state(kind: Kind, which: str) -> dict[str, Any]:
        rows, found = talks.read(kind, which)
        decided = [json.loads(str(event.state)) for event in rows]
        history = [
            {"key": event.kind, "received": event.payload, "next": now}
            for event, now in zip(rows, decided, strict=True)
        ]
        return {"id": which, **found, "next": decided[-1], "history": history}

    @app.delete("/{kind}s/{which}", status_code=204, tags=["explain", "ask"])
    def erase(kind: Kind, which: str, given: Key) -> None:
        check(given)
        talks.forget(kind, which)

    @app.get("/labels.csv", response_class=PlainTextResponse, tags=["ask"])
    def all_labels(given: Key) -> Any:
        check(given)
        return csv_of(talks.labels())

    @app.get("/questionnaires/{which}/labels.csv", response_class=PlainTextResponse, tags=["ask"])
    def own_labels(which: str) -> Any:
        return csv_of(talks.labels(which))

    @app.get("/task", tags=["task"])
    def task() -> dict[str, Any]:
        return talks.task.description

    @app.get("/task/labels", tags=["task"])
    def labels_of(wrong: str = "", given: str = "") -> list[int]:
        sets = ([name for name in names.split(",") if name] for names in (wrong, given))
        return talks.task.labels(*sets)

    @app.get("/", response_class=HTMLResponse, include_in_schema=False)
    def playground() -> Any:
        return files("xplain.people.service").joinpath("playground.html").read_text("utf-8")

    return app


def csv_of(rows: Sequence[dict[str, Any]]) -> PlainTextResponse:
    """Formats rows of labels as a CSV table that ``xplain discover`` can read."""
    table = pd.DataFrame(rows, columns=None if rows else ["observer", "messages", "label"])
    return PlainTextResponse(table.to_csv(index=False), media_type="text/csv; charset=utf-8")
