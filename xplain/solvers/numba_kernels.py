"""How kernels are compiled, and telling the user: it takes seconds, once; later runs load them."""

from __future__ import annotations

import logging
from functools import cache

from numba import njit
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


inlined = njit(forceinline=True, _nrt=False)
"""Decorates what a hot kernel is made of. Numba counts references to arrays at every call, and
passes them by value, seven words each: in kernels of many arrays this took most of the time. So
everything is inlined into one function that allocates nothing, and nothing is counted (``_nrt``).
What such a function calls must be decorated so too. Numba's cache knows the file of the outermost
function only: after a change in another, touch that file.
"""
