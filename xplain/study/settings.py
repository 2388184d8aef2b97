"""What the study's commands share: composing conf/study.yaml, one-line errors."""

from __future__ import annotations

import difflib
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from xplain.errors import InputError

if TYPE_CHECKING:
    from omegaconf import DictConfig

NOT_OF_THE_PLAN = ("database", "host", "port", "threads", "server", "outputs")
"""Keys that may change between two starts of one study."""


def composed(overrides: Sequence[str]) -> DictConfig:
    """conf/study.yaml with these overrides.

    Raises:
        InputError, HydraException, OmegaConfBaseException: something in them is wrong.
    """
    from hydra import compose, initialize_config_dir
    from hydra.errors import ConfigCompositionException

    from xplain.config import CONF, prepare

    for override in overrides:
        if "=" not in override:
            raise InputError("argument", override, "key=value, such as port=8080")
    prepare()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        try:
            return compose("study", list(overrides))
        except ConfigCompositionException as error:
            if unknown := re.search(r"Could not override '([^']+)'", str(error)):
                raise _unknown_key(unknown.group(1), list(compose("study"))) from None
            raise


def _unknown_key(key: str, known: list[Any]) -> InputError:
    near = difflib.get_close_matches(key, known, 1)
    hint = f"; did you mean {near[0]}?" if near else ""
    return InputError("argument", key, f"no such key{hint} known: {', '.join(known)}")


def fixed(cfg: DictConfig) -> dict[str, Any]:
    """The resolved keys that make the plan."""
    from omegaconf import OmegaConf

    plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    return {key: value for key, value in plain.items() if key not in NOT_OF_THE_PLAN}


@contextmanager
def one_clear_line() -> Iterator[None]:
    """Errors of the user's making become one line on stderr, exit code 2."""
    try:
        from xplain.config import report_errors

        with report_errors():
            yield
    except BrokenPipeError:
        sys.exit(1)
