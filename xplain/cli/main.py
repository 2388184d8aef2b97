"""The one door: ``xplain [command] key=value …``; without a command, the experiment.

Nothing heavy is imported before it is known what to do.
"""

from __future__ import annotations

import ast
import json
import logging
import os
import sys
from importlib import import_module
from pathlib import Path

from xplain import __version__
from xplain.cli.commands import COMMANDS
from xplain.errors import InputError, left_at_once, quoted
from xplain.experiment.progress import is_terminal

HELP = """\
xplain: personalized explanations of a robot's decisions, as experiments.

  xplain solver=pomcp domain=rescue lambda=1.5     one run
  xplain -m solver=qmdp,pomcp lambda=0.5,1,2       all combinations
  xplain sweeps=table1                             a prepared sweep
  xplain COMMAND ...                               see below; each has --help

{commands}

All keys with their defaults and choices: xplain --hydra-help, docs/config.md. Of a run: --cfg job.
`python -m xplain` is the same as `xplain`.
"""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command; an error that a person can put right is one line, exit code 2.

    Args:
        arguments: of the command line; None takes those of the process.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    _tell(given, "loading …")
    with left_at_once():
        from xplain.experiment.config import report_errors

    with report_errors():
        if given[:1] in (["--help"], ["-h"]):
            print(HELP.format(commands="\n".join(_commands(""))), end="")
        elif given == ["--version"]:
            print(f"xplain {__version__}")
        else:
            _run(given)


def _tell(given: list[str], what: str) -> None:
    """On a terminal, what an experiment is at before its first stage, whose line covers this."""
    if all("=" in word or word == "-m" for word in given) and is_terminal(sys.stderr):
        print(what, end="\r", file=sys.stderr, flush=True)


def _run(given: list[str]) -> None:
    name, rest = split(given)
    if name is None:
        with left_at_once():
            from xplain.cli import run

        _tell(given, "composing …")
        # A person waits: MLflow would try a server that is away for minutes.
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")
        os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "ERROR")  # read when MLflow is imported
        logging.getLogger("mlflow").setLevel(logging.ERROR)  # where it is imported already
        run.main(given)
        return
    from xplain.experiment.config import CONF

    command = COMMANDS[name]
    module, _, function = command.module.partition(":")
    if any(word in ("--help", "-h") for word in rest):
        print(_told(module, function).replace("NAME", command.of), end="\n\n")
        if below := _commands(name):
            print("\n".join(below) + "\n")
        if command.config:
            print((CONF / f"{command.config}.yaml").read_text(encoding="utf-8"))
        return
    with left_at_once():
        found = import_module(f"xplain.cli.{module}")
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    called, words = getattr(found, function or "main"), _with_own_choices(rest)
    said = called(command.of, words) if command.of else called(words)
    if said is not None:
        print(json.dumps(said))


def _told(module: str, function: str) -> str:
    """The docstring of a command, read without the imports that it needs to run."""
    whole = ast.parse(Path(__file__).with_name(f"{module}.py").read_text(encoding="utf-8"))
    own = (node for node in whole.body if isinstance(node, ast.FunctionDef))
    return ast.get_docstring(next((f for f in own if f.name == function), whole)) or ""


def _with_own_choices(words: list[str]) -> list[str]:
    """``--config-dir FOLDER``, as Hydra's own command line has it, for every command.

    Raises:
        InputError: there is no such folder.
    """
    flags = ("--config-dir", "-cd")
    for i, word in enumerate(words):
        flag, equals, folder = word.partition("=")
        if flag in flags:
            end = i + 1 if equals else i + 2
            own = Path(folder if equals else "".join(words[i + 1 : end])).absolute()
            if not own.is_dir():
                raise InputError(flag, str(own), "a folder with choices of your own")
            return [*words[:i], *words[end:], f"hydra.searchpath=[{quoted(f'file://{own}')}]"]
    return words


def split(words: list[str]) -> tuple[str | None, list[str]]:
    """The command (None is the experiment) and what follows it.

    Raises:
        InputError: a word where a command should be that is none.
    """
    for length in (2, 1):
        name = " ".join(words[:length])
        if len(words) >= length and name in COMMANDS:
            return name, words[length:]
    if words and words[0].isidentifier():
        allowed = ", ".join(name for name in COMMANDS if " " not in name)
        raise InputError("command", words[0], f"key=value, or one of {allowed}")
    return None, words


def _commands(group: str) -> list[str]:
    """A line a command of the group, in whose line its own are named."""
    own = {name: command for name, command in COMMANDS.items() if name.rpartition(" ")[0] == group}
    lines = []
    for name, command in own.items():
        below = [other.rpartition(" ")[2] for other in COMMANDS if other.startswith(f"{name} ")]
        lines.append(f"  {name:{18 if group else 11}} {command.meaning}")
        if below:
            lines.append(f"  {name} ...".ljust(14) + ", ".join(below))
    return lines
