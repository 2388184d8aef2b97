"""Observers: people, simulated or real, whose labels the user types are learned from
(docs/method.md, section 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.data.dataset import Dataset
from xplain.data.label_table import align, read_table
from xplain.data.rollouts import sample_trace
from xplain.domains.base import transition_feature_names, transition_features
from xplain.errors import InputError
from xplain.randomness import stream
from xplain.users.setting import Setting


class Observers(Protocol):
    """Where the labels come from: the interface of every component ``observers``."""

    def collect(self, setting: Setting, seed: int) -> tuple[Dataset, NDArray[np.int64] | None]:
        """P labels of transitions of ``setting.domain``, with its features and its messages.

        Returns:
            The labels, and [O] each observer's true type (index into ``setting.types``); None
            where it is unknown, as of real people.

        Raises:
            InputError: the labels, or the component's options, do not fit the setting.
        """
        ...


@dataclass(frozen=True)
class SimulatedObservers:
    """Observers of every type, who label traces of the robot under random message sets.

    Traces start at random and follow the robot's optimal policy, ties broken at random; each comes
    with one random message set, and every transition of it is labelled. Observers come in the
    order of their types.

    Attributes:
        per_type: observers a type; a list gives each type its own number.
        points: labels an observer, exactly (the last trace is cut); a pair [low, high] draws it
            for each observer, uniformly.
        trace_length: where a trace is cut.
        queries: ``shared``, one battery of (trace, message set) for all observers, or
            ``independent``.
        message_probability: of each message to be in a trace's message set.
        label_noise: probability that a label is flipped, label by label.
    """

    per_type: int | Sequence[int] = 3
    points: int | Sequence[int] = 300
    trace_length: int = 10
    queries: Literal["shared", "independent"] = "shared"
    message_probability: float = 0.5
    label_noise: float = 0.0

    def __post_init__(self) -> None:
        counts = _whole_numbers(self.per_type)
        if not counts or min(counts) < 1:
            raise InputError("observers.per_type", self.per_type, "a number ≥ 1, or one a type")
        points = _whole_numbers(self.points)
        single = isinstance(self.points, int)
        if len(points) != (1 if single else 2) or points[0] < 1 or points[0] > points[-1]:
            raise InputError("observers.points", self.points, "a number ≥ 1, or [low, high]")
        if not isinstance(self.trace_length, int) or self.trace_length < 1:
            raise InputError("observers.trace_length", self.trace_length, "a number ≥ 1")
        if self.queries not in ("shared", "independent"):
            raise InputError("observers.queries", self.queries, "shared or independent")
        for key, high in (("message_probability", 1.0), ("label_noise", 0.5)):
            value = getattr(self, key)
            if not isinstance(value, (int, float)) or not 0 <= value <= high:
                raise InputError(f"observers.{key}", value, f"a number in [0, {high:g}]")

    def collect(self, setting: Setting, seed: int) -> tuple[Dataset, NDArray[np.int64]]:
        """Labels of all observers and their true types (index into ``setting.types``).

        Raises:
            InputError: ``per_type`` does not fit the types.
        """
        truth = np.repeat(np.arange(len(setting.types)), self._counts(len(setting.types)))
        low, *_, high = _whole_numbers(self.points) * 2
        sizes = stream(seed, "observers", "points").integers(low, high + 1, len(truth))
        if self.queries == "shared":
            battery = self._queries(setting, int(sizes.max()), seed, "shared")
            asked = [tuple(part[:size] for part in battery) for size in sizes]
        else:
            asked = [self._queries(setting, int(size), seed, o) for o, size in enumerate(sizes)]
        labels = []
        for o, (transitions, masks) in enumerate(asked):
            true = setting.labels(int(truth[o]), transitions, masks)
            flip = stream(seed, "observers", "noise", o).random(len(true)) < self.label_noise
            labels.append(true ^ flip.astype(np.uint8))
        features = transition_features(setting.domain, np.concatenate([one[0] for one in asked]))
        distinct, transition = np.unique(features, axis=0, return_inverse=True)
        width = len(str(len(truth) - 1))
        dataset = Dataset(
            features=distinct,
            feature_names=transition_feature_names(setting.domain),
            messages=setting.message_names,
            observers=tuple(f"observer_{o:0{width}d}" for o in range(len(truth))),
            observer=np.repeat(np.arange(len(truth)), sizes),
            transition=transition.ravel(),
            message_set=np.concatenate([one[1] for one in asked]),
            label=np.concatenate(labels),
        )
        return dataset, truth

    def _counts(self, types: int) -> list[int]:
        counts = _whole_numbers(self.per_type)
        if isinstance(self.per_type, int):
            return counts * types
        if len(counts) != types:
            raise InputError("observers.per_type", self.per_type, f"a number, or {types} of them")
        return counts

    def _queries(
        self, setting: Setting, count: int, seed: int, whose: str | int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """``count`` transitions [count, 3] and the message set of each."""
        rng = stream(seed, "observers", "queries", whose)
        weights = 1 << np.arange(setting.n_messages, dtype=np.int64)
        traces: list[NDArray[np.int64]] = []
        masks: list[NDArray[np.int64]] = []
        total = 0
        while total < count:
            trace = sample_trace(
                setting.models[0],
                setting.optimal[0],
                setting.domain.starts,
                rng,
                self.trace_length,
            )
            given = rng.random(setting.n_messages) < self.message_probability
            traces.append(trace)
            masks.append(np.full(len(trace), int(weights[given].sum())))
            total += len(trace)
        return np.concatenate(traces)[:count], np.concatenate(masks)[:count]


def _whole_numbers(value: object) -> list[int]:
    """One number or several, as a list; empty where something else is among them."""
    several = list(value) if isinstance(value, Sequence) else [value]
    whole = [one for one in several if isinstance(one, int) and not isinstance(one, bool)]
    return whole if len(whole) == len(several) else []


@dataclass(frozen=True)
class FileObservers:
    """Real people's labels, from a table (see :func:`xplain.data.label_table.read_table`).

    Attributes:
        path: a CSV or Parquet file.
        features: columns that describe a transition; None is every column that is left.
        ignore: columns that are none.
    """

    path: str
    features: Sequence[str] | None = None
    ignore: Sequence[str] = ()

    def __post_init__(self) -> None:
        """Raises InputError where there is no such file."""
        if not Path(self.path).is_file():
            raise InputError("observers.path", str(self.path), "no such file")

    def collect(self, setting: Setting, seed: int) -> tuple[Dataset, None]:
        """The table, its features in the order of the domain's, so that labelers trained on it
        can be asked about the domain's traces; ``seed`` is not used.

        Raises:
            InputError: the file cannot be read, or its messages or features are not the domain's.
        """
        try:
            dataset = read_table(self.path, setting.message_names, self.features, self.ignore)
            return align(dataset, transition_feature_names(setting.domain)), None
        except InputError as error:
            if error.key != "data":  # what the command that finds types calls its table
                raise
            raise InputError("observers.path", error.value, error.allowed) from error
