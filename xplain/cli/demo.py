"""Plays one explanation, and writes it as a page to step through, on phones too: at each step the
robot says what this user needs to know, and the user says which transitions make no sense.

    xplain demo                              writes demo.html: a user and a trace that show much
    xplain demo --user B lambda=2            a simulated user of type B
    xplain demo --trace 3                    another trace, from 0
    xplain demo --html mine.html             another file
    xplain demo domain=four_rooms solver=qhr seed=3
    xplain demo --serve [--port 5050]        a playground in the browser: you are the user of two
                                             policies

The playground listens on this machine's own address alone; --host names another.

Without --trace it is the one of the first five in which the user's type is found with fewest
messages. Keys are those of the experiment (domain, users, solver, lambda, seed, ...).
"""

from __future__ import annotations

from pathlib import Path

from xplain.cli.parser import parsed
from xplain.errors import InputError, whole_number
from xplain.storage import write_text


def main(arguments: list[str]) -> None:
    """Writes one session as a page, or serves the playground."""
    flags = {"user": str, "trace": int, "html": Path("demo.html"), "serve": False}
    address = {"host": "127.0.0.1", "port": 5050}
    given = parsed("xplain demo", arguments, "overrides", **flags, **address)
    if given.serve:
        from xplain.demo.serve import serve

        serve(given.overrides, given.host, given.port)
        return
    if given.trace is not None:
        whole_number("--trace", given.trace, 0)
    if not given.html.absolute().parent.is_dir():
        raise InputError("--html", str(given.html), "a file in a folder that exists")
    # What follows brings the heavy packages; --help is over by now.
    from xplain.demo.page import page
    from xplain.demo.play import play, stage

    scene = stage(given.overrides, given.trace, given.user)
    played = play(scene, scene.user_type(given.user))
    write_text(given.html, page(scene, played))
    print(given.html)
