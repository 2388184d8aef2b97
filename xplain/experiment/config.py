"""Configuration that all commands share: the folder of the YAML files, the types of the top-level
keys, and one-line errors."""

import difflib
import os
import re
import secrets
import sys
from collections.abc import Iterator, Mapping, Sequence
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
from hydra.utils import instantiate
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

from xplain.errors import InputError, XplainError, escape, first_line, one_of, quote

_INSIDE = Path(__file__).parents[1] / "conf"
CONF = _INSIDE if _INSIDE.is_dir() else _INSIDE.parents[1] / "conf"
"""Folder of the YAML files: inside the package in a wheel, beside the package in a checkout."""

SOURCE_GROUPS = ("domain", "users", "observers", "queries", "labeler", "clusterer")
"""Groups of components that decide data and types."""
GROUPS = (*SOURCE_GROUPS, "solver", "belief", "explainee", "ask")
"""Groups of components that affect a number. Names of jobs contain the choices without the
group."""
RESUME = ("missing", "failed", "none")
"""The jobs of a sweep that run: unfinished jobs, failed jobs, or all jobs again."""

OF_PEOPLE = ("fastapi", "itsdangerous", "jwt", "pydantic", "uvicorn")
"""Modules of the extra ``people``."""

USER_ERRORS = (HydraException, OmegaConfBaseException, YAMLError, OSError)
"""Errors of libraries that the user can correct, if :func:`one_line` describes them."""

NO_PACKAGE = (
    "domain: the file of this choice has to begin with the line '# @package _global_', since it "
    "sets keys beside domain"
)


def schema() -> DictConfig:
    """Makes the types of the top-level keys. With these types 1 and 1.0 are the same λ, and a text
    instead of a number is an error at once. The keys' values are only in conf/config.yaml."""
    kinds = {
        IntegerNode: ("seed", "points", "traces", "max_steps"),
        FloatNode: ("lambda", "discount", "inexplicability_cost"),
        StringNode: ("discount_per", "prior", "resume"),
        BooleanNode: ("dry_run",),
        AnyNode: ("message_cost",),  # a number, or numbers by name; checked with the messages
    }
    typed = {key: kind("???") for kind, keys in kinds.items() for key in keys}
    # An absolute path is the same folder in every worker. A path may contain "${".
    outputs = StringNode(escape(str(Path.cwd() / "outputs")))
    return OmegaConf.create({**typed, "outputs": outputs})


def register() -> None:
    """Registers the resolvers of the configs. A second call changes nothing (workers import this
    module)."""
    ConfigStore.instance().store("base", schema())
    # Drawn once for each configuration: no two runs share a folder.
    OmegaConf.register_new_resolver(
        "unique", lambda: secrets.token_hex(3), replace=True, use_cache=True
    )
    OmegaConf.register_new_resolver(
        "output_dir", lambda *, _root_: output_dir(_root_.hydra), replace=True
    )


def output_dir(hydra: Any) -> str:
    """Returns the folder of a run from the ``hydra`` node. Its name may contain "${", which Hydra
    does not escape."""
    plain: Any = OmegaConf.to_container(hydra.runtime)
    return str(plain["output_dir"])


def compose_config(name: str, overrides: Sequence[str], with_hydra: bool = False) -> DictConfig:
    """Composes conf/<name>.yaml with overrides.

    Args:
        name: name of the file, without its ending.
        overrides: texts ``key=value``.
        with_hydra: True adds the ``hydra`` node, which contains the choices.

    Raises:
        InputError: an override is not ``key=value``.
        HydraException, OmegaConfBaseException: an unknown key, choice or value.
    """
    from hydra import compose, initialize_config_dir

    for override in overrides:
        if "=" not in override and not override.startswith("~"):
            raise InputError("argument", override, "key=value")
    register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose(name, [*overrides], return_hydra_config=with_hydra)


def make_object(node: Mapping[str, Any], **options: bool) -> Any:
    """Makes the object that a resolved node describes, by Hydra's ``instantiate``."""
    # Hydra resolves a configuration before it reads it, so its texts are read twice.
    return instantiate(escape(escape(node)), **options)


def search_path(key: str, folder: str | None) -> list[str]:
    """Returns the override that lets Hydra find choices in another folder; [] without a folder.

    Raises:
        InputError: the folder, which ``key`` names, does not exist.
    """
    if folder is None:
        return []
    path = Path(folder).absolute()
    if not path.is_dir():
        raise InputError(key, str(path), "a folder with choices of your own")
    return [f"hydra.searchpath=[{quote(f'file://{path}')}]"]


def require_names(overrides: Sequence[str]) -> None:
    """Refuses overrides that give a choice as null, a boolean or a list instead of a name.

    Raises:
        InputError: there is such an override.
    """
    for override in overrides:
        key, _, value = override.partition("=")
        if key in (*GROUPS, "tracking") and re.match(r"(null|true|false)$|\[", value):
            names = sorted(path.stem for path in (CONF / key).glob("*.yaml"))
            raise InputError(key, value, f"the name of a choice: {', '.join(names)}")


def require_usable(cfg: DictConfig) -> None:
    """Refuses an experiment's configuration whose values have valid types but are not allowed.

    Raises:
        XplainError: a choice that is null, an unknown ``resume``, or a domain's file in the wrong
            package.
    """
    for group in (*GROUPS, "tracking", "certify"):
        if cfg.get(group) is None:
            raise InputError(group, None, "the name of a choice, or keys")
    one_of("resume", cfg.resume, RESUME)
    if "_target_" not in cfg.domain and "domain" in cfg.domain:
        raise XplainError(NO_PACKAGE)


@contextmanager
def report_errors() -> Iterator[None]:
    """Turns errors that the user can correct into one line on stderr and exit code 2.

    ``XPLAIN_TRACEBACK=1`` shows the traceback instead.
    """
    try:
        yield
    except BrokenPipeError:  # the reader of the output has ended
        sys.exit(1)
    except KeyboardInterrupt as error:
        _exit_interrupted(error)
    except (XplainError, *USER_ERRORS, ModuleNotFoundError) as error:
        text = one_line(error)
        if text is None or os.environ.get("XPLAIN_TRACEBACK"):
            raise
        print(f"xplain: {text}", file=sys.stderr)
        sys.exit(2)
    except Exception as error:
        for cause in _list_causes(error):
            if isinstance(cause, KeyboardInterrupt):  # replaced by another error in a library
                _exit_interrupted(cause)
        raise


def _exit_interrupted(error: BaseException) -> NoReturn:
    print(": ".join(["xplain: interrupted", *map(str, error.args)]), file=sys.stderr)
    sys.exit(130)


def one_line(error: BaseException) -> str | None:
    """Describes an error that the user can correct, in one line. None for other errors."""
    for cause in _list_causes(error):
        key = getattr(cause, "full_key", None) or "config"
        match cause:
            case XplainError():
                return str(cause)
            case MissingConfigException():
                return _describe_unknown_choice(cause)
            case OverrideParseException():
                return (
                    f"{cause.override}: cannot be read; several values have commas between them "
                    "(lambda=0.5,1), and text with special letters has quotes"
                )
            case ConfigCompositionException():
                return _describe_composition(cause)
            case ConfigAttributeError() | ConfigKeyError():
                return _describe_unknown_key(cause)
            case MissingMandatoryValue():
                return f"{key}: has to be given: {key}=VALUE"
            case OmegaConfBaseException():
                if other := _OTHER_KIND(first_line(cause)):
                    return str(InputError(key, other[1], _KINDS[other[2]]))
                return f"{key}: {first_line(cause)}"
            case MarkedYAMLError(problem_mark=mark) if mark is not None:
                return f"{mark.name}: line {mark.line + 1}: {cause.problem}"
            case ModuleNotFoundError() if cause.name in OF_PEOPLE:
                return f"{cause.name} is not installed: pip install 'xplain-hri[people]'"
            case OSError() if cause.strerror is not None:
                return ": ".join(filter(None, [cause.filename, cause.strerror]))
    return " ".join(str(error).split()) if isinstance(error, HydraException) else None


_KINDS = {"Float": "a number", "Integer": "a whole number", "bool": "true or false"}
_OTHER_KIND = re.compile(
    r"Value '(.*?)'(?: of .*)? (?:could not be converted to|is not a valid) "
    rf"({'|'.join(_KINDS)})"
).match


def _list_causes(error: BaseException) -> list[BaseException]:
    """Lists an error and its causes. Errors of this package come first."""
    chain = [error]
    while (own := chain[-1].__cause__ or chain[-1].__context__) is not None and own not in chain:
        chain.append(own)
    return sorted(chain, key=lambda item: not isinstance(item, XplainError))


def _describe_unknown_choice(error: MissingConfigException) -> str:
    missing = str(error.missing_cfg_file or "?")
    group, _, choice = missing.rpartition("/")
    options = list(error.options or ())
    if not group:
        return first_line(error)
    hint = did_you_mean(choice, options)
    return f"{group}={choice}: unknown choice;{hint} allowed: {', '.join(options)}"


def missing_key(error: BaseException) -> str | None:
    """Returns the key that an override sets and the configuration lacks; None for other errors."""
    cause: Any = error.__cause__
    lacks = isinstance(cause, ConfigAttributeError | ConfigKeyError)
    return str(cause.full_key) if lacks else None


def _describe_composition(error: ConfigCompositionException) -> str:
    cause: Any = error.__cause__
    several = re.match(
        r"(?:Ambiguous value for argument|Sweep parameters) '(.*?)=(.*)'", first_line(error)
    )
    if several:
        allowed = "one value; to run a job for each of several values, add -m (xplain.sweep)"
        return str(InputError(several[1], several[2], allowed))
    if isinstance(cause, OmegaConfBaseException):
        return one_line(cause) or ""
    if "@domain." in str(error):
        return NO_PACKAGE
    return " ".join(str(error).split())


PYTHON = {"trade_off": "lambda"}
"""Python names of the keys whose own names are reserved words in Python."""

_NEVER_SUGGESTED = ("hydra", "_target_", "_convert_", "_partial_")
"""Keys that are never suggested in place of an unknown key."""


def _describe_unknown_key(error: Any) -> str:
    """Suggests a key that is similar to an unknown key: a key of the same level, or of another
    choice in the same group."""
    above, _, name = str(error.full_key).rpartition(".")
    known = [str(key) for key in error.parent_node or () if key not in _NEVER_SUGGESTED]
    said, there = f"{error.full_key}: no such key;", ", ".join(known) or "no keys"
    if above == "message_cost":
        return f"{said} give a number for each message by name: {above}={{{name}: 2, …}}"
    if not above:
        known += ["sweeps"] if "certify" in known else []  # the experiment's group without a key
        return f"{said}{did_you_mean(PYTHON.get(name, name), known)} allowed: {', '.join(known)}"
    sets = re.compile(rf"^ *{re.escape(name)}:", re.MULTILINE).search
    paths = sorted((CONF / above).glob("*.yaml"))
    if needs := [f"{above}={path.stem}" for path in paths if sets(path.read_text("utf-8"))]:
        return f"{said} it needs {' or '.join(needs)}"
    more = f"; +{error.full_key}=… adds this key" if "." in above else " (--cfg job shows them)"
    return f"{said}{did_you_mean(name, known, f'{above}.')} {above} has {there}{more}"


def did_you_mean(word: str, known: Sequence[str], before: str = "") -> str:
    """Returns `` did you mean lambda?`` if a known word is similar; otherwise ""."""
    near = difflib.get_close_matches(word, known, 1)
    return f" did you mean {before}{near[0]}?" if near else ""
