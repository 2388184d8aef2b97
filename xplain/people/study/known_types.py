"""The user types that a study's policies know: from observers, or from a file of ``discover``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from hydra.utils import instantiate
from numpy.typing import NDArray
from omegaconf import DictConfig
from scipy.optimize import linear_sum_assignment

from xplain.domains.base import transition_feature_names, transition_features
from xplain.domains.users.setting import Setting
from xplain.errors import InputError
from xplain.experiment.pipeline import observe
from xplain.explanation.habits import Habits
from xplain.learning.clustering import Perfect
from xplain.learning.data.rollouts import sample_trace
from xplain.learning.known_types import learn
from xplain.learning.labelers import Labeler
from xplain.learning.saved_types import LearnedTypes
from xplain.learning.user_types import label_table
from xplain.randomness import stream

LEAST_AGREEMENT = 0.8
"""Share of labels in which a learned type is the true one."""
MATCHING_TRACES, MATCHING_STEPS = 50, 40


@dataclass(frozen=True)
class Learned:
    """Types as labels tell them.

    Attributes:
        names, labelers, shares: [N] of each type: its name, its labeler, its share of the people.
        columns: positions of the features that the labelers know among the domain's.
        key: of the configuration, which names them; "" where they are the study's own types in
            their order.
        habits: how people err, as far as their labels tell.
    """

    names: tuple[str, ...]
    labelers: tuple[Labeler, ...]
    shares: NDArray[np.float64]
    columns: tuple[int, ...]
    key: str
    habits: Habits | None = None

    def ordered(self, order: Sequence[int]) -> Learned:
        """The same in another order."""
        return replace(
            self,
            names=tuple(self.names[one] for one in order),
            labelers=tuple(self.labelers[one] for one in order),
            shares=self.shares[list(order)],
        )


def learned_types(cfg: DictConfig) -> tuple[Setting, Learned]:
    """The types that the policies know: those of a file (``types``), or learned from observers.

    Raises:
        InputError: the file's types know other features or messages than the domain has.
    """
    domain, users = instantiate(cfg.domain), instantiate(cfg.users)
    names = transition_feature_names(domain)
    if cfg.types is None:
        observers, queries = instantiate(cfg.observers), instantiate(cfg.queries)
        observed = observe(domain, users, observers, queries, cfg.seed)
        assert observed.setting is not None
        clusterer, trainer = instantiate(cfg.clusterer), instantiate(cfg.labeler)
        types = learn(observed, trainer, clusterer, cfg.seed)
        # Perfect clustering finds the types in their order.
        key = "" if isinstance(clusterer, Perfect) else "observers"
        columns = tuple(range(len(names)))
        habits = None if types.answers is None else types.answers.habits
        learned = Learned(types.names, types.labelers, types.prior, columns, key, habits)
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
    return Learned(known.names, known.labelers, known.prior, columns, "types", known.habits)


def matched(setting: Setting, learned: Learned, seed: int) -> list[int]:
    """Which labeler is that of each type: found by their labels, never by their order.

    Labels of transitions of the robot, with every message set, are compared. Labelers and types
    are paired so that as few labels as can be differ.

    Args:
        setting: with N types.
        learned: in any order.
        seed: of the draws of transitions.

    Raises:
        InputError: not N labelers, or one that fits no type, or two types as well.
    """
    labelers, natural = learned.labelers, "or briefing=none, for people as they are"
    if len(labelers) != len(setting.types):
        wanted = f"as many learned types as the study's users: {len(setting.types)}; {natural}"
        raise InputError(learned.key, len(labelers), wanted)
    shown = np.unique(
        np.concatenate(
            [
                sample_trace(
                    setting.models[0],
                    setting.optimal[0],
                    setting.domain.starts,
                    stream(seed, "matching", index),
                    MATCHING_STEPS,
                )
                for index in range(MATCHING_TRACES)
            ]
        ),
        axis=0,
    )
    features = transition_features(setting.domain, shown)[:, learned.columns]
    found = label_table(labelers, features)
    true = setting.labels_by_type(shown)
    union = [sorted({j for row in (*found.rows, *true.rows) for j in row})]
    found_labels, true_labels = (
        (table.over(union * table.n_types).p > 0.5).transpose(2, 0, 1) for table in (found, true)
    )
    agreement = np.array([[(one == own).mean() for one in found_labels] for own in true_labels])
    _, order = linear_sum_assignment(-agreement)
    for t, user_type in enumerate(setting.types):
        own = agreement[t, order[t]]
        others = np.delete(agreement[t], order[t])
        if own < LEAST_AGREEMENT or (len(others) and own <= others.max()):
            wanted = (
                f"types among which each of the study's users is found again (at least "
                f"{100 * LEAST_AGREEMENT:.0f} % of labels agree, with no other as many); {natural}"
            )
            said = f"{user_type.name}: {100 * own:.0f} % of labels agree"
            raise InputError(learned.key, said, wanted)
    return [int(one) for one in order]
