"""The entry point: ``xplain [command] key=value …``; without a command, the experiment.

Slow imports happen only after the command is known.
"""

import gc
import json
import logging
import os
import sys
from itertools import groupby

from click import ClickException

from xplain import __version__
from xplain.cli import method, people  # noqa: F401  (they register their commands)
from xplain.cli.commands import COMMANDS, lines_of
from xplain.errors import InputError, XplainError, leave_at_once
from xplain.experiment.progress import is_terminal

HELP = """\
xplain: personalized explanations of a robot's decisions, as experiments.

  xplain solver=pomcp domain=rescue lambda=1.5     one run
  xplain -m solver=qmdp,pomcp lambda=0.5,1,2       all combinations
  xplain sweeps=table1                             a prepared sweep
  xplain COMMAND ...                               a command below; each has --help

{commands}

All keys with defaults and choices: xplain --hydra-help, docs/config.md. Keys of a run: --cfg job.
`python -m xplain` is the same as `xplain`.
"""

FLAGS = (
    *("help", "hydra-help", "version", "cfg", "resolve", "package", "run", "multirun"),
    *("shell-completion", "config-path", "config-name", "config-dir", "info"),
)
"""Flags of Hydra."""

THRESHOLDS = 50_000, 20, 20
"""When Python searches for garbage. Most objects of a command are its libraries', which stay: with
Python's own thresholds (700, 10, 10), a tenth of a small run is searches that find nothing."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command. An error that the user can correct is one line, with exit code 2.

    Args:
        arguments: words of the command line; None takes the words of this process.
    """
    gc.set_threshold(*THRESHOLDS)
    given = list(sys.argv[1:] if arguments is None else arguments)
    _show_work(given, "loading …")
    with leave_at_once():
        from xplain.experiment.config import report_errors

    with report_errors():
        if given[:1] in (["--help"], ["-h"]):
            print(HELP.format(commands="\n".join(lines_of(""))), end="")
        elif given == ["--version"]:
            print(f"xplain {__version__}")
        else:
            name, rest = split(given)
            _run_experiment(given) if name is None else _run_command(name, rest)


def _show_work(given: list[str], what: str) -> None:
    """Shows the current work on a terminal, until an experiment's first stage replaces this
    line."""
    if all("=" in word or word == "-m" for word in given) and is_terminal(sys.stderr):
        print(what, end="\r", file=sys.stderr, flush=True)


def _run_command(name: str, words: list[str]) -> None:
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    try:
        said = COMMANDS[name].main(words, f"xplain {name}", standalone_mode=False)
    except ClickException as error:
        text = " ".join(error.format_message().split())
        raise XplainError(f"{text} See xplain {name} --help") from None
    if isinstance(said, dict | list):
        print(json.dumps(said))


def _run_experiment(words: list[str]) -> None:
    """Runs the experiment or a sweep with Hydra's command line.

    Raises:
        XplainError: Hydra does not know a flag, or a flag is in a wrong place.
        SystemExit: 1 if jobs of a sweep failed.
    """
    with leave_at_once():
        from xplain.experiment.config import require_names
        from xplain.runs import command
    for i, word in enumerate(words):
        key, _, value = word.removeprefix("--").partition("=")
        if word.startswith("--") and key not in FLAGS:
            after = words[i + 1 : i + 2]
            value = value or (after[0] if after and "=" not in after[0] else "VALUE")
            raise XplainError(
                f"{word}: no such flag; keys are written without dashes: {key}={value}"
            )
    turns = [kind for kind, _ in groupby("=" in w and not w.startswith("-") for w in words)]
    if turns.count(True) > 1:
        raise XplainError("-m and other flags must be before all keys, or after all keys")
    require_names(words)
    _show_work(words, "composing …")
    # Otherwise MLflow tries an unavailable server for minutes.
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")
    os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "ERROR")  # read when MLflow is imported
    logging.getLogger("mlflow").setLevel(logging.ERROR)  # if it is already imported
    command.main()


def split(words: list[str]) -> tuple[str | None, list[str]]:
    """Splits words into the command (None is the experiment) and the words after it.

    Raises:
        InputError: the command is unknown.
    """
    for length in (2, 1):
        name = " ".join(words[:length])
        if len(words) >= length and name in COMMANDS:
            return name, words[length:]
    if words and words[0].isidentifier():
        allowed = ", ".join(name for name in COMMANDS if " " not in name)
        raise InputError("command", words[0], f"key=value, or one of {allowed}")
    return None, words
