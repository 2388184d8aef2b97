"""What every command shares: where configs are, types of the top-level keys, one-line errors."""

from __future__ import annotations

import difflib
import os
import re
import secrets
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException
from omegaconf import (
    DictConfig,
    FloatNode,
    IntegerNode,
    OmegaConf,
    StringNode,
)
from omegaconf.errors import OmegaConfBaseException

from xplain.errors import InputError, XplainError, whole_number

_PACKAGE = Path(__file__).parent


def _shipped(folder: str) -> Path:
    """A folder of configs: inside the package in a wheel, beside it in a checkout."""
    inside = _PACKAGE / folder
    return inside if inside.is_dir() else _PACKAGE.parent / folder


CONF = _shipped("conf")
SWEEPS = _shipped("sweeps")

GROUPS = (
    "domain",
    "users",
    "observers",
    "queries",
    "labeler",
    "clusterer",
    "solver",
    "belief",
)
"""Groups of components that decide a number; a choice says what it is without its key."""
MOVED = {
    "observers.queries": "queries=independent or queries=shared",
    "observers.trace_length": "queries.trace_length",
    "observers.message_probability": "queries.message_probability",
}
"""Keys that are called otherwise today."""

_unique = secrets.token_hex(3)


def schema() -> DictConfig:
    """Types of the top-level keys: 1 and 1.0 are the same λ, text is refused at once."""
    return OmegaConf.create(
        {
            "seed": IntegerNode(0),
            "lambda": FloatNode(1.0),
            "points": IntegerNode("???"),
            "traces": IntegerNode(20),
            "max_steps": IntegerNode(40),
            "discount": FloatNode(0.95),
            "discount_per": StringNode("action"),
            "message_cost": FloatNode(1.0),
            "inexplicability_cost": FloatNode(1.0),
            "prior": StringNode("uniform"),
            "resume": StringNode("missing"),
            # Absolute, so that it is the same folder in every worker.
            "outputs": StringNode(str(Path.cwd() / "outputs")),
        }
    )


def register() -> None:
    """Registers what the configs refer to. Safe to call twice (workers import this module)."""
    ConfigStore.instance().store("base", schema())
    OmegaConf.register_new_resolver("unique", lambda: _unique, replace=True)
    # Hydra prints errors over several lines and exits; with this it raises, and we print one.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")


_handed_over: list[Exception] = []


def hand_over(error: Exception) -> None:
    """Keeps an error for :func:`report_errors`. Hydra prints lines of its own about an exception
    that leaves a job, so a single job hands its over and returns."""
    _handed_over.append(error)


def composed(name: str, overrides: Sequence[str], with_hydra: bool = False) -> DictConfig:
    """conf/<name>.yaml with overrides.

    Args:
        name: of the file, without its ending.
        overrides: ``key=value`` each.
        with_hydra: whether the ``hydra`` node comes along, which knows the choices made.

    Raises:
        InputError: an override that is no ``key=value``, or of a key that there is not.
        HydraException, OmegaConfBaseException: a choice or a value that there is not.
    """
    from hydra import compose, initialize_config_dir

    register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        known = [str(key) for key in compose(name)]
        for override in overrides:
            key, equals, _ = override.partition("=")
            if not equals:
                raise InputError("argument", override, f"key=value; keys: {', '.join(known)}")
            if key.lstrip("+~").split(".")[0].split("/")[0] not in (*known, "hydra"):
                near = difflib.get_close_matches(key, known, 1)
                hint = f"did you mean {near[0]}? " if near else ""
                raise InputError(key, override, f"no such key; {hint}keys: {', '.join(known)}")
        return compose(name, named(overrides), return_hydra_config=with_hydra)


def named(overrides: Sequence[str]) -> list[str]:
    """Overrides whose choice of a group is a name to Hydra too: it reads ``labeler=true`` as a
    truth value, where only text can name a file."""

    def quoted(override: str) -> str:
        key, _, value = override.partition("=")
        return f"{key}='{value}'" if key in GROUPS and value in ("true", "false") else override

    return [quoted(override) for override in overrides]


def require_seed(cfg: DictConfig) -> int:
    """The seed of a command.

    Raises:
        InputError: no whole number ≥ 0.
    """
    return whole_number("seed", cfg.seed, 0)


@contextmanager
def report_errors() -> Iterator[None]:
    """Turns errors of the user's making into one line on stderr and exit code 2.

    With ``XPLAIN_TRACEBACK=1`` the traceback is shown instead.
    """
    _handed_over.clear()
    try:
        yield
        if _handed_over:
            raise _handed_over[0]
    except BrokenPipeError:  # whoever read the output has gone
        sys.exit(1)
    except KeyboardInterrupt:
        print("xplain: interrupted", file=sys.stderr)
        sys.exit(130)
    except (XplainError, HydraException, OmegaConfBaseException, OSError) as error:
        text = one_line(error)
        if text is None or os.environ.get("XPLAIN_TRACEBACK"):
            raise
        print(f"xplain: {text}", file=sys.stderr)
        sys.exit(2)


def one_line(error: BaseException) -> str | None:
    """The line that a person can act on; None where the error is our fault, not theirs."""
    for cause in _causes(error):
        if isinstance(cause, XplainError):
            return str(cause)
        if isinstance(cause, MissingConfigException):
            return _unknown_choice(cause)
        if isinstance(cause, ConfigCompositionException):
            return _composition(cause)
        if isinstance(cause, OmegaConfBaseException):
            key = getattr(cause, "full_key", None) or "config"
            return f"{key}: {_first_line(cause)}"
        if isinstance(cause, OSError) and cause.filename is not None:
            return f"{cause.filename}: {cause.strerror}"
    if isinstance(error, HydraException):
        return " ".join(str(error).split())
    return None


def _causes(error: BaseException) -> list[BaseException]:
    """The chain of causes, the innermost error of ours first."""
    chain: list[BaseException] = []
    current: BaseException | None = error
    while current is not None and current not in chain:
        chain.append(current)
        current = current.__cause__ or current.__context__
    return sorted(chain, key=lambda item: not isinstance(item, XplainError))


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _unknown_choice(error: MissingConfigException) -> str:
    missing = str(error.missing_cfg_file or "?")
    group, _, choice = missing.rpartition("/")
    options = ", ".join(error.options or ())
    if not group:
        return _first_line(error)
    return f"{group}={choice}: unknown choice; allowed: {options}"


def _composition(error: ConfigCompositionException) -> str:
    text = str(error)
    misspelt = re.search(r"Could not override '([^']+)'", text)
    if misspelt:
        key = misspelt.group(1)
        line = f"{key}: no such key"
        if key in MOVED:
            return f"{key}: no such key; it is {MOVED[key]} now"
        known = [*schema(), *GROUPS]
        near = difflib.get_close_matches(key, known, 1)
        if near:
            line += f"; did you mean {near[0]}?"
        elif "." in key:
            line += f"; see what {key.rsplit('.', 1)[0]} takes with --cfg job"
        return line + f" allowed: {', '.join(known)}" if "." not in key else line
    cause: Any = error.__cause__
    if isinstance(cause, OmegaConfBaseException):
        return f"{getattr(cause, 'full_key', None) or 'config'}: {_first_line(cause)}"
    return " ".join(text.split())
