"""Which step of a task the practice shows to those who judge step by step.

It looks odd: on the map it leads away from where the task ends. It is right because of what comes
later: something is to be done elsewhere before the end, and the step is on a shortest way to it.
And it tells nothing of what people are asked about: all of this way is optimal whatever facts
somebody holds wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Domain
from xplain.people.plan import Ahead

N = TypeVar("N", bound=Hashable)


def ahead_of(
    domain: Domain,
    states: NDArray[np.int64],
    labels: NDArray[np.uint8],
    sentence: Callable[[int], str],
) -> Ahead | None:
    """The odd step from a start of the task whose reason comes last, with the way up to there; ties
    by the order of the states. None where there is no map, or no such step, also because the map
    does not tell where the robot begins from what else may be so.

    Args:
        domain: the task.
        states: [T, 2] where each transition that the robot can make starts and ends.
        labels: [C, T] 1 where a transition makes sense to who holds the c-th set of facts wrong.
        sentence: says what the robot does in one of them.
    """
    model = domain.model({one.name: one.accurate for one in domain.parameters})
    cells = [cell for s in range(model.n_states) if (cell := domain.position(s)) is not None]
    if domain.scene is None or len(cells) < model.n_states:
        return None
    s, a, k = np.nonzero(model.probability > 0)
    moves = set(zip(s.tolist(), model.successor[s, a, k].tolist(), strict=True))
    beside = {(cells[one], cells[other]) for one, other in moves}
    row = {(one, other): t for t, (one, other) in enumerate(states.tolist()) if labels[:, t].all()}
    begins = [cells[start] for start in domain.starts.tolist()]
    best: list[tuple[int, int]] = []
    for start in sorted(s for s in domain.starts.tolist() if begins.count(cells[s]) == 1):
        later = _distances([pair[::-1] for pair in states.tolist()], [start])
        goals = {cells[state] for state in later if model.terminal[state]}
        if len(goals) != 1:
            continue  # no one place to lead away from
        ends = [s for s in np.flatnonzero(model.terminal).tolist() if cells[s] in goals]
        left, far = _distances(moves, ends), _distances(beside, goals)
        # Moves to the end that are more than the way there: something is to be done before.
        detour = {s: left[s] - far[cells[s]] for s in later if not model.terminal[s]}
        done = [s for s in detour if detour[s] == min(detour.values())]
        nearer = [(one, other) for one, other in row if left[other] < left[one]]
        ahead = _distances(nearer, done)
        for one, here in nearer:
            if one == start and far[cells[here]] > far[cells[start]] and ahead.get(here):
                best = max(best, [(start, here), *_way(nearer, ahead, here)], key=len)
    way = tuple((cells[one], cells[other]) for one, other in best)
    return Ahead(tuple(sentence(row[move]) for move in best), way) if best else None


def _way(moves: Sequence[tuple[N, N]], far: Mapping[N, int], here: N) -> Iterator[tuple[N, N]]:
    """The moves from a place to the nearest goal, whose distances are known."""
    while steps := far[here]:
        move = next((a, b) for a, b in moves if a == here and far.get(b) == steps - 1)
        yield move
        here = move[1]


def _distances(moves: Iterable[tuple[N, N]], goals: Iterable[N]) -> Mapping[N, int]:
    """The least number of moves to a goal, from each place that one can be reached from."""
    before: dict[N, list[N]] = {}
    for one, other in moves:
        before.setdefault(other, []).append(one)
    far, new, steps = dict[N, int](), set(goals), 0
    while new:
        far |= dict.fromkeys(new, steps)
        steps += 1
        new = {one for place in new for one in before.get(place, []) if one not in far}
    return far
