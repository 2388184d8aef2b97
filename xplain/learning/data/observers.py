"""Observers, simulated or real people. User types are learned from their labels (docs/method.md,
section 2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import transition_feature_names, transition_features
from xplain.domains.users.hypotheses import Hypotheses, hypotheses_of
from xplain.domains.users.setting import Setting
from xplain.errors import Count, InputError, Range, checks
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.label_file import read_table
from xplain.learning.data.queries import Queries
from xplain.randomness import stream


@dataclass(frozen=True)
class Observations:
    """The observers' labels and what is known about the observers. Types are learned from these
    data alone.

    Attributes:
        dataset: the labels.
        truth: [O] index of each observer's true type; None if unknown.
        setting: the domain, the true types and their models; None if there is only a table.
        likely: fact sets (bitmasks) that the answers made likely and that no hypothesis contained.
    """

    dataset: Dataset
    truth: NDArray[np.int64] | None = None
    setting: Setting | None = None
    likely: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        """Raises InputError if the labels do not have the setting's features and messages."""
        if self.setting is None:
            return
        domain, dataset = self.setting.domain, self.dataset
        names = transition_feature_names(domain)
        if dataset.feature_names != names:
            raise InputError(
                "observers.path",
                ",".join(dataset.feature_names),
                f"labels of {domain.name} need the features {','.join(names)} in this order "
                "(python -m xplain discover finds types in labels of any task)",
            )
        wanted = self.setting.message_names
        if dataset.messages != wanted:
            given = ",".join(dataset.messages)
            raise InputError("observers.messages", given, f"must be {','.join(wanted)}")

    @cached_property
    def hypotheses(self) -> Hypotheses | None:
        """The hypotheses of the domain, extended by the fact sets ``likely``; None if there is only
        a table."""
        if self.setting is None:
            return None
        own = hypotheses_of(self.setting.domain, None)
        return own if self.likely is None else own.with_sets(self.likely)

    @property
    def behaviour(self) -> NDArray[np.int64] | None:
        """[O] the number of each observer's true type; None if true types are unknown. Types with
        the same labels have the same number, because clustering and scores count them as one
        type."""
        if self.truth is None or self.setting is None:
            return self.truth
        return self.setting.distinct[self.truth]


class Observers(Protocol):
    """A source of labels: the interface of every component ``observers``."""

    def collect(self, setting: Setting, queries: Queries, seed: int) -> Observations:
        """Collects P labels of transitions of ``setting.domain``, with its features and its
        messages.

        Args:
            setting: the domain and the true types.
            queries: the query design; unused if the observers cannot be asked.
            seed: seed of every draw.

        Returns:
            The labels and what is known about the observers, including ``setting``.

        Raises:
            InputError: the labels, or the component's options, do not fit the setting.
        """
        ...


@checks("observers")
@dataclass(frozen=True)
class SimulatedObservers:
    """Simulated observers of each type, who answer the queries. The observers are in the order of
    their types.

    Attributes:
        per_type: number of observers of each type; a list has one number for each type.
        points: number of labels of each observer; a query design may ask for fewer.
        label_noise: probability that a label is flipped, independently for each label.
    """

    per_type: int | Sequence[int] = 3
    points: Count = 300
    label_noise: Annotated[float, Range(0, 0.5)] = 0.0

    def __post_init__(self) -> None:
        counts = np.asarray(self.per_type)
        if counts.ndim > 1 or counts.dtype.kind != "i" or counts.min() < 1:
            raise InputError("observers.per_type", self.per_type, "a number ≥ 1, or one a type")

    def collect(self, setting: Setting, queries: Queries, seed: int) -> Observations:
        """Returns the labels of all observers and their true types.

        Raises:
            InputError: ``per_type`` does not fit the types.
        """
        types, counts = len(setting.types), np.asarray(self.per_type)
        if counts.ndim and len(counts) != types:
            raise InputError("observers.per_type", self.per_type, f"a number, or {types} of them")
        truth = np.repeat(np.arange(types), counts)
        sizes = np.full(len(truth), self.points)
        noise = [stream(seed, "observers", "noise", o) for o in range(len(truth))]

        def answer(
            observer: int, transitions: NDArray[np.int64], message_sets: NDArray[np.int64]
        ) -> NDArray[np.uint8]:
            true = setting.labels(int(truth[observer]), transitions, message_sets)
            flip = noise[observer].random(len(true)) < self.label_noise
            return true ^ flip.astype(np.uint8)

        asked = queries.ask(setting, sizes, answer, seed)
        shown = np.concatenate([one.transitions for one in asked])
        # A few distinct transitions occur often, and rows of features are slow to compare.
        keys = np.ravel_multi_index(tuple(shown.T), tuple(shown.max(axis=0) + 1))
        _, first, which = np.unique(keys, return_index=True, return_inverse=True)
        features = transition_features(setting.domain, shown[first])
        distinct, transition = np.unique(features, axis=0, return_inverse=True)
        width = len(str(len(truth) - 1))
        dataset = Dataset(
            features=distinct,
            feature_names=transition_feature_names(setting.domain),
            messages=setting.message_names,
            observers=tuple(f"observer_{o:0{width}d}" for o in range(len(truth))),
            observer=np.repeat(np.arange(len(truth)), [len(one.labels) for one in asked]),
            transition=transition.ravel()[which],
            message_set=np.concatenate([one.message_sets for one in asked]),
            label=np.concatenate([one.labels for one in asked]),
        )
        found = [one.likely for one in asked if one.likely is not None]
        likely = np.unique(np.concatenate(found)) if found else None
        return Observations(dataset, truth, setting, likely)


@dataclass(frozen=True)
class FileObservers:
    """Real people's labels, from a table (see :func:`xplain.learning.data.label_file.read_table`).

    Attributes:
        path: a CSV or Parquet file.
        features: columns that describe a transition; None: all other columns.
        ignore: columns to leave out.
    """

    path: str
    features: Sequence[str] | None = None
    ignore: Sequence[str] = ()

    def __post_init__(self) -> None:
        """Raises InputError if the file does not exist."""
        if not Path(self.path).is_file():
            raise InputError("observers.path", str(self.path), "no such file")

    def collect(self, setting: Setting, queries: Queries, seed: int) -> Observations:
        """Reads the table, with its features in the order of the domain's features. Labelers
        trained on it can then predict the domain's traces. ``queries`` and ``seed`` are unused,
        because these people have already answered.

        Raises:
            InputError: the file cannot be read, or its messages or features are not the domain's.
        """
        names, like = setting.message_names, transition_feature_names(setting.domain)
        own = self.features, self.ignore
        dataset = read_table(self.path, names, *own, like=like, key="observers.path")
        return Observations(dataset, setting=setting)
