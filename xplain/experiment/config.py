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
from typing import Any, NoReturn

from hydra.core.config_store import ConfigStore
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import (
    AnyNode,
    BooleanNode,
    DictConfig,
    FloatNode,
    IntegerNode,
    OmegaConf,
    StringNode,
)
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)
from yaml import MarkedYAMLError, YAMLError

from xplain.errors import InputError, XplainError, first_line, one_of

_INSIDE = Path(__file__).parents[1] / "conf"
CONF = _INSIDE if _INSIDE.is_dir() else _INSIDE.parents[1] / "conf"
"""Every choice as YAML: inside the package in a wheel, beside it in a checkout."""

SOURCE_GROUPS = ("domain", "users", "observers", "queries", "labeler", "clusterer")
"""Groups of components that decide data and types."""
GROUPS = (*SOURCE_GROUPS, "solver", "belief", "explainee", "ask")
"""Groups of components that decide a number; a choice says what it is without its key."""
RESUME = ("missing", "failed", "none")
"""Which jobs of a sweep run: those not finished, those that failed, or all of them anew."""

OF_PEOPLE = ("fastapi", "itsdangerous", "jwt", "lxml", "pydantic", "requests", "uvicorn")
"""Modules that the extra ``people`` brings."""

NO_PACKAGE = (
    "domain: the file of this choice has to begin with the line '# @package _global_', since it "
    "sets keys beside domain"
)


def schema() -> DictConfig:
    """Types of the top-level keys: 1 and 1.0 are the same λ, text is refused at once. Values are in
    conf/config.yaml alone."""
    kinds = {
        IntegerNode: ("seed", "points", "traces", "max_steps"),
        FloatNode: ("lambda", "discount", "inexplicability_cost"),
        StringNode: ("discount_per", "prior", "resume"),
        BooleanNode: ("dry_run",),
        AnyNode: ("message_cost",),  # a number, or one by name; checked with the messages
    }
    typed = {key: kind("???") for kind, keys in kinds.items() for key in keys}
    # Absolute, so that it is the same folder in every worker; a path may have "${" in it.
    outputs = str(Path.cwd() / "outputs").replace("${", r"\${")
    return OmegaConf.create({**typed, "outputs": StringNode(outputs)})


def register() -> None:
    """Registers what the configs refer to. Safe to call twice (workers import this module)."""
    ConfigStore.instance().store("base", schema())
    # Drawn once a configuration: no two runs share a folder.
    OmegaConf.register_new_resolver(
        "unique", lambda: secrets.token_hex(3), replace=True, use_cache=True
    )


def composed(name: str, overrides: Sequence[str], with_hydra: bool = False) -> DictConfig:
    """conf/<name>.yaml with overrides.

    Args:
        name: of the file, without its ending.
        overrides: ``key=value`` each.
        with_hydra: whether the ``hydra`` node comes along, which knows the choices made.

    Raises:
        InputError: an override that is no ``key=value``.
        HydraException, OmegaConfBaseException: a key, choice or value that there is not.
    """
    from hydra import compose, initialize_config_dir

    for override in overrides:
        if "=" not in override and not override.startswith("~"):
            raise InputError("argument", override, "key=value")
    register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose(name, [*overrides], return_hydra_config=with_hydra)


def require_names(overrides: Sequence[str]) -> None:
    """Refuses what Hydra takes for a truth value or nothing, where a choice has a name.

    Raises:
        InputError: it is so.
    """
    for override in overrides:
        key, _, value = override.partition("=")
        if key in (*GROUPS, "tracking") and value in ("null", "true", "false"):
            names = sorted(path.stem for path in (CONF / key).glob("*.yaml"))
            raise InputError(key, value, f"the name of a choice: {', '.join(names)}")


def require_usable(cfg: DictConfig) -> None:
    """Refuses an experiment's configuration whose types fit and which makes no sense all the same.

    Raises:
        XplainError: a choice that is null, a ``resume`` that there is not, or a domain's file in
            the wrong package.
    """
    for group in (*GROUPS, "tracking"):
        if cfg.get(group) is None:
            raise InputError(group, None, "the name of a choice")
    one_of("resume", cfg.resume, RESUME)
    if "_target_" not in cfg.domain and "domain" in cfg.domain:
        raise XplainError(NO_PACKAGE)


@contextmanager
def report_errors() -> Iterator[None]:
    """Turns errors of the user's making into one line on stderr and exit code 2.

    With ``XPLAIN_TRACEBACK=1`` the traceback is shown instead.
    """
    try:
        yield
    except BrokenPipeError:  # whoever read the output has gone
        sys.exit(1)
    except KeyboardInterrupt as error:
        _say_interrupted(error)
    except (
        *(XplainError, HydraException, OmegaConfBaseException),
        *(YAMLError, OSError, ModuleNotFoundError),
    ) as error:
        text = one_line(error)
        if text is None or os.environ.get("XPLAIN_TRACEBACK"):
            raise
        print(f"xplain: {text}", file=sys.stderr)
        sys.exit(2)
    except Exception as error:
        for cause in _causes(error):
            if isinstance(cause, KeyboardInterrupt):  # it became another error on its way
                _say_interrupted(cause)
        raise


def _say_interrupted(error: BaseException) -> NoReturn:
    print(": ".join(["xplain: interrupted", *map(str, error.args)]), file=sys.stderr)
    sys.exit(130)


def one_line(error: BaseException) -> str | None:
    """The line that a person can act on; None where the error is our fault, not theirs."""
    for cause in _causes(error):
        if isinstance(cause, XplainError):
            return str(cause)
        if isinstance(cause, MissingConfigException):
            return _unknown_choice(cause)
        if isinstance(cause, OverrideParseException):
            return (
                f"{cause.override}: cannot be read; several values have commas between them "
                "(lambda=0.5,1), and text with special letters has quotes"
            )
        if isinstance(cause, ConfigCompositionException):
            return _composition(cause)
        if isinstance(cause, ConfigAttributeError | ConfigKeyError):
            return _unknown_key(cause)
        if isinstance(cause, OmegaConfBaseException):
            key = getattr(cause, "full_key", None) or "config"
            if isinstance(cause, MissingMandatoryValue):
                return f"{key}: has to be given: {key}=VALUE"
            if other := _OTHER_KIND(first_line(cause)):
                return str(InputError(key, other[1], _KINDS[other[2]]))
            return f"{key}: {first_line(cause)}"
        if isinstance(cause, MarkedYAMLError) and (mark := cause.problem_mark) is not None:
            return f"{mark.name}: line {mark.line + 1}: {cause.problem}"
        if isinstance(cause, ModuleNotFoundError) and cause.name in OF_PEOPLE:
            return f"{cause.name} is not installed: pip install 'xplain-hri[people]'"
        if isinstance(cause, OSError) and cause.strerror is not None:
            where = "" if cause.filename is None else f"{cause.filename}: "
            return f"{where}{cause.strerror}"
    if isinstance(error, HydraException):
        return " ".join(str(error).split())
    return None


_KINDS = {"Float": "a number", "Integer": "a whole number", "Boolean": "true or false"}
_OTHER_KIND = re.compile(rf"Value '(.*)' .*could not be converted to ({'|'.join(_KINDS)})").match


def _causes(error: BaseException) -> list[BaseException]:
    """The chain of causes, the innermost error of ours first."""
    chain: list[BaseException] = []
    current: BaseException | None = error
    while current is not None and current not in chain:
        chain.append(current)
        current = current.__cause__ or current.__context__
    return sorted(chain, key=lambda item: not isinstance(item, XplainError))


def _unknown_choice(error: MissingConfigException) -> str:
    missing = str(error.missing_cfg_file or "?")
    group, _, choice = missing.rpartition("/")
    options = list(error.options or ())
    if not group:
        return first_line(error)
    hint = did_you_mean(choice, options)
    return f"{group}={choice}: unknown choice;{hint} allowed: {', '.join(options)}"


def missing_key(error: BaseException) -> str | None:
    """The key that a configuration lacks and an override sets; None where the error is another."""
    cause: Any = error.__cause__
    lacks = isinstance(cause, ConfigAttributeError | ConfigKeyError)
    return str(cause.full_key) if lacks else None


def _composition(error: ConfigCompositionException) -> str:
    cause: Any = error.__cause__
    several = re.match(
        r"(?:Ambiguous value for argument|Sweep parameters) '(.*?)=(.*)'", first_line(error)
    )
    if several:
        allowed = "one value; to run one job for each of several, add -m (xplain.sweep)"
        return str(InputError(several[1], several[2], allowed))
    if isinstance(cause, OmegaConfBaseException):
        return one_line(cause) or ""
    if "@domain." in str(error):
        return NO_PACKAGE
    return " ".join(str(error).split())


_UNTOLD = ("hydra", "_target_", "_convert_", "_partial_")
"""Keys that nobody sets who means another."""


def _unknown_key(error: Any) -> str:
    """Suggests a key in place of an unknown one: a key beside it, or one of another choice of its
    group."""
    above, _, name = str(error.full_key).rpartition(".")
    known = [str(key) for key in error.parent_node or () if key not in _UNTOLD]
    said, there = f"{error.full_key}: no such key;", ", ".join(known) or "no keys"
    if above == "message_cost":
        return f"{said} one a message: {above}={{{name}: 2, …}}, all of them by name"
    if not above:
        known += ["sweeps"] if "certify" in known else []  # the experiment's group of no key
        return f"{said}{did_you_mean(name, known)} allowed: {', '.join(known)}"
    sets = re.compile(rf"^ *{re.escape(name)}:", re.MULTILINE).search
    paths = sorted((CONF / above).glob("*.yaml"))
    if needs := [f"{above}={path.stem}" for path in paths if sets(path.read_text("utf-8"))]:
        return f"{said} it needs {' or '.join(needs)}"
    more = f"; +{error.full_key}=… adds this one" if "." in above else " (--cfg job shows them)"
    return f"{said}{did_you_mean(name, known, f'{above}.')} {above} has {there}{more}"


def did_you_mean(word: str, known: Sequence[str], before: str = "") -> str:
    """`` did you mean lambda?`` where one of these is near; else nothing."""
    near = difflib.get_close_matches(word, known, 1)
    return f" did you mean {before}{near[0]}?" if near else ""
