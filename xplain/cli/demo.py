"""Plays one explanation session: the robot shows its trace step by step and says what this user
needs to know; the user says which transitions make no sense.

    xplain demo                              a simulated user and a trace that tell much
    xplain demo --user B lambda=2            a simulated user of type B
    xplain demo --me                         you are the user
    xplain demo --trace 3                    another trace, from 0
    xplain demo --html demo.html             the same as one page, to step through, on phones too
    xplain demo domain=four_rooms solver=qhr seed=3
    xplain demo --serve [--port 5050]        a playground in the browser, with two policies

The playground listens on this machine's own address alone; --host names another.

Without --trace it is the one of the first five in which the user's type is found with fewest
messages. On a terminal it waits for Enter after each step. Keys are those of the experiment
(domain, users, solver, lambda, seed, ...).
"""

from __future__ import annotations

import sys
from pathlib import Path

from xplain.cli.parser import parsed
from xplain.errors import InputError, whole_number


def main(arguments: list[str]) -> None:
    """Plays one session on the terminal, writes it as a page, or serves the playground."""
    flags = {"user": str, "me": False, "trace": int, "html": Path, "serve": False}
    address = {"host": "127.0.0.1", "port": 5050}
    given = parsed("xplain demo", arguments, "overrides", **flags, **address)
    if given.me and given.user is not None:
        raise InputError("--user", given.user, "the type of a simulated user; not with --me")
    if given.serve:
        from xplain.demo.serve import serve

        serve(given.overrides, given.host, given.port)
        return
    if given.trace is not None:
        whole_number("--trace", given.trace, 0)
    if given.html is not None and not given.html.absolute().parent.is_dir():
        raise InputError("--html", str(given.html), "a file in a folder that exists")
    # What follows brings the heavy packages; --help is over by now.
    from xplain.demo.page import page
    from xplain.demo.play import SimulatedListener, play, stage
    from xplain.demo.terminal import Terminal

    scene = stage(given.overrides, given.trace, given.user)
    simulated = None if given.me else SimulatedListener(scene, scene.user_type(given.user))
    user = simulated if simulated and given.html else Terminal(scene, simulated)
    played = play(scene, user)
    if given.html is not None:
        given.html.write_text(page(scene, played), encoding="utf-8")
        print(given.html, file=sys.stderr)
