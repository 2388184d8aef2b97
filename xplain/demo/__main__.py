"""``python -m xplain.demo``: one explanation session, with a simulated user or with you."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NoReturn

from xplain.config import report_errors
from xplain.errors import InputError

TEXT = """Plays one explanation session: the robot shows its trace step by step and says what this
user needs to know; the user says which transitions make no sense."""
EXAMPLES = """\
python -m xplain.demo                              a simulated user, chosen by the seed
python -m xplain.demo --user B lambda=2            a simulated user of type B
python -m xplain.demo --me                         you are the user
python -m xplain.demo --html demo.html             the same as one page, to step through
python -m xplain.demo domain=four_rooms solver=qhr seed=3

KEY=VALUE: those of python -m xplain (domain, users, solver, lambda, seed, ...)."""


class Parser(argparse.ArgumentParser):
    """Says in one line what is wrong, as the other commands do."""

    def error(self, message: str) -> NoReturn:
        """One line, exit code 2."""
        print(f"xplain: {message}; see --help", file=sys.stderr)
        sys.exit(2)


def main() -> None:
    """The command; every error that a person can mend is one line, exit code 2."""
    parser = Parser(
        "python -m xplain.demo",
        description=TEXT,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    who = parser.add_mutually_exclusive_group()
    who.add_argument("--user", metavar="TYPE", help="type of the simulated user")
    who.add_argument("--me", action="store_true", help="you answer")
    parser.add_argument("--trace", metavar="N", type=int, default=0, help="which trace, from 0")
    parser.add_argument("--html", metavar="FILE", type=Path, help="writes one page instead")
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="configuration")
    arguments = parser.parse_intermixed_args()
    with report_errors():
        _play(arguments)


def _play(arguments: argparse.Namespace) -> None:
    for override in arguments.overrides:
        if "=" not in override:
            raise InputError("argument", override, "KEY=VALUE, such as lambda=2, or see --help")
    if arguments.trace < 0:
        raise InputError("--trace", arguments.trace, "a whole number ≥ 0")
    if arguments.html is not None and not arguments.html.absolute().parent.is_dir():
        raise InputError("--html", str(arguments.html), "a file in a folder that exists")
    # What follows brings the heavy packages; --help is over by now.
    from xplain.demo.page import page
    from xplain.demo.play import Simulated, asked, play, stage
    from xplain.demo.terminal import Terminal

    scene = stage(arguments.overrides, arguments.trace)
    if arguments.me:
        terminal = Terminal(scene, None)
        played = play(scene, asked(terminal), terminal)
    else:
        user = scene.user_type(arguments.user)
        shown = None if arguments.html else Terminal(scene, user)
        played = play(scene, Simulated(scene, user), shown)
    if arguments.html is not None:
        arguments.html.write_text(page(scene, played), encoding="utf-8")
        print(arguments.html, file=sys.stderr)


if __name__ == "__main__":
    main()
