"""POMCP with d-step lookahead: Monte-Carlo tree search over histories, with exact beliefs.

Silver & Veness (2010) with the paper's two changes ("POMCP with d-step lookahead"): beliefs at the
nodes are exact, and a simulation ends at depth d. With ``backup="mean"`` (the paper), a history in
the tree at depth d has QMDP's value at its belief. A history outside the tree is added and rolled
out, at any depth. Actions are chosen by UCB1:

    search(b):  repeat
                    s ~ b; h ← root
                    while h is in the tree and above depth d:
                        a ← argmax_a V(ha) + c sqrt(log N(h) / N(ha));  h ← ha, and labels ~ s
                    R ← QMDP's value at b(h) if h was in the tree, else a rollout's return
                    add R to the means of the actions on the way

Rewards of *explain* are exact expectations under a node's belief, not the drawn labels. A rollout's
return is the value of known states minus the losses of QMDP's decisions. Both have the same means
as plain simulations, with less noise. Among a node's untried actions, QMDP's action comes first,
because the other actions are often many and useless. A decision searches, takes the action with the
best value, and searches again after each message until that action is *explain*. So a decision that
is restored in the middle continues in the same way.

``backup="max"`` (the default) is MaxUCT (Keller & Helmert 2013): the value of a node is the value
of its best action, not the mean over all tries. So exploration and first rollouts do not affect the
values; in a mean, their returns remain for many simulations. A history at depth d has the mean
return of its rollouts, not QMDP's value. QMDP's value is too high, and if messages count as depth,
it would favour paths with many messages. Rollouts follow QMDP's decisions. So a search with enough
simulations is a step of policy improvement over QMDP, and is not worse than QMDP. If messages may
be missed, QMDP's value replaces all rollouts, which would take too long.
"""

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
from xplain.explanation.belief import round_belief
from xplain.explanation.label_table import NONE
from xplain.explanation.problem import Problem
from xplain.randomness import derive_seed
from xplain.solvers.base import Knowledge, Policy, best_action, check_memory, messages_of
from xplain.solvers.pomcp_kernel import (
    COLUMN,
    EDGE,
    ENTRY,
    LABEL,
    MOVE,
    NODE,
    ROOT,
    SETTLED,
    LabelCodes,
    Memory,
    Options,
    Scratch,
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
from xplain.solvers.search_model import SearchModel

# The position of each word is its number in the kernel.
DepthUnit = Literal["steps", "actions"]
Backup = Literal["mean", "max"]
CHUNK = 50_000
"""The number of simulations between two checks for Ctrl-C."""
QUESTIONS = 4
"""The largest number of questions that a search tries at a belief: the most informative ones."""
FIRST_TABLE = 1 << 12
"""The size of the hash table of nodes at the start of a search."""
REMEMBERED = 1 << 11
"""The largest number of observations whose likelihoods a search keeps: this number fits into the
processor's cache."""
CODED = 1 << 24
"""The approximate memory for coded labels, in bytes."""


@checks("solver")
@dataclass(frozen=True)
class POMCP:
    """Plans with POMCP.

    Args:
        simulations: the number of simulations of one search, which tries each action at least once.
            A decision of j messages takes j + 1 searches.
        depth: the depth d ≥ 1 at which simulations end; None for the end of the trace.
        depth_unit: what counts as depth: ``actions`` (messages and *explain*) or ``steps``
            (*explain*).
        exploration: the constant c of UCB1, in units of the largest single cost (a label 0 or a
            message).
        backup: the value of a node: ``mean`` (the paper) or ``max``.
        memory_gib: the limit for tables and the tree.
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
        size = 2 * known_bytes(problem) + _estimate_bytes(problem, self.simulations)
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
    """A policy that runs a search for each decision. Each search has its own random stream.

    Attributes:
        process: the model.
        model: the model in the kernel's layout.
        options: the settings of the kernel.
        simulations: the number of simulations of a search.
        seed: the seed of the run.
    """

    process: Process
    model: SearchModel
    options: Options
    simulations: int
    seed: int

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """Searches until *explain* or a question is best, and once more after each message. If
        *explain* is the only action, there is no search."""
        chosen = 0
        while self._has_choice(visible, chosen, belief):
            action = best_action(self._compute_values(visible, chosen, belief))
            if isinstance(action, AskQuestion):
                return action
            new = messages_of(action)
            if not new:
                break
            chosen |= new
            belief = give_all(self.process, belief, new)
        return give(chosen)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Returns the estimated returns of *explain*, and of each message and question that was
        tried."""
        return self._compute_values(visible, 0, belief)

    def _has_choice(self, visible: VisibleState, chosen: int, belief: NDArray[np.float64]) -> bool:
        """True if there may be questions, or a message that was not given has an effect on a
        possible state."""
        useful = np.bitwise_or.reduce(self.model.relevant[round_belief(belief) > 0])
        said = before_step(self.process, visible.given) | chosen
        return len(self.process.questions.answered) > 0 or bool(useful & ~said)

    def _compute_values(
        self, visible: VisibleState, chosen: int, belief: NDArray[np.float64]
    ) -> dict[Action, float]:
        """Runs a search that starts after the messages ``chosen`` (a bitmask) are chosen for this
        step. Returns the values of the next actions that the search tried."""
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
        """Derives the seed of a search from the visible state and the belief, not from earlier
        decisions."""
        digest = int.from_bytes(blake2b(belief.tobytes(), digest_size=8).digest(), "little")
        questions = (str(visible.asked),) if visible.asked else ()
        return derive_seed(self.seed, "pomcp", visible.step, said, digest, 0, *questions)

    def search(self, visible: VisibleState, chosen: int, belief: NDArray[np.float64]) -> Tree:
        """Runs all simulations of a search; returns its tree."""
        process, said = self.process, before_step(self.process, visible.given) | chosen
        belief = round_belief(np.ascontiguousarray(belief, dtype=np.float64))
        seed = self.stream(visible, said, belief)
        budget = max(self.simulations, process.n_messages + 1 + _count_slots(process))
        memory = make_memory(process, budget, seed)
        tree, _, scratch = memory
        tree.nodes[ROOT] = (0, np.nan, 0.0, 0.0, said, 0, 0, 0, 0, 0, 0, visible.step)
        tree.beliefs[ROOT] = belief
        tree.tried[ROOT, -2] = -1 if chosen else 0
        scratch.asked[:] = [visible.asked >> q & 1 for q in range(len(scratch.asked))]
        missed = None if process.jump is None else True
        roots = _compute_roots(1 << budget.bit_length())
        for done in range(0, budget, CHUNK):
            count = min(budget - done, CHUNK)
            simulate(count, self.model, memory, self.options, missed, *roots)
        return tree


def search_model(process: Process, known: KnownValues, searches: bool = True) -> SearchModel:
    """Converts a process to the arrays that kernels read.

    Args:
        process, known: the model, and its values.
        searches: True if POMCP reads the result; POMCP needs ``wanted``.
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
        _find_wanted(process, known) if lands and searches else np.zeros((0, 0), np.int64),
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


def _find_wanted(process: Process, known: KnownValues) -> NDArray[np.int64]:
    """Computes the attribute ``wanted`` of :class:`~xplain.solvers.search_model.SearchModel`.
    Messages must always correct the fact."""
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


def _count_slots(process: Process) -> int:
    """Returns the maximum number of questions that a search tries at a node. It is limited because
    a 64-bit integer has a bit for each message, for *explain* and for each of these questions."""
    return min(QUESTIONS, len(process.questions.answered), max(61 - process.n_messages, 0))


def make_memory(process: Process, simulations: int, seed: int) -> Memory:
    """Allocates the memory for this number of simulations; the caller adds the root. The operating
    system provides the memory only when a simulation uses it."""
    n, steps, states = process.n_messages, process.n_steps, process.n_states
    slots, questions = _count_slots(process), len(process.questions.answered)
    size, actions, entries = simulations + 1, n + 1 + slots, _count_entries(simulations)
    remembered = min(entries, REMEMBERED)
    sets = 1 if process.jump is not None else _count_coded(n, steps, states)
    tree = Tree(
        np.empty(size, NODE),
        np.empty((size + 1) * actions, EDGE),
        np.empty((size, states)),
        np.zeros(entries, ENTRY),
        np.empty((size if questions else 1, slots + 2), np.int32),
        np.empty((n + 1) * steps + 1 + questions, MOVE),
        np.array([1, actions, FIRST_TABLE - 1]),
    )
    codes = LabelCodes(
        np.zeros(remembered, np.uint64),
        np.empty((remembered, states)),
        np.full(sets, -1, np.int64),
        np.empty((sets, steps), LABEL),
        np.empty((sets, steps, states), COLUMN),
        np.empty(steps, np.bool_),
    )
    scratch = Scratch(
        np.empty(states),
        np.empty(states, np.int64),
        np.zeros(n),
        np.empty(questions, np.bool_),
        np.empty(questions),
        np.array([seed], np.uint64),
    )
    return tree, codes, scratch


@lru_cache(maxsize=4)
def _compute_roots(size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns sqrt(log v) and 1 / sqrt(v) for v = 0 … size (0 for v = 0)."""
    v = np.maximum(np.arange(size + 1), 1)
    inverse = 1 / np.sqrt(v)
    inverse[0] = 0.0
    return np.sqrt(np.log(v)), inverse


def _count_entries(simulations: int) -> int:
    return max(FIRST_TABLE, 1 << (2 * simulations + 2).bit_length())


def _count_coded(messages: int, steps: int, states: int) -> int:
    """Returns the number of message sets for which the codes of labels are stored at the same
    time: a power of two."""
    each = steps * (COLUMN.itemsize * states + LABEL.itemsize)
    return 1 << min(max(CODED // each, 16).bit_length() - 1, 12, messages)


def _estimate_bytes(problem: Problem, simulations: int) -> int:
    """Returns the largest memory that a tree can take, in bytes."""
    states, n, steps = problem.start.size, problem.n_messages, problem.n_steps
    node = NODE.itemsize + 8 * (states + 1) + EDGE.itemsize * (n + 1 + QUESTIONS) + 4 * QUESTIONS
    entries, sets = _count_entries(simulations), _count_coded(n, steps, states)
    coded = sets * steps * (COLUMN.itemsize * states + LABEL.itemsize)
    remembered = min(entries, REMEMBERED) * 8 * (states + 1)
    return (simulations + 2) * node + ENTRY.itemsize * entries + remembered + coded
