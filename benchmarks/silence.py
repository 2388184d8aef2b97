"""Records the output of a command on a terminal, with seconds, and prints the longest time without
output.

    python benchmarks/silence.py [--quick] [--most SECONDS] [--out FILE] [-- COMMAND ...]
    python benchmarks/silence.py -- make run
    NUMBA_CACHE_DIR=$(mktemp -d) python benchmarks/silence.py

The default command is README's; with ``--quick`` it is a shorter command, and no time is too long.
The exit code is 1 if nothing was written for longer than ``--most`` (3 seconds); a moving bar
counts as output. The recording has one line for each piece of output: its time in seconds, and its
text without control codes of a terminal. The command runs on a pty, so this needs POSIX.
"""

import argparse
import os
import pty
import re
import select
import sys
import tempfile
import time
from pathlib import Path

CONTROL = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]|[\r\x07]")
RUN = ["-m", "xplain", "solver=pomcp", "domain=rescue", "lambda=1.5"]
SHORT = ["traces=1", "max_steps=3", "points=20", "labeler=tree", "clusterer=perfect"]


def main() -> int:
    """Runs the command on a new terminal."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--most", type=float, default=3.0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("command", nargs="*")
    given = parser.parse_args()
    short = [*SHORT, "tracking=none"] if given.quick else []
    with tempfile.TemporaryDirectory() as outputs:
        command = [sys.executable, *RUN, f"outputs={outputs}", *short]
        pieces, code = recorded(given.command or command)
    lines, last, longest = [], 0.0, (0.0, 0.0)
    for second, text in pieces:
        longest = max(longest, (second - last, last))
        last = second
        said = [line.strip() for line in CONTROL.sub("", text).split("\n")]
        lines.append(f"{second:8.2f}  {' | '.join(filter(None, said))}")
    if given.out is not None:
        given.out.write_text("\n".join(lines) + "\n", encoding="utf-8")
    silence, at = longest
    print(
        f"exit code {code} after {last:.1f} s; no output for {silence:.1f} s from second {at:.1f}"
    )
    return int(code != 0 or (silence > given.most and not given.quick))


def recorded(command: list[str]) -> tuple[list[tuple[float, str]], int]:
    """Returns the output of the command on a terminal of 100 columns, with its times in seconds,
    and the exit code."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ |= {"COLUMNS": "100", "LINES": "40", "TERM": "xterm"}
        os.execvp(command[0], command)
    began, pieces = time.monotonic(), []
    while True:
        select.select([terminal], [], [])
        try:
            data = os.read(terminal, 65536)
        except OSError:  # the command has closed the terminal
            break
        if not data:
            break
        pieces.append((time.monotonic() - began, data.decode(errors="replace")))
    return pieces, os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


if __name__ == "__main__":
    sys.exit(main())
