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

import argparse
import sys
from pathlib import Path

from xplain.cli.parser import Parser
from xplain.errors import InputError, whole_number


def main(arguments: list[str]) -> None:
    """Plays one session on the terminal, writes it as a page, or serves the playground."""
    parser = Parser("xplain demo")
    who = parser.add_mutually_exclusive_group()
    who.add_argument("--user", metavar="TYPE")
    who.add_argument("--me", action="store_true")
    parser.add_argument("--trace", metavar="N", type=int)
    parser.add_argument("--html", metavar="FILE", type=Path)
    parser.add_argument("--serve", action="store_true")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5050)
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*")
    _play(parser.parse_intermixed_args(arguments))


def _play(arguments: argparse.Namespace) -> None:
    if arguments.serve:
        from xplain.demo.serve import serve

        serve(arguments.overrides, arguments.host, arguments.port)
        return
    if arguments.trace is not None:
        whole_number("--trace", arguments.trace, 0)
    if arguments.html is not None and not arguments.html.absolute().parent.is_dir():
        raise InputError("--html", str(arguments.html), "a file in a folder that exists")
    # What follows brings the heavy packages; --help is over by now.
    from xplain.demo.page import page
    from xplain.demo.play import Simulated, asked, play, stage
    from xplain.demo.terminal import Terminal

    scene = stage(arguments.overrides, arguments.trace, arguments.user)
    if arguments.me:
        terminal = Terminal(scene, None)
        played = play(scene, asked(terminal), terminal)
    else:
        user = scene.user_type(arguments.user)
        audience = None if arguments.html else Terminal(scene, user)
        played = play(scene, Simulated(scene, user), audience)
    if arguments.html is not None:
        arguments.html.write_text(page(scene, played), encoding="utf-8")
        print(arguments.html, file=sys.stderr)
