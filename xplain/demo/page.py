"""Writes a session as one HTML page, which shows each step and loads no other file."""

import json
from collections.abc import Sequence
from importlib.resources import files
from itertools import islice
from pathlib import Path
from typing import Any

from xplain.demo.play import DemoSetup, PlayedSession, play, set_up
from xplain.experiment.results import encode_question
from xplain.explanation.asking import Question
from xplain.interaction.session import Why
from xplain.storage import encode, write_text

SHOWN = 6
"""Number of values shown for a decision, best first."""


def write_page(overrides: Sequence[str], trace: int | None, user: str | None, path: Path) -> None:
    """Plays one session with a simulated user and writes its page.

    Args:
        overrides: overrides of the experiment's configuration.
        trace: number of the trace; None chooses an instructive one.
        user: true type of the simulated user; None chooses the most instructive one.
        path: path of the page.

    Raises:
        XplainError, HydraException: a value is not allowed.
    """
    scene = set_up(overrides, trace, user)
    write_text(path, page(scene, play(scene, scene.user_type(user))))


def page(stage: DemoSetup, played: PlayedSession) -> str:
    """Makes the HTML of the page, with the session's data in it."""
    template = files("xplain.demo").joinpath("player.html").read_text(encoding="utf-8")
    # Inside a script element only "</" and "<!--" have a special meaning.
    data = json.dumps(content(stage, played)).replace("<", "\\u003c")
    return template.replace("/*DATA*/null", data)


def content(stage: DemoSetup, played: PlayedSession) -> dict[str, Any]:
    """Makes the page's data, in plain JSON."""
    prepared, case = stage.prepared, stage.case
    return {
        "domain": stage.domain,
        "solver": stage.solver,
        "tradeOff": stage.trade_off,
        "chosen": stage.chosen,
        "user": played.user,
        "right": stage.right(played.user),
        "titles": {name: stage.title(name) for name in played.prior},
        "believes": list(stage.beliefs[played.user]),
        "sentences": dict(zip(prepared.messages, prepared.sentences, strict=True)),
        "scene": encode(prepared.scene),
        "positions": case.positions if len(case.positions) == len(case.transitions) + 1 else [],
        "phrases": case.phrases,
        "changes": case.changes,
        "prior": played.prior,
        "steps": [
            {
                "said": step.said,
                "asked": [encode_question(question, answer) for question, answer in step.asked],
                "values": _list_values(step.why),
                "labels": step.labels,
                "belief": step.belief,
                "cost": step.cost,
            }
            for step in played.steps
        ],
    }


def _list_values(why: Why) -> list[dict[str, Any]]:
    """Lists the best messages and questions with their values; the highest value comes first."""
    best = islice(why.values.items(), SHOWN)
    return [
        {"question": str(action), "messages": (), "value": value}
        if isinstance(action, Question)
        else {"messages": action, "value": value}
        for action, value in best
    ]
