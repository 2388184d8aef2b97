"""A playground in the browser: ``python -m xplain demo --serve``.

A person is the user of two policies at once: what they hold wrong answers for them, or they answer
by themselves, and what both policies say and believe stands side by side. One process, one person:
games are in memory, and nothing is kept.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib.resources import files
from typing import Any

from flask import Flask, Response, jsonify, request
from hydra.utils import instantiate

from xplain.demo.play import DemoSetup, stage
from xplain.domains.users.setting import Setting, UserType
from xplain.errors import InputError, XplainError, one_of
from xplain.experiment.config import composed
from xplain.explanation.asking import Question
from xplain.explanation.message_sets import mask_of
from xplain.interaction.explainees import SimulatedUser
from xplain.interaction.session import Session
from xplain.solvers.base import Solver
from xplain.storage import encode

SOLVERS = ("qmdp", "qhr", "pomcp", "conformant", "silent", "say_all")
"""Policies that need not know the user's type, and plan while somebody waits."""
HOST = "127.0.0.1"
MOST = 100
"""Games that are kept; the oldest go."""


class Game:
    """One trace, explained by two policies to the same person.

    Args:
        scene: the task, the types that were learned, and the trace.
        overrides: that the scene was made of.
        solvers: names of two policies.
        wrong: what the person holds wrong, by names of messages.

    Raises:
        InputError: a policy or a message that there is not.
    """

    def __init__(
        self,
        scene: DemoSetup,
        overrides: Sequence[str],
        solvers: Sequence[str],
        wrong: Sequence[str],
    ) -> None:
        if len(solvers) != 2 or any(name not in SOLVERS for name in solvers):
            raise InputError("solvers", list(solvers), f"two of {', '.join(SOLVERS)}")
        domain = instantiate(composed("config", overrides).domain)
        values = {fact.name: fact.inaccurate for fact in domain.parameters}
        held = {one_of("wrong", name, values, "fact"): values[name] for name in wrong}
        own = Setting.build(domain, (UserType("you", held),))
        self._scene, self._solvers = scene, tuple(solvers)
        self._user = SimulatedUser(own.true_labels(scene.case.transitions))
        self._own, self._held = own, mask_of(wrong, scene.prepared.messages)
        self._sessions = [
            self._session(instantiate(composed("config", [*overrides, f"solver={name}"]).solver))
            for name in solvers
        ]

    def _session(self, solver: Solver) -> Session:
        """Of a policy; one that cannot ask does not."""
        explainer = replace(self._scene.explainer, solver=solver)
        try:
            return self._scene.session(explainer)
        except InputError as error:
            if error.key != "solver":
                raise
            return self._scene.session(replace(explainer, ask=None))

    def answer(self, labels: Sequence[Sequence[int]], replies: Sequence[int | None] = ()) -> None:
        """The person's replies to what is asked, where a policy asks; else their labels of what
        each policy has shown.

        Raises:
            InputError: not as many as were shown or asked.
        """
        asked = [self._question(session) for session in self._sessions]
        if any(asked):
            if len(replies) != len(asked):
                raise InputError("replies", replies, "one a policy; null where none is asked")
            for session, question, reply in zip(self._sessions, asked, replies, strict=True):
                if question is not None:
                    session.answer(-1 if reply is None else reply)
            return
        if len(labels) != len(self._sessions):
            raise InputError("labels", labels, "a list a policy")
        for session, own in zip(self._sessions, labels, strict=True):
            session.messages()
            session.observe(own)

    def _question(self, session: Session) -> Question | None:
        """What it asks now."""
        move = None if session.finished else session.next()
        return move if isinstance(move, Question) else None

    def _suggested(self, question: Question, given: int) -> int:
        """What who holds the same wrong would reply."""
        asked = self._scene.case.questions
        assert asked is not None
        fact = int(asked.facts[question.number])
        if fact >= 0:
            return int(not (self._held & ~given) >> fact & 1)
        clip = asked.transitions[question.number : question.number + 1]
        return int(self._own.true_labels(clip).label_probabilities(1, given)[0, 0])

    def state(self) -> dict[str, Any]:
        """What the page shows, in plain JSON."""
        scene, case = self._scene, self._scene.case
        policies = [self._policy(*one) for one in zip(self._solvers, self._sessions, strict=True)]
        shown = self._sessions[0].shown
        return {
            "finished": self._sessions[0].finished,
            "asks": any(policy["question"] for policy in policies),
            "shown": shown,
            "steps": len(case.transitions),
            "phrases": case.phrases[:shown],
            "positions": case.positions[: shown + 1],
            "scene": encode(scene.prepared.scene),
            "policies": policies,
        }

    def _policy(self, name: str, session: Session) -> dict[str, Any]:
        prepared = self._scene.prepared
        question = self._question(session)
        said = () if session.finished or question else session.messages()
        given = mask_of(session.said, prepared.messages)
        sentences = dict(zip(prepared.messages, prepared.sentences, strict=True))
        return {
            "name": name,
            "question": question
            and {**encode(question), "suggested": self._suggested(question, given)},
            "said": [
                f"As said before: {sentences[name]}" if name in session.again else sentences[name]
                for name in said
            ],
            "suggested": self._user.labels(session.shown, given).tolist(),
            "belief": {self._scene.title(t): p for t, p in session.belief.items()},
            "cost": session.cost,
        }


def create_app(overrides: Sequence[str], host: str = HOST) -> Flask:
    """The playground as a web application; the types of a task are learned when it is chosen.

    Args:
        overrides: of the experiment's configuration, for every task; ``domain=`` is offered first.
        host: where it listens. On this machine's own address no other page may talk to it.
    """
    app, numbers = Flask(__name__, static_folder=None), itertools.count()
    games: dict[int, Game] = {}
    named = [word.partition("=")[2] for word in overrides if word.startswith("domain=")]
    tasks = list(dict.fromkeys([*named[-1:], "rescue", "four_rooms"]))
    rest = [word for word in overrides if not word.startswith("domain=")]

    def words(task: str) -> list[str]:
        return [f"domain={one_of('task', task, tasks)}", *rest]

    scene_of = cache(lambda task: stage(words(task)))

    @app.errorhandler(XplainError)
    def refused(error: XplainError) -> tuple[Response, int]:
        return jsonify(error=str(error)), 400

    @app.before_request
    def of_this_page() -> tuple[str, int] | None:
        """Pages from elsewhere send forms, or come under a name of their own."""
        name = request.host.partition(":")[0]
        foreign = host == HOST and name not in (HOST, "localhost")
        return ("", 403) if foreign or (request.method == "POST" and not request.is_json) else None

    @app.get("/")
    def page() -> str:
        return files("xplain.demo").joinpath("playground.html").read_text(encoding="utf-8")

    @app.get("/tasks")
    def offered() -> Response:
        return jsonify(tasks=tasks, solvers=SOLVERS)

    def given(name: str, kind: type, default: Any = None) -> Any:
        """What the request's JSON object has under this name."""
        body = request.get_json(silent=True)
        value = body.get(name, default) if isinstance(body, dict) else None
        if not isinstance(value, kind):
            raise InputError(name, value, f"{kind.__name__}, in a JSON object")
        return value

    @app.post("/facts")
    def facts() -> Response:
        task = given("task", str)
        domain = instantiate(composed("config", words(task)).domain)
        scene_of(task)
        return jsonify([{"name": p.name, "belief": p.belief or p.name} for p in domain.parameters])

    @app.post("/begin")
    def begin() -> Response:
        task, solvers, wrong = given("task", str), given("solvers", list), given("wrong", list)
        number = next(numbers)
        games[number] = Game(scene_of(task), words(task), solvers, wrong)
        games.pop(number - MOST, None)
        return jsonify(game=number, **games[number].state())

    @app.post("/answer")
    def answer() -> Response:
        number = given("game", int)
        if number not in games:
            raise InputError("game", number, "one that was begun; begin again")
        games[number].answer(given("labels", list), given("replies", list, []))
        return jsonify(game=number, **games[number].state())

    return app


def serve(overrides: Sequence[str] = (), host: str = HOST, port: int = 5050) -> None:
    """Serves the playground until it is stopped.

    Args:
        overrides, host: as of :func:`create_app`.
        port: of the address.

    Raises:
        OSError: the port is taken.
    """
    from werkzeug.serving import make_server

    server = make_server(host, port, create_app(overrides, host))  # one request after the other
    print(f"playground: http://{host}:{port}/  (Ctrl-C ends it)", file=sys.stderr)
    server.serve_forever()
