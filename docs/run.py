"""Runs the commands and programs in the docs: every `console` and `python` block, each document in
an empty folder.

    python docs/run.py docs/tour.md            compares, and prints the first difference
    python docs/run.py --write docs/tour.md    replaces the shown output by the real one

In a `console` block a line that begins with `$ ` is a command (`\\` at its end continues it), the
lines below it are its standard output; `...` replaces lines that are left out. Shown and real
output may differ in digits, bars and blanks: figures depend on versions and machines. A `python`
block is run as printed, after the blocks above it; what it prints is the `text` block that follows
it. A block that begins with "```python path/of/a/file" shows that file.
"""

import os
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FENCE = re.compile(r"^```(\w*)(?: \S+)?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"^(```\w+ (\S+)\n)(.*?)(^```$)", re.MULTILINE | re.DOTALL)
"""A block that shows a file of the repository."""
LEFT_OUT = "..."
SERVERS = re.compile(
    r"mlflow ui|python -m xplain study(?! (bots|export|replay|analyse))"
    r"|python -m xplain collect(?! (bots|export|replay))"
)
"""Commands that run until they are stopped; other tests start these."""


class DocsError(Exception):
    """A command failed, or its output differs from the docs."""


@dataclass
class Piece:
    """A command or a program with the output that the docs show.

    Attributes:
        command: as typed; empty for a program.
        code: a program in Python.
        shown: lines.
        real: lines of the real output, after it ran.
    """

    command: str = ""
    code: str = ""
    shown: list[str] = field(default_factory=list)
    real: list[str] = field(default_factory=list)


def main() -> int:
    """Compares or writes the given documents."""
    write = "--write" in sys.argv[1:]
    for name in [argument for argument in sys.argv[1:] if argument != "--write"]:
        document = Path(name)
        text = document.read_text(encoding="utf-8")
        if write:
            text = with_files(text)
        elif text != with_files(text):
            raise DocsError(f"{name} shows a file that has changed: --write")
        with tempfile.TemporaryDirectory() as folder:
            blocks = ran(text, Path(folder), compare=not write)
        if write:
            document.write_text(rewritten(text, blocks), encoding="utf-8")
    return 0


def with_files(text: str) -> str:
    """Returns the document with the current content of the files that it shows."""
    return FILE.sub(lambda b: b[1] + (ROOT / b[2]).read_text(encoding="utf-8") + b[4], text)


def blocks_of(text: str) -> list[tuple[re.Match[str], list[Piece]]]:
    """Returns the blocks to run, with their fences."""
    found: list[tuple[re.Match[str], list[Piece]]] = []
    before = ""
    for fence in FENCE.finditer(text):
        kind, body = fence.groups()
        if FILE.match(fence[0]):
            continue
        if kind == "console":
            found.append((fence, _parse_session(body)))
        elif kind == "python":
            found.append((fence, [Piece(code=body)]))
        elif kind == "text" and before == "python":
            found[-1][1][0].shown = body.splitlines()
            found.append((fence, []))
        before = kind
    return found


def _parse_session(body: str) -> list[Piece]:
    pieces: list[Piece] = []
    lines = iter(body.splitlines())
    for line in lines:
        if not line.startswith("$ "):
            pieces[-1].shown.append(line)
            continue
        command = line.removeprefix("$ ")
        while command.endswith("\\"):
            command += "\n" + next(lines)
        pieces.append(Piece(command))
    return pieces


def ran(text: str, folder: Path, compare: bool) -> list[tuple[re.Match[str], list[Piece]]]:
    """Runs all blocks in this folder.

    Raises:
        DocsError: a block fails, or (``compare``) its output differs from the shown one.
    """
    found = blocks_of(text)
    env = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "100", "PYTHONIOENCODING": "utf-8"}
    env["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), env.get("PATH", "")])
    env.pop("MLFLOW_TRACKING_URI", None)
    (folder / "examples").symlink_to(ROOT / "examples")
    for _, pieces in found:
        for piece in pieces:
            if SERVERS.match(piece.command):
                piece.real = piece.shown
                continue
            done = subprocess.run(
                [sys.executable, "-c", piece.code] if piece.code else ["bash", "-c", piece.command],
                cwd=folder,
                env=env,
                capture_output=True,
                text=True,
                timeout=900,
                check=False,
            )
            what = piece.command or piece.code
            # The docs may show the line with which a command refuses bad input.
            refused = done.returncode == 2 and not done.stdout
            if done.returncode != 0 and not refused:
                raise DocsError(f"exit code {done.returncode}: {what}\n{done.stderr}")
            piece.real = (done.stderr if refused else done.stdout).rstrip().splitlines()
            if compare and (difference := differs(piece.shown, piece.real)):
                raise DocsError(f"{what}\n{difference}")
    return found


def differs(shown: list[str], real: list[str]) -> str:
    """Describes the first difference; empty if there is none."""
    rest = list(real)
    skipping = False
    for line in shown:
        if line.strip() == LEFT_OUT:
            skipping = True
            continue
        wanted = masked(line)
        while skipping and rest and masked(rest[0]) != wanted:
            rest.pop(0)
        if not rest or masked(rest[0]) != wanted:
            return f"shown: {line!r}\nreal:  {(rest or ['(nothing more)'])[0]!r}"
        rest.pop(0)
        skipping = False
    return "" if skipping or not rest else f"not shown: {rest[0]!r}"


def masked(line: str) -> str:
    """Removes from a line what may differ: digits, signs before them, bars, rules, blanks, ids."""
    line = re.sub(r"(?:\b[0-9a-f]{6,}|_[0-9a-f]{4})\b", "#", line)
    line = re.sub(r"\((exact|± [^)]*)\)", "", line)
    line = re.sub(r"[-−+]?\d[\d.,:]*%?", "#", line)
    line = re.sub(r"[█─━╭╮╰╯│↑↓]+", "", line)
    return " ".join(line.split())


def rewritten(text: str, found: list[tuple[re.Match[str], list[Piece]]]) -> str:
    """Returns the document with the real output."""
    for at in range(len(found) - 1, -1, -1):
        fence, pieces = found[at]
        if fence[1] == "console":
            body = "\n".join(
                line for p in pieces for line in (f"$ {p.command}", *_leave_out(p.shown, p.real))
            )
            text = text[: fence.start(2)] + body + "\n" + text[fence.end(2) :]
        elif fence[1] == "text":
            real = found[at - 1][1][0].real
            text = text[: fence.start(2)] + "\n".join(real) + "\n" + text[fence.end(2) :]
    return text


def _leave_out(shown: list[str], real: list[str]) -> list[str]:
    """Returns the real output without the lines that the docs leave out."""
    gaps = [i for i, line in enumerate(shown) if line.strip() == LEFT_OUT]
    if not gaps:
        return real
    head, tail = gaps[0], len(shown) - gaps[-1] - 1
    if head + tail >= len(real):
        return real
    return [*real[:head], LEFT_OUT, *(real[-tail:] if tail else [])]


if __name__ == "__main__":
    sys.exit(main())
