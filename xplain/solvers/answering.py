"""What users may answer, where messages may be missed or forgotten: the beliefs that follow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.errors import TooLargeError
from xplain.explanation import knowledge
from xplain.explanation.problem import Problem
from xplain.numba_kernels import lean_kernel
from xplain.solvers.count_lattice import Branches, branch, make_answers
from xplain.solvers.rows import Rows

MAX_SETS = 10
"""Messages whose sets are weighed together, at most."""


def check_sets(what: str, kept: Sequence[int]) -> None:
    """Raises TooLargeError: more than MAX_SETS messages matter to a solver."""
    if len(kept) > MAX_SETS:
        raise TooLargeError(
            f"{what} weighs sets of messages together: {len(kept)} matter on this trace, "
            f"at most {MAX_SETS}; solver=qmdp or pomcp says one after the other"
        )


class Lattice(NamedTuple):
    """What :func:`~xplain.solvers.count_lattice.branch` reads: states in the place of types."""

    answered: NDArray[np.float64]
    rows: Rows


@lean_kernel
def _answers(lattice, step, weight, evidence, negligible, found):  # type: ignore[no-untyped-def]
    return branch(lattice, step, 0, weight, evidence, negligible, found)


class Answering:
    """Of a problem that tracks what users know: S states, of knowledge and type."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        steps, states = problem.n_steps, problem.start.size
        none = np.zeros((0, 0), np.int64)
        rows = Rows(
            np.zeros(states, np.int64),
            none,
            np.zeros((1, 1, states), np.int64),
            *(0, np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 0, 0))),
        )
        answered = np.ascontiguousarray(problem.table.answered.reshape(steps, 1, states))
        self._lattice = Lattice(answered, rows)
        self._room: Branches = make_answers(1 << 10, steps, states)

    def after(
        self, step: int, belief: NDArray[np.float64], negligible: float, most: int | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """What follows the distinguishable answers to *explain* at k: joint probabilities [B, S] of
        an answer and the state at the next step, and [S] of all answers less likely than
        ``negligible``. None where they are more than ``most``."""
        evidence = np.zeros(len(belief), np.int64)
        found = -1
        while found < 0:
            found = _answers(self._lattice, step, belief, evidence, negligible, self._room)
            capacity = len(self._room.weight)
            if most is not None and (found > most or (found < 0 and capacity >= most)):
                return None
            if found < 0:
                self._room = make_answers(2 * capacity, self.problem.n_steps, len(belief))
        weights = kept_of(self.problem, self._room.weight[:found])
        return weights, kept_of(self.problem, self._room.tail)

    def to_question(self, q: int, belief: NDArray[np.float64]) -> Iterator[tuple[int, float]]:
        """The answers 1 and 0 that are possible, and how likely each is."""
        assert self.problem.questions is not None
        yes = self.problem.questions.table.answered[q].ravel()
        for answer, p in ((1, yes), (0, 1 - yes)):
            share = float(belief @ p)
            if share > 0:
                yield answer, share


def every_told(
    problem: Problem, belief: NDArray[np.float64], messages: list[int]
) -> NDArray[np.float64]:
    """[2^n, S] a belief after each set of n messages, as
    :func:`~xplain.explanation.message_sets.subsets` lists them."""
    heard = belief.reshape(-1, problem.n_types)
    for i, j in enumerate(messages):
        relevant = np.tile(problem.table.relevant, (1 << i, 1))
        accept = np.tile(problem.accept, 1 << i)
        heard = np.concatenate([heard, knowledge.say(heard, relevant, j, accept)], axis=1)
    return _listed(problem, heard)


def kept_of(problem: Problem, belief: NDArray[np.float64]) -> NDArray[np.float64]:
    """[..., S] what is left of what is known after a step."""
    rows, types = problem.table.p.shape[1:]
    flat = belief.reshape(-1, rows, types).transpose(1, 0, 2).reshape(rows, -1)
    lose = np.tile(problem.forget, flat.shape[1] // types)
    left = knowledge.forget(flat, problem.table.relevant, lose)
    return _listed(problem, left).reshape(belief.shape)


def _listed(problem: Problem, side_by_side: NDArray[np.float64]) -> NDArray[np.float64]:
    """[B, S] of beliefs [rows, B · N]."""
    rows, types = problem.table.p.shape[1:]
    return side_by_side.reshape(rows, -1, types).transpose(1, 0, 2).reshape(-1, rows * types)
