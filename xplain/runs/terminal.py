"""What a run says, apart from what it saves: neither may cost the other."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from xplain.errors import first_line

log = logging.getLogger(__name__)


@contextmanager
def attempted(otherwise: str) -> Iterator[None]:
    """What follows the saved results: where it fails, a line says what is missing.

    Args:
        otherwise: what is missing then.
    """
    try:
        yield
    except (BrokenPipeError, SystemExit) as error:  # rich makes the second of the first
        if not isinstance(error.__context__ or error, BrokenPipeError):
            raise
        log.warning("%s: nobody reads the output any more (closed pipe)", otherwise)
        # Python writes what is left in the buffer when it ends.
        with suppress(OSError, ValueError, AttributeError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except Exception as error:
        log.warning("%s: %s", otherwise, first_line(error)[:300])
        log.debug("it failed", exc_info=True)


def without_passwords(text: str) -> str:
    """The text, without user name and password in the addresses that it holds."""
    return re.sub(r"://[^/@\s'\"]+@", "://***@", text)
