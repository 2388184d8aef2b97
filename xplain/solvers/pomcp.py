"""POMCP with d-step lookahead: Monte-Carlo tree search over histories, with exact beliefs.

Silver & Veness (2010) with the paper's two changes ("POMCP with d-step lookahead"): beliefs at the
nodes are exact, and a simulation ends at depth d. At depth d, a history in the tree has QMDP's
value at its belief. A history outside the tree is added and rolled out, at any depth. Actions are
chosen by UCB1:

    search(b):  repeat
                    s ~ b; h ← root
                    while h is in the tree and above depth d:
                        a ← argmax_a V(ha) + c sqrt(log N(h) / N(ha));  h ← ha, and labels ~ s
                    R ← QMDP's value at b(h) if h was in the tree, else a rollout's return
                    add R to the means of the actions on the way

Rewards of *explain* are exact expectations under a node's belief, not the drawn labels. A rollout's
return is the value of known states minus the losses of QMDP's decisions. Both have the same means
as plain simulations, with less noise. Among untried actions of a node, QMDP's comes first, because
the others are often many and useless. A decision searches, takes the action with the best value,
and searches again after each message until that action is *explain*. So a decision that is restored
in the middle continues in the same way. If the type is certain, there is no search: its Q* is
known.

``backup="max"`` is MaxUCT (Keller & Helmert 2013): the value of a node is that of its best action,
not the mean over all tries. Exploration and first rollouts then do not affect the values; a mean
includes them for long. Histories at depth d have the mean of their rollouts, because QMDP's value
is too high, and messages reach such histories sooner than labels. So a search with enough
simulations is a step of policy improvement over QMDP, and does not lose to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b
from typing import Annotated, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Count, Positive, Range, checks
from xplain.explanation.actions import (
    EXPLAIN,
    Action,
    AskQuestion,
    GiveMessages,
    VisibleState,
    give,
)
from xplain.explanation.belief import rounded
from xplain.explanation.label_table import NONE
from xplain.explanation.problem import Problem
from xplain.numba_kernels import tell_when_compiling
from xplain.randomness import derived_seed
from xplain.solvers.base import Knowledge, Policy, best_action, check_memory, messages_of
from xplain.solvers.parts import SearchModel
from xplain.solvers.pomcp_kernel import (
    COLUMN,
    EDGE,
    ENTRY,
    LABEL,
    MOVE,
    NODE,
    ROOT,
    SETTLED,
    Options,
    Tree,
    simulate,
)
from xplain.solvers.process import (
    PATIENCE,
    KnownValues,
    Process,
    before_step,
    give_all,
    known_bytes,
    known_values,
    make_process,
)

# Positions are the kernel's numbers.
DepthUnit = Literal["steps", "actions"]
Backup = Literal["mean", "max"]
CHUNK = 50_000
"""Simulations between two checks of Ctrl-C."""
QUESTIONS = 4
"""Maximum number of questions that a search tries at a belief: the most informative ones."""
FIRST_TABLE = 1 << 12
"""Initial number of entries in the table of nodes."""
REMEMBERED = 1 << 11
"""Maximum number of observations whose likelihoods a search caches; they fit into the processor's
cache."""
CODED = 1 << 24
"""Approximate bytes of coded labels."""


@checks("solver")
@dataclass(frozen=True)
class POMCP:
    """Args:
    simulations: number of simulations in one search, which tries each action at least once; a
    decision of j messages takes j + 1 searches. depth: d ≥ 1, the end of simulations; None for the
    end of the trace. depth_unit: ``actions`` (messages and *explain*) or ``steps`` (*explain*
    alone). exploration: c of UCB1, in units of the most expensive single cost (a label 0, or a
    message). backup: ``mean`` (the paper) or ``max``. memory_gib: maximum memory of the tables and
    the tree.
    """

    simulations: Count = 6_000
    depth: Count | None = 2
    depth_unit: DepthUnit = "actions"
    exploration: Annotated[float, Range(0)] = 2.0
    backup: Backup = "max"
    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation; see :class:`xplain.solvers.base.Solver`."""
        tell_when_compiling()
        size = 2 * known_bytes(problem) + _tree_bytes(problem, self.simulations)
        check_memory("pomcp", size, self.memory_gib, "search less, or qhr plans without tables")
        process = make_process(problem)
        known, steps, messages = known_values(process), problem.n_steps, problem.n_messages
        again = 1 if problem.messages_land else steps
        options = Options(
            depth=self.depth or steps + again * messages + 1,
            message_depth=get_args(DepthUnit).index(self.depth_unit),
            exploration=float(
                self.exploration * max(problem.inexplicability_cost, process.price.max(initial=0.0))
            ),
            backup=get_args(Backup).index(self.backup),
        )
        return Search(process, search_model(process, known), options, self.simulations, seed)


@dataclass(frozen=True)
class Search:
    """A policy that searches at each decision, with a separate random stream.

    Attributes:
        process: the model.
        model, options: the model and the options in the kernel's form.
        simulations: number of simulations in a search.
        seed: seed of the run.
    """

    process: Process
    model: SearchModel
    options: Options
    simulations: int
    seed: int

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """See :class:`xplain.solvers.base.Policy`."""
        chosen = 0
        while True:
            action = best_action(self._values(visible, chosen, belief))
            if isinstance(action, AskQuestion):
                return action
            new = messages_of(action)
            if not new:
                return give(chosen)
            chosen |= new
            belief = give_all(self.process, belief, new)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Estimated return of *explain*, and of each message and question that was tried."""
        return self._values(visible, 0, belief)

    def _values(
        self, visible: VisibleState, chosen: int, belief: NDArray[np.float64]
    ) -> dict[Action, float]:
        """The values if the messages ``chosen`` were already chosen for this step."""
        tree = self.search(visible, chosen, belief)
        root, n = tree.nodes[ROOT], self.process.n_messages
        actions = [a for a in range(64) if int(root["actions"]) >> a & 1]
        edges = tree.edges[root["edges"] : root["edges"] + len(actions)]
        tried = zip(actions, edges, strict=True)
        values = {a: float(edge["value"]) for a, edge in tried if edge["visits"] > 0}
        named: dict[int, Action] = {n: EXPLAIN}
        named.update((a, GiveMessages(1 << a)) for a in range(n))
        named.update((n + 1 + i, AskQuestion(int(q))) for i, q in enumerate(tree.tried[ROOT, :-2]))
        return {named[a]: value for a, value in values.items()}

    def stream(self, visible: VisibleState, said: int, belief: NDArray[np.float64]) -> int:
        """The seed of a search. It depends on the state of the decision, not on earlier
        decisions."""
        digest = int.from_bytes(blake2b(belief.tobytes(), digest_size=8).digest(), "little")
        questions = (str(visible.asked),) if visible.asked else ()
        return derived_seed(self.seed, "pomcp", visible.step, said, digest, 0, *questions)

    def search(self, visible: VisibleState, chosen: int, belief: NDArray[np.float64]) -> Tree:
        """The tree after all simulations."""
        process, said = self.process, before_step(self.process, visible.given) | chosen
        belief = rounded(np.ascontiguousarray(belief, dtype=np.float64))
        seed = self.stream(visible, said, belief)
        budget = max(self.simulations, process.n_messages + 1 + _slots(process))
        tree = make_tree(process, budget, seed)
        tree.nodes[ROOT] = (0, np.nan, 0.0, 0.0, said, 0, 0, 0, 0, 0, 0, visible.step)
        tree.beliefs[ROOT] = belief
        tree.tried[ROOT, -2:] = -1 if chosen else 0, -1
        tree.asked[:] = [visible.asked >> q & 1 for q in range(len(tree.asked))]
        missed = None if process.jump is None else True
        asks = True if len(tree.asked) else None
        roots = _roots(1 << budget.bit_length())
        for done in range(0, budget, CHUNK):
            count = min(budget - done, CHUNK)
            simulate(count, self.model, tree, self.options, missed, asks, *roots)
        return tree


def search_model(process: Process, known: KnownValues, searches: bool = True) -> SearchModel:
    """Makes the kernels' form of a process.

    Args:
        process, known: the model, and its values.
        searches: True adds ``wanted``, which simulations need.
    """
    lands = process.jump is None
    nothing, questions = np.zeros(0), process.questions
    jump = np.zeros((0, 0), np.int64) if process.jump is None else process.jump
    forget = np.zeros(process.n_types) if process.forget is None else process.forget
    return SearchModel(
        process.answered,
        process.explain_cost,
        known.explain,
        process.cells.stride,
        known.value,
        known.value_cells.stride,
        _wanted(process, known) if lands and searches else np.zeros((0, 0), np.int64),
        process.relevant | questions.relevant,
        jump,
        nothing if process.accept is None else process.accept,
        forget,
        process.price,
        questions.answered,
        questions.likelier,
        questions.cells.stride,
        process.discount,
        process.message_discount,
        questions.cost,
        questions.most,
        questions.first,
        0.0 if lands else PATIENCE,
    )


def _wanted(process: Process, known: KnownValues) -> NDArray[np.int64]:
    """``wanted`` of :class:`~xplain.solvers.parts.SearchModel`, if messages land."""
    steps, types = process.n_steps, process.n_types
    wanted = np.zeros(known.explain.shape, np.int64)
    for bit, own in enumerate(process.own.T):
        shape = steps, -1, 2, 1 << bit, types
        value, explain, found = (
            table.reshape(shape) for table in (known.value[:-1], known.explain, wanted)
        )
        price = np.where(own == NONE, np.inf, process.price[own])
        given = process.message_discount * value[:, :, 1] - price
        found[:, :, 0] |= np.where(given > explain[:, :, 0], 1 << np.maximum(own, 0), 0)
    later = np.logical_or.accumulate(wanted[::-1] != 0, axis=0)[::-1]
    wanted[~later] = SETTLED
    return wanted


def _slots(process: Process) -> int:
    """Number of questions that a search tries at a belief, at most the bits of a mask."""
    return min(QUESTIONS, len(process.questions.answered), 61 - process.n_messages)


def make_tree(process: Process, simulations: int, seed: int) -> Tree:
    """An empty tree with memory for this number of simulations. Unused memory is never written."""
    n, steps, states = process.n_messages, process.n_steps, process.n_states
    slots, questions = _slots(process), len(process.questions.answered)
    size, actions, entries = simulations + 1, n + 1 + slots, _entries(simulations)
    remembered = min(entries, REMEMBERED)
    sets = 1 if process.jump is not None else _coded(n, steps, states)
    return Tree(
        np.empty(size, NODE),
        np.empty((size + 1) * actions, EDGE),
        np.empty((size, states)),
        np.zeros(entries, ENTRY),
        np.zeros(remembered, np.uint64),
        np.empty((remembered, states)),
        np.full(sets, -1, np.int64),
        np.empty((sets, steps), LABEL),
        np.empty((sets, steps, states), COLUMN),
        np.empty((n + 1) * steps + 1 + questions, MOVE),
        np.empty(steps, np.bool_),
        np.empty(states),
        np.empty(states, np.int64),
        np.zeros(n),
        np.empty((size if slots else 1, slots + 2), np.int32),
        np.empty(questions, np.bool_),
        np.empty(questions),
        np.array([1, actions, FIRST_TABLE - 1]),
        np.array([seed], np.uint64),
    )


@lru_cache(maxsize=4)
def _roots(size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """sqrt(log v) and 1 / sqrt(v) for v = 0 … size (0 for 0), cached by size."""
    v = np.maximum(np.arange(size + 1), 1)
    inverse = 1 / np.sqrt(v)
    inverse[0] = 0.0
    return np.sqrt(np.log(v)), inverse


def _entries(simulations: int) -> int:
    return max(FIRST_TABLE, 1 << (2 * simulations + 2).bit_length())


def _coded(messages: int, steps: int, states: int) -> int:
    """Number of cached coded message sets: a power of two."""
    each = steps * (COLUMN.itemsize * states + LABEL.itemsize)
    return 1 << min(max(CODED // each, 16).bit_length() - 1, 12, messages)


def _tree_bytes(problem: Problem, simulations: int) -> int:
    """Maximum bytes of a tree."""
    states, n, steps = problem.start.size, problem.n_messages, problem.n_steps
    node = NODE.itemsize + 8 * (states + 1) + EDGE.itemsize * (n + 1 + QUESTIONS) + 4 * QUESTIONS
    entries, sets = _entries(simulations), _coded(n, steps, states)
    coded = sets * steps * (COLUMN.itemsize * states + LABEL.itemsize)
    remembered = min(entries, REMEMBERED) * 8 * (states + 1)
    return (simulations + 2) * node + ENTRY.itemsize * entries + remembered + coded
