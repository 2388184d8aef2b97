"""How much memory a solver's tables may take."""

from __future__ import annotations

import logging

from xplain.errors import TooLargeError

log = logging.getLogger(__name__)

GIB = 1 << 30


def check_memory(what: str, size: int, limit_gib: float, instead: str) -> None:
    """Refuses tables before they are taken, and tells of large ones.

    Args:
        what: the solver.
        size: bytes.
        limit_gib: the solver's ``memory_gib``.
        instead: what could be done.

    Raises:
        TooLargeError: more than the limit.
    """
    if size > limit_gib * GIB:
        raise TooLargeError(
            f"{what} needs {size / GIB:.2f} GiB for its tables, more than "
            f"solver.memory_gib={limit_gib:g}: {instead}"
        )
    if size > GIB / 4:
        log.info("%s takes %.2f GiB for its tables", what, size / GIB)
