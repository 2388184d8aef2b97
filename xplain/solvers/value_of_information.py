"""What a question is worth to a policy that never asks for an answer's sake: value of information.

    VOI(q) = Σ_y P(y | b) V(b_y) − V(b) − κ

(Howard 1966; one question ahead, "myopic"). V is not QMDP's bound, in which the type becomes known
for nothing, but what QMDP's own decisions earn from a belief: their return by simulation, for
each type that a user may be of, with the same random numbers for all beliefs. Where labels are
certain one simulation a type is exact.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.asking import NO_QUESTION
from xplain.explanation.message_sets import compress
from xplain.explanation.problem import Problem
from xplain.numba_kernels import inlined, lean_kernel
from xplain.randomness import derived_seed
from xplain.solvers.base import TIE, Policy
from xplain.solvers.count_lattice import copy
from xplain.solvers.inquiry import Inquiry, Room, hear_answer, make_room, open_questions
from xplain.solvers.knowing import Knowing, expected_loss, make_knowing
from xplain.solvers.memory import check_memory
from xplain.solvers.pomcp.rollout import roll_qmdp
from xplain.solvers.pomcp.search_model import CodedRooms, model_bytes, model_of
from xplain.solvers.pomcp.tree import SearchRoot, Tree
from xplain.solvers.reminding import Reminding
from xplain.solvers.restriction import restricted

LOOKED_INTO = 12
"""Questions whose worth a decision looks into: the most telling."""
ROLLS = 40
"""Simulations from a belief, spread evenly over its types; one a type at least."""
FAINT = 1e-6
"""A type less likely than this is not simulated."""
SPREAD = np.uint64(0xD1342543DE82EF95)
"""Between the streams of two simulations."""


def asks_by_value(policy: Policy, problem: Problem, seed: int, memory_gib: float = 8.0) -> Policy:
    """The policy, which asks where the problem has questions.

    Raises:
        TooLargeError: tables to simulate with would take more than ``memory_gib``.
    """
    if problem.questions is None:
        return policy
    stream = derived_seed(seed, "value of information")
    if problem.tracks_knowledge:
        known = policy if isinstance(policy, Reminding) else Reminding(problem)
        return Inquiring(policy, SimulatedKnowing(make_knowing(known), stream))
    small, kept = restricted(problem)
    check_memory("asking", model_bytes(small), memory_gib, "ask=never needs no such tables")
    return Inquiring(policy, Simulated(CodedRooms(model_of(small)), kept, stream))


@dataclass(frozen=True)
class Simulated:
    """What QMDP's decisions earn.

    Attributes:
        rooms: the model of the restricted problem, for each call at the same time.
        kept: its messages.
        stream: of the simulations.
    """

    rooms: CodedRooms
    kept: tuple[int, ...]
    stream: int

    @property
    def inquiry(self) -> Inquiry:
        """The problem's questions."""
        return self.rooms.model.reduced.inquiry

    @cached_property
    def _rolls(self) -> int:
        """One a type where answers are certain: what happens to it then is no chance."""
        return ROLLS if (self.rooms.model.reduced.answered % 1).any() else 1

    def gains(self, step: int, given: int, belief: NDArray[np.float64], asked: int) -> Room:
        """``found`` [count] the questions looked into, and ``news`` what each is worth."""
        room, after = make_room(self.inquiry, asked, LOOKED_INTO), np.empty_like(belief)
        steps, root = self.rooms.model.reduced.n_steps, SearchRoot(0, 0, np.zeros(len(belief)))
        tree = Tree.rooted(1, len(self.kept), steps, root, 0)
        given, sure = compress(given, self.kept), np.ascontiguousarray(belief)
        with self.rooms.borrow() as model:
            where = model, tree, step, given, sure
            count = _look(*where, after, room, self._rolls, self.stream)
        return room._replace(found=room.found[:count], news=room.news[:count])


@dataclass(frozen=True)
class SimulatedKnowing:
    """The same where messages may be missed or forgotten.

    Attributes:
        model: as kernels want it.
        stream: of the simulations.
    """

    model: Knowing
    stream: int

    def gains(self, step: int, given: int, belief: NDArray[np.float64], asked: int) -> Room:
        """As :meth:`Simulated.gains`."""
        room = make_room(self.model.inquiry, asked, LOOKED_INTO // 2)
        after, path = np.empty((2, len(belief)))
        labels = np.empty(len(self.model.explain), np.bool_)
        counter, sure = np.zeros(1, np.uint64), np.ascontiguousarray(belief)
        where, spaces = (self.model, counter, step, given), (after, path, labels, room)
        count = _look_knowing(*where, sure, *spaces, ROLLS // 2, self.stream)
        return room._replace(found=room.found[:count], news=room.news[:count])


@dataclass(frozen=True)
class Inquiring:
    """Asks the question that is worth the most, while one is worth anything.

    Attributes:
        policy: decides on messages.
        simulated: the worth of questions.
    """

    policy: Policy
    simulated: Simulated | SimulatedKnowing

    def question(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """As :class:`xplain.solvers.base.Asks` says."""
        looked = self.simulated.gains(step, given, belief, asked)
        if not looked.news.size or looked.news.max() <= TIE:
            return NO_QUESTION
        return int(looked.found[looked.news.argmax()])

    def messages(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """As :class:`xplain.solvers.base.Asks` says."""
        return self.policy.messages(step, given, belief)

    def values(
        self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0
    ) -> Mapping[int, float]:
        """Of messages what the policy says; of a question, that of the best of these and what it
        is worth."""
        values = dict(self.policy.values(step, given, belief))
        best = max(values.values(), default=0.0)
        looked = self.simulated.gains(step, given, belief, asked)
        pairs = zip(looked.found.tolist(), looked.news.tolist(), strict=True)
        return values | {~q: best + gain for q, gain in pairs}


@lean_kernel
def _look(model, tree, step, given, belief, after, room, rolls, seed):  # type: ignore[no-untyped-def]
    """Finds questions, and fills ``room.news`` with what they are worth. Returns how many."""
    inquiry = model.reduced.inquiry
    count = open_questions(inquiry, step, given, belief, room)
    if count == 0:
        return 0
    now = _earned(model, tree, step, given, belief, rolls, seed)
    for i in range(count):
        value, q = -inquiry.cost, room.found[i]
        for answer in range(2):
            copy(belief, after)
            total = hear_answer(inquiry, q, given, answer, after)
            if total > 0.0:
                value += total * _earned(model, tree, step, given, after, rolls, seed)
        room.news[i] = value - now
    return count


@inlined
def _earned(model, tree, step, given, belief, rolls, seed):  # type: ignore[no-untyped-def]
    """QMDP's mean return from a belief."""
    types = 0
    for t in range(len(belief)):
        types += belief[t] > FAINT
    each, total = max(1, rolls // types), 0.0
    for t in range(len(belief)):
        if belief[t] > FAINT:
            for i in range(each):
                tree.counter[0] = seed + np.uint64(t * rolls + i) * SPREAD
                total += belief[t] / each * roll_qmdp(model, tree, step, given, t, belief)
    return total


@lean_kernel
def _look_knowing(model, counter, step, given, belief, after, path, labels, room, rolls, seed):  # type: ignore[no-untyped-def]
    """Finds questions, and fills ``room.news`` with what they are worth. Returns how many.

    ``after`` and ``path`` are [S], ``labels`` is [m], to work in.
    """
    count = open_questions(model.inquiry, step, 0, belief, room)
    if count == 0:
        return 0
    now = _mean_loss(model, counter, step, given, belief, path, labels, rolls, seed)
    for i in range(count):
        worth = now - model.inquiry.cost
        for answer in range(2):
            copy(belief, after)
            share = hear_answer(model.inquiry, room.found[i], 0, answer, after)
            if share > 0.0:
                loss = _mean_loss(model, counter, step, given, after, path, labels, rolls, seed)
                worth -= share * loss
        room.news[i] = worth
    return count


@inlined
def _mean_loss(model, counter, step, given, belief, path, labels, rolls, seed):  # type: ignore[no-untyped-def]
    """Over users spread evenly over the belief, with the same random numbers for each belief."""
    total, done, state = 0.0, 0.0, 0
    for i in range(rolls):
        while state < len(belief) - 1 and done + belief[state] <= (i + 0.5) / rolls:
            done += belief[state]
            state += 1
        counter[0] = seed + np.uint64(i) * SPREAD
        copy(belief, path)
        total += expected_loss(model, counter, step, given, state, path, labels)
    return total / rolls
