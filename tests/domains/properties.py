"""Properties that make a domain with its types a real task: the number of different traces, the
share of transitions that depend on a fact, and the differences between explanation problems
(docs/domains.md).

They are computed from the domain, its types and their true labels, without a learner or a solver.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain import Domain, Setting
from xplain.learning.data.queries import sample_trace

LARGEST_TRADE_OFF = 2.5
"""The values of λ in the paper's table."""
MAX_LENGTH = 40
"""Maximum number of transitions of a trace."""
Trace = NDArray[np.int64]


@dataclass(frozen=True)
class Problems:
    """Properties of the explanation problems of some traces.

    Attributes:
        smallest: [traces, types] size of the smallest message set after which all
            transitions are explicable.
        worth: [traces, types] True if this set costs less than silence at every λ ≤ 2.5 (Definition
            2, C_e = C_inexp = 1).
        tables: number of distinct label tables, without transitions that are explicable to
            all types after all messages: traces with the same table are the same problem.
        commonest: share of the traces with the most frequent table.
        puzzling: share of the traces with a transition that is inexplicable to every type
            before any message.
    """

    smallest: NDArray[np.int64]
    worth: NDArray[np.bool_]
    tables: int
    commonest: float
    puzzling: float


def on_policy_traces(
    setting: Setting, count: int, rng: np.random.Generator, max_length: int = MAX_LENGTH
) -> list[Trace]:
    """Draws ``count`` random traces of the robot, each [m, 3]."""
    model, starts = setting.models[0], setting.domain.starts
    return [sample_trace(model, starts, rng, max_length) for _ in range(count)]


def count_traces(setting: Setting, max_length: int = MAX_LENGTH) -> int:
    """Counts the different traces of the robot, step by step from their ends."""
    before, _, after = setting.reachable.T  # each transition once
    terminal = setting.models[0].terminal
    ways = np.ones(len(terminal), dtype=object)  # whole numbers of any size
    for _ in range(max_length):
        onward = np.zeros_like(ways)
        np.add.at(onward, before, ways[after])
        ways = np.where(terminal, 1, onward)
    return int(ways[np.unique(setting.domain.starts)].sum())


def share_through(
    domain: Domain, traces: Sequence[Trace], cells: Iterable[tuple[int, int]]
) -> float:
    """Computes the share of the traces that pass one of these cells, and neither start nor end
    there."""
    wanted = set(cells)
    passing = [any(domain.position(s) in wanted for s in trace[1:, 0]) for trace in traces]
    return float(np.mean(passing))


def inexplicable_alone(domain: Domain, traces: Sequence[Trace]) -> dict[str, float]:
    """Returns for each parameter the share of transitions that are inexplicable to people who
    believe only this parameter incorrectly."""
    accurate = {parameter.name: parameter.accurate for parameter in domain.parameters}
    models = [
        domain.model(accurate | {parameter.name: parameter.inaccurate})
        for parameter in domain.parameters
    ]
    names = [f"who holds {parameter.name} inaccurately" for parameter in domain.parameters]
    every = np.concatenate(traces)
    labels = np.array([model.labels(every) for model in models[0].solve(models, names)])
    shares = 1 - labels.mean(axis=1)
    return {p.name: float(share) for p, share in zip(domain.parameters, shares, strict=True)}


def problems(setting: Setting, traces: Sequence[Trace]) -> Problems:
    """Computes the properties of the explanation problems of these traces."""
    size = np.array([h.bit_count() for h in range(1 << setting.n_messages)])
    transitions, index = np.unique(np.concatenate(traces), axis=0, return_inverse=True)
    labels = setting.label_table(transitions)  # [N, T, 2^n]
    ends = np.cumsum([len(trace) for trace in traces])[:-1]
    smallest, worth = [], []
    tables: Counter[bytes] = Counter()
    puzzled = 0
    for where in np.split(index.ravel(), ends):
        table = labels[:, where]  # [N, m, 2^n]
        need = np.where(table.all(axis=1), size, setting.n_messages).min(axis=1)
        # Step k shows transitions 1 … k, so the i-th of m is labelled m − i + 1 times.
        silence = (1 - table[:, :, 0].astype(np.int64)) @ np.arange(len(where), 0, -1)
        smallest.append(need)
        worth.append(LARGEST_TRADE_OFF * need < silence)
        tables[table[:, ~table.all(axis=(0, 2))].tobytes()] += 1
        puzzled += not table[:, :, 0].any(axis=0).all()
    return Problems(
        smallest=np.array(smallest),
        worth=np.array(worth),
        tables=len(tables),
        commonest=max(tables.values()) / len(traces),
        puzzling=puzzled / len(traces),
    )
