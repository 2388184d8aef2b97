"""Independent searches from one start, merged at the root."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from hashlib import blake2b
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.belief import rounded
from xplain.randomness import derived_seed
from xplain.solvers.inquiry import Inquiry, look, make_room
from xplain.solvers.pomcp.tree import SearchRoot, Tree

CHUNK = 50_000
"""Simulations between two looks at Ctrl-C."""

Roots = tuple[NDArray[np.float64], NDArray[np.float64]]
Run = Callable[[int, Tree, Roots], None]
"""Runs so many simulations in a tree."""


class Forest(NamedTuple):
    """How to search.

    Attributes:
        simulations: together.
        trees: that share them.
        threads: that search the trees.
        steps, messages: of the problem.
        slots: questions tried at a belief, of
        inquiry: the problem's.
        seed: of the run.
    """

    simulations: int
    trees: int
    threads: int
    steps: int
    messages: int
    slots: int
    inquiry: Inquiry
    seed: int

    def values(self, start: SearchRoot, runs: Callable[[], Run]) -> dict[int, float]:
        """Estimated return of *explain* (0), of each message (its bit) and question (~q), where it
        was tried. ``runs`` makes what a thread runs simulations with."""
        value, visits = self.merged(start, runs)
        room = make_room(self.inquiry, start.asked, self.slots)
        if self.slots:
            look(self.inquiry, start.step, start.given, _exact(start.belief), room)
        n = self.messages
        names = [1 << j for j in range(n)] + [0] + [~q for q in room.found.tolist()]
        order = [n, *range(n), *range(n + 1, len(value))]
        return {names[a]: float(value[a]) for a in order if visits[a]}

    def merged(
        self, start: SearchRoot, runs: Callable[[], Run]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Value and visits of each action at the root, merged over the trees: [n + 1 + B] each,
        messages, *explain*, then the most telling questions. The random stream comes from what is
        to be decided, not from what was decided before."""
        start = start._replace(belief=_exact(start.belief))
        digest = int.from_bytes(blake2b(start.belief.tobytes(), digest_size=8).digest(), "little")
        heard = (str(start.asked),) if start.asked or start.before else ()
        said = (str(start.before),) if start.before else ()
        whole, rest = divmod(self.simulations, self.trees)
        stop = threading.Event()

        def grow(number: int) -> NDArray[Any]:
            budget = whole + (number < rest)
            names = "pomcp", start.step, start.given, digest, number, *heard, *said
            tree = Tree.rooted(
                budget,
                self.messages,
                self.steps,
                start,
                derived_seed(self.seed, *names),
                make_room(self.inquiry, start.asked, self.slots),
            )
            roots, run = make_roots(1 << budget.bit_length()), runs()
            while budget > 0 and not stop.is_set():
                run(min(budget, CHUNK), tree, roots)
                budget -= CHUNK
            return tree.root_edges()

        numbers = range(self.trees)
        if self.threads == 1 or self.trees == 1:
            edges = np.stack([grow(number) for number in numbers])
        else:
            with ThreadPoolExecutor(self.threads) as pool:
                try:
                    edges = np.stack(list(pool.map(grow, numbers)))
                except BaseException:
                    stop.set()  # Ctrl-C: the threads end with their present chunk
                    raise
        visits = edges["visits"].astype(np.int64)
        weighted = np.where(visits > 0, edges["value"], 0.0) * visits
        return weighted.sum(axis=0) / np.maximum(visits.sum(axis=0), 1), visits.sum(axis=0)


def _exact(belief: NDArray[np.float64]) -> NDArray[np.float64]:
    return rounded(np.ascontiguousarray(belief, dtype=np.float64))


@lru_cache(maxsize=4)
def make_roots(size: int) -> Roots:
    """sqrt(log v) and 1 / sqrt(v) for v = 0 … size (0 for 0), once a size."""
    v = np.maximum(np.arange(size + 1), 1)
    inverse = 1 / np.sqrt(v)
    inverse[0] = 0.0
    return np.sqrt(np.log(v)), inverse
