"""What a study explains: a domain with its user types, or a lab's own table of transitions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from hydra.utils import instantiate
from numpy.typing import NDArray
from omegaconf import DictConfig

from xplain.domains.base import changes_of, transition_feature_names, transition_features
from xplain.domains.users.setting import Setting, UserType
from xplain.errors import InputError, whole_number
from xplain.experiment.asking import Clips
from xplain.experiment.pipeline import observe
from xplain.explanation.asking import Pool, alike_first, nearest_first
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.explanation.message_sets import indices
from xplain.learning.data.queries import sample_trace
from xplain.learning.labelers import Labeler
from xplain.learning.saved import LearnedTypes
from xplain.learning.user_types import Perfect, label_table
from xplain.people.material import Source, of_states, way_of
from xplain.people.plan import Task, Told, Way
from xplain.people.study.plan import Clip
from xplain.randomness import stream

Rules = Mapping[str, Any]
"""The configuration's ``trace``."""


@dataclass(frozen=True, kw_only=True)
class ShownTask(Task):
    """A task, and one trace of it, as participants meet them.

    Attributes:
        types: M kinds of (simulated) people.
        labels: [M, m, 2^n] their true labels of the trace.
        trace: [m] what the robot does.
        path, taken: see the plan.
    """

    types: tuple[UserType, ...]
    labels: NDArray[np.uint8]
    trace: tuple[str, ...]
    path: Way | None = None
    taken: Told = ()


@dataclass(frozen=True)
class MayAsk:
    """Q clips that may be asked about while a trace of m transitions is explained, nearest first.

    Attributes:
        clips: as participants meet them; texts not yet in a lab's words.
        learned: of the labelers.
        labels: true ones, of M kinds of (simulated) people.
        shows: [Q, m] whether a clip is of this transition of the trace.
    """

    clips: tuple[Clip, ...]
    learned: LabelTable
    labels: LabelTable
    shows: NDArray[np.bool_]


@dataclass(frozen=True)
class OfDomain:
    """Traces [m, 3] of transitions of a domain's robot."""

    setting: Setting

    def traces(self, rules: Rules, max_steps: int, seed: int) -> list[NDArray[np.int64]]:
        """Traces that every participant could evaluate, the best first, none twice: of
        ``candidates`` random ones from ``start`` (a cell of the map, or None for any).

        Raises:
            InputError: there is none as ``rules`` want it.
        """
        setting = self.setting
        domain, starts = setting.domain, setting.domain.starts
        if rules["rows"]:
            raise InputError("trace.rows", rules["rows"], "only with transitions=TABLE")
        if rules["start"] is not None:
            cell = tuple(rules["start"])
            starts = np.array([s for s in starts if domain.position(int(s)) == cell], np.int64)
            if not len(starts):
                raise InputError("trace.start", list(cell), "a cell where traces start")
        whole_number("trace.candidates", rules["candidates"], 1)

        def draw(index: int) -> NDArray[np.int64]:
            rng = stream(seed, "trace", index)
            return sample_trace(setting.models[0], setting.optimal[0], starts, rng, max_steps)

        return ranked(map(draw, range(rules["candidates"])), rules, setting.label_table)

    def table(self, learned: Learned, trace: NDArray[np.int64]) -> LabelTable:
        """What the labelers say of a trace."""
        features = transition_features(self.setting.domain, trace)[:, learned.columns]
        return label_table(learned.labelers, features, trace)

    def seen(self, trace: NDArray[np.int64]) -> ShownTask:
        """What participants see of a trace: on the domain's map, if it has one."""
        domain, states = self.setting.domain, [*trace[:, 0].tolist(), int(trace[-1, 2])]
        return ShownTask(
            name=domain.name,
            facts=domain.parameters,
            types=self.setting.types,
            labels=self.setting.label_table(trace),
            trace=tuple(domain.describe(transition) for transition in trace),
            scene=domain.scene,
            path=way_of(domain, pairwise(states)),
            changes=() if domain.scene else changes_of(domain, trace),
            taken=of_states(domain, "gone", states),
        )

    def may_ask(self, learned: Learned, trace: NDArray[np.int64], pool: Pool) -> MayAsk:
        """The clips of the pool: of every transition that the robot can make."""
        setting, domain = self.setting, self.setting.domain
        every = setting.reachable
        tables = self.table(learned, every), setting.true_labels(every)
        features = transition_features(domain, every)
        shown = transition_features(domain, trace)
        near = Clips(pool, setting, features, *tables).near(shown, trace)
        begin = near.transitions[:, 0].tolist()
        told = [of_states(domain, what, begin) for what in ("situation", "gone")]
        told.append(() if domain.scene else changes_of(domain, near.transitions))
        situations, gone, changes = (one or ((),) * len(begin) for one in told)
        ways = [way_of(domain, [step]) or () for step in near.transitions[:, [0, 2]].tolist()]
        clips = tuple(map(Clip, near.texts, ways, situations, gone, changes))
        return MayAsk(clips, near.learned, near.labels, near.shows)


@dataclass(frozen=True)
class OfTable:
    """Traces [m] of rows of a lab's own table, from 0; see :class:`OfDomain` for the methods."""

    own: Source

    def traces(self, rules: Rules, max_steps: int, seed: int) -> list[NDArray[np.int64]]:
        """Those of ``rows``: lists of rows of the table, from 1."""
        last, wanted = self.own.hypotheses.n_transitions, rules["rows"]
        allowed = f"lists of rows of the table, such as [[1, 2], [3, 1]], from 1 to {last}"
        if not wanted or not all(isinstance(one, list) and one for one in wanted):
            raise InputError("trace.rows", wanted, allowed)
        for row in (row for one in wanted for row in one):
            if not isinstance(row, int) or not 1 <= row <= last:
                raise InputError("trace.rows", row, allowed)
        given = [np.array(one, dtype=np.int64)[:max_steps] - 1 for one in wanted]
        return ranked(given, rules, self._labels)

    def table(self, learned: Learned, trace: NDArray[np.int64]) -> LabelTable:
        """What the labelers say of a trace."""
        features = self.own.hypotheses.features
        assert features is not None, "own tables have features"
        return label_table(learned.labelers, features[trace][:, learned.columns])

    def seen(self, trace: NDArray[np.int64]) -> ShownTask:
        """With its images, without a map."""
        own, names = self.own, self.own.hypotheses.messages
        pictures = tuple(own.pictures[row] for row in trace) if own.pictures else ()
        return ShownTask(
            name=own.name,
            facts=own.facts,
            types=tuple(
                UserType(name, {names[j]: False for j in indices(held)})
                for name, held in own.roles.items()
            ),
            labels=self._labels(trace),
            trace=tuple(own.hypotheses.phrases[row] for row in trace),
            pictures=pictures if any(pictures) else (),
        )

    def may_ask(self, learned: Learned, trace: NDArray[np.int64], pool: Pool) -> MayAsk:
        """Of every row of the table."""
        own, features = self.own, self.own.hypotheses.features
        assert features is not None, "own tables have features"
        order = nearest_first(features, features[trace])
        order = order[alike_first(self.table(learned, order), pool.clips)]
        pictures = own.pictures or (None,) * len(features)
        phrases = own.hypotheses.phrases
        return MayAsk(
            tuple(Clip(phrases[row], picture=pictures[row]) for row in order),
            self.table(learned, order),
            LabelTable.dense(self._labels(order)),
            order[:, None] == trace,
        )

    def _labels(self, trace: NDArray[np.int64]) -> NDArray[np.uint8]:
        known = self.own.hypotheses
        told = np.arange(1 << len(known.messages))
        rows = [known.row(held & ~told) for held in self.own.roles.values()]
        return np.stack([known.labels[of_kind][:, trace].T for of_kind in rows])


StudyTask = OfDomain | OfTable
"""What a study explains; traces are arrays as its methods hand them on."""


def ranked(
    traces: Iterable[NDArray[np.int64]],
    rules: Rules,
    labels: Callable[[NDArray[np.int64]], NDArray[np.uint8]],
) -> list[NDArray[np.int64]]:
    """The shortest of the traces for which the types need the most facts corrected, first: one that
    most types understand anyway would measure nothing, and one of two or three steps hardly
    anything.

    Args:
        traces: of any kind.
        rules: ``min_steps``.
        labels: gives the true labels [M, m, 2^n] of a trace.

    Raises:
        InputError: none is as long.
    """
    least, drawn = whole_number("trace.min_steps", rules["min_steps"], 1), list(traces)
    long = [one for one in drawn if len(one) >= least]
    if not long:
        longest = max(len(one) for one in drawn)
        raise InputError("trace.min_steps", least, f"{longest} steps or fewer here")

    def worth(trace: NDArray[np.int64]) -> tuple[int, int]:
        facts = sum(needed(of_type).bit_count() for of_type in labels(trace))
        return facts, -len(trace)

    distinct = {one.tobytes(): one for one in long}
    return sorted(distinct.values(), key=worth, reverse=True)


def needed(labels: NDArray[np.uint8]) -> int:
    """The smallest message set with which a type finds the whole trace explicable.

    Args:
        labels: [m, 2^n] the type's true labels.

    Returns:
        A bitmask; ties by message order. All messages together always do: then the type's model
        is the robot's, and the trace is optimal in it.
    """
    explaining = np.flatnonzero(labels.all(axis=0))
    return int(min(explaining, key=lambda mask: (int(mask).bit_count(), indices(int(mask)))))


@dataclass(frozen=True)
class Learned:
    """Types as labels tell them.

    Attributes:
        names, labelers, shares: [N] of each type: its name, its labeler, its share of the people.
        columns: positions of the features that the labelers know among the domain's.
        habits: how people err, as far as their labels tell.
    """

    names: tuple[str, ...]
    labelers: tuple[Labeler, ...]
    shares: NDArray[np.float64]
    columns: tuple[int, ...]
    habits: Habits | None = None


def learned_types(cfg: DictConfig) -> tuple[Setting, Learned]:
    """The types that the policies know: those of a file (``types``), or learned from observers.

    Raises:
        InputError: the file's types know other features or messages than the domain has, or
            participants shall be told what one type knows, and types are found: nothing says which
            of them is whose.
    """
    domain, users, trainer = (instantiate(cfg[key]) for key in ("domain", "users", "labeler"))
    finder = instantiate(cfg.clusterer, _partial_=True)(labeler=trainer)
    if cfg.briefing == "assigned" and (cfg.types is not None or not isinstance(finder, Perfect)):
        wanted = "none with types that were found, by types=FILE or another clusterer than perfect"
        raise InputError("briefing", cfg.briefing, wanted)
    names = transition_feature_names(domain)
    if cfg.types is None:
        observers, queries = instantiate(cfg.observers), instantiate(cfg.queries)
        observed = observe(domain, users, observers, queries, cfg.seed)
        assert observed.setting is not None
        types = finder.find(observed, cfg.seed)
        columns = tuple(range(len(names)))
        habits = None if types.answers is None else types.answers.habits
        learned = Learned(types.names, types.labelers, types.prior, columns, habits)
        return observed.setting, learned
    setting = Setting.build(domain, users.types(domain, stream(cfg.seed, "users")))
    return setting, fitting(cfg.types, domain.name, setting.message_names, names)


def fitting(path: str, name: str, messages: Sequence[str], features: Sequence[str]) -> Learned:
    """The types of a file, for a task with these messages and features.

    Raises:
        InputError: they know others.
    """
    known = LearnedTypes.load(path)
    for own, theirs, what in (
        (tuple(messages), known.messages, "messages"),
        (tuple(sorted(features)), tuple(sorted(known.feature_names)), "features"),
    ):
        if own != theirs:
            wanted = f"types whose {what} are those of {name}: {', '.join(own)}"
            raise InputError("types", f"{path}: {', '.join(theirs)}", wanted)
    columns = tuple(features.index(one) for one in known.feature_names)
    return Learned(known.names, known.labelers, known.prior, columns, known.habits)
