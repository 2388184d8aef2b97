"""The user types that a study's policies know: from observers, or from a file of ``discover``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from hydra.utils import instantiate
from numpy.typing import NDArray
from omegaconf import DictConfig

from xplain.domains.base import transition_feature_names
from xplain.domains.users.setting import Setting
from xplain.errors import InputError
from xplain.experiment.pipeline import observe
from xplain.explanation.habits import Habits
from xplain.learning.labelers import Labeler
from xplain.learning.saved import LearnedTypes
from xplain.learning.user_types import Perfect
from xplain.randomness import stream


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
