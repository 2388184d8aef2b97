"""Tells the user when a kernel is compiled: it takes seconds, once; later runs load it."""

from __future__ import annotations

import logging
from functools import cache

from numba.core import event

log = logging.getLogger(__name__)


class _Listener(event.Listener):  # type: ignore[misc]
    """Speaks at the first kernel of ours that numba did not find in its cache."""

    told = False

    def on_start(self, event: event.Event) -> None:
        kernel = event.data["dispatcher"].py_func
        if not self.told and kernel.__module__.startswith("xplain."):
            self.told = True
            log.warning("compiling the solvers' kernels, once (seconds; later runs load them)")

    def on_end(self, event: event.Event) -> None:
        pass


@cache
def tell_when_compiling() -> None:
    """From now on, one line is logged in this process when a kernel has to be compiled."""
    event.register("numba:compile", _Listener())
