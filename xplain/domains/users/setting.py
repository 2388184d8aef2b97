"""A setting: a domain, its user types, and the labels of each type (docs/method.md, section 1).

Many types and message sets share one model of the task; each distinct model is solved once.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains import mdp
from xplain.domains.base import Domain
from xplain.errors import InputError, TooLargeError, one_of
from xplain.explanation.label_table import LabelTable

MAX_MODELS = 1 << 14


@dataclass(frozen=True)
class UserType:
    """A user type: people with the same inaccurate values.

    Attributes:
        name: name of the type.
        inaccurate: ``{parameter: the value that these people believe}``.
        backlash: if True, a message about a parameter that is not in ``inaccurate`` makes these
            people believe its inaccurate value.
    """

    name: str
    inaccurate: Mapping[str, Any]
    backlash: bool = False

    def after(self, names: Sequence[str], told: Collection[str]) -> list[str]:
        """Returns the parameters that these people believe incorrectly after some messages.

        Args:
            names: all parameters that may be in the result.
            told: names of the parameters that the messages are about.
        """
        if self.backlash:
            return [name for name in names if (name in self.inaccurate) != (name in told)]
        return [name for name in names if name in self.inaccurate and name not in told]


@dataclass(frozen=True)
class Setting:
    """A domain with N user types, and the solution of every distinct model of the task.

    Attributes:
        domain, types: the domain and the types.
        models: the distinct models, solved; the first is the robot's.
        bits: for each type, the indices of the messages that change its beliefs, ascending.
        table: for each type, an array [2^r] with r = len(bits) for this type. Entry i is the index
            in ``models`` of the type's model after the messages in the bitmask i. Bit k of i is
            message ``bits[k]``.
    """

    domain: Domain
    types: tuple[UserType, ...]
    models: tuple[mdp.TaskModel, ...]
    bits: tuple[tuple[int, ...], ...]
    table: tuple[NDArray[np.int64], ...]

    @classmethod
    def build(cls, domain: Domain, types: tuple[UserType, ...]) -> Setting:
        """Solves every distinct model.

        Raises:
            InputError: there are no types, two types have one name, a type names an unknown
                parameter, or the domain reads a parameter that it does not have.
            DomainError: a model has ambiguous ties, or cannot reach its goal.
            TooLargeError: more than MAX_MODELS distinct models.
        """
        names = [parameter.name for parameter in domain.parameters]
        if not types:
            raise InputError("users", [], "at least one user type")
        called = [user_type.name for user_type in types]
        if len(set(called)) < len(called):
            raise InputError("users", called, "user types need different names")
        for user_type in types:
            for name in user_type.inaccurate:
                one_of(f"users.{user_type.name}", name, names, f"parameter of {domain.name}")
        heard = [names if t.backlash else [x for x in names if x in t.inaccurate] for t in types]
        if sum(1 << len(own) for own in heard) > MAX_MODELS:
            raise TooLargeError(
                f"users: the types' inaccurate parameters need more than {MAX_MODELS} task models; "
                "use types with fewer inaccurate parameters"
            )
        accurate = {parameter.name: parameter.accurate for parameter in domain.parameters}
        inaccurate = {parameter.name: parameter.inaccurate for parameter in domain.parameters}
        index: dict[str, int] = {}
        models: list[mdp.TaskModel] = []
        whose: list[str] = []

        def model_of(values: dict[str, Any], who: str) -> int:
            key = repr([values[name] for name in names])
            if key not in index:
                index[key] = len(models)
                models.append(task_of(domain, values))
                whose.append(who)
            return index[key]

        model_of(accurate, "the robot's model")
        bits, table = [], []
        for user_type, hears in zip(types, heard, strict=True):
            own = tuple(names.index(name) for name in hears)
            theirs = {**inaccurate, **user_type.inaccurate}
            row = np.empty(1 << len(own), dtype=np.int64)
            for given in range(len(row)):
                told = [name for i, name in enumerate(hears) if given >> i & 1]
                wrong = user_type.after(names, told)
                values = accurate | {name: theirs[name] for name in wrong}
                who = f"type {user_type.name} (believes {', '.join(wrong)} incorrectly)"
                row[given] = model_of(values, who)
            bits.append(own)
            table.append(row)
        return cls(domain, types, models[0].solve(models, whose), tuple(bits), tuple(table))

    @property
    def message_names(self) -> tuple[str, ...]:
        """Names of the messages, one for each parameter, in order."""
        return tuple(parameter.name for parameter in self.domain.parameters)

    @property
    def n_messages(self) -> int:
        """n, the number of messages: one for each parameter of the domain."""
        return len(self.domain.parameters)

    @property
    def wrong(self) -> NDArray[np.float64]:
        """[N, n] 1 if a type believes a fact incorrectly, else 0."""
        names = self.message_names
        return np.array([[name in one.inaccurate for name in names] for one in self.types], float)

    def label_by_model(self, transitions: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Computes [B, T] the labels of transitions [T, 3] under each of the B distinct models."""
        return np.array([model.labels(transitions) for model in self.models])

    def labels(
        self, user_type: int, transitions: NDArray[np.int64], message_sets: NDArray[np.int64]
    ) -> NDArray[np.uint8]:
        """Computes [P] the true labels of one type for P pairs of a transition and a message set.

        Args:
            user_type: number of the type.
            transitions: [P, 3].
            message_sets: [P] bitmasks.
        """
        local = np.zeros_like(message_sets)  # the bitmasks over the type's own messages
        for i, j in enumerate(self.bits[user_type]):
            local |= (message_sets >> j & 1) << i
        model = self.table[user_type][local]
        return self.label_by_model(transitions)[model, np.arange(len(transitions))]

    def label_table(self, transitions: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Computes [N, T, 2^n] the true labels of all types for all message sets.

        Raises:
            TooLargeError: too many messages for such a table.
        """
        return self.labels_by_type(transitions).array(self.n_messages).astype(np.uint8)

    def labels_by_type(self, transitions: NDArray[np.int64]) -> LabelTable:
        """Computes the true labels of all types for transitions [T, 3]. For each type, the table
        distinguishes only the messages that change the type's beliefs."""
        by_model = self.label_by_model(transitions)
        return LabelTable.join_types(
            self.bits, [by_model[row].T.astype(np.float64) for row in self.table]
        )

    def true_labels(self, transitions: NDArray[np.int64]) -> LabelTable:
        """Computes the true labels of all types for transitions [T, 3]. The table is dense if
        messages are few; otherwise it distinguishes only the messages that change some label
        (:meth:`LabelTable.compact`)."""
        return self.labels_by_type(transitions).compact(self.n_messages)

    @cached_property
    def reachable(self) -> NDArray[np.int64]:
        """[T, 3] every transition of the robot's optimal policies from any start."""
        model = self.models[0]
        made = model.optimal[:, :, None] & (model.probability > 0)
        states = self.domain.starts
        made &= mdp.find_reached(states, model.n_states, lambda s: model.successor[s][made[s]])[
            :, None, None
        ]
        s, a, k = np.nonzero(made)
        return np.unique(np.stack([s, a, model.successor[s, a, k]], axis=1), axis=0)

    @cached_property
    def distinct(self) -> NDArray[np.int64]:
        """[N] a number for each type. Two types have the same number if they behave alike: their
        labels are equal for every reachable transition and every message set."""
        labels = self.labels_by_type(self.reachable)
        first: dict[tuple[tuple[int, ...], bytes], int] = {}
        found = []
        for t, own in enumerate(labels.effective()):
            key = own, labels.of_types([t]).select_messages([own]).p.tobytes()
            found.append(first.setdefault(key, len(first)))
        return np.array(found)


def task_of(domain: Domain, values: Mapping[str, Any]) -> mdp.TaskModel:
    """Makes the domain's model with these values.

    Raises:
        InputError: the domain reads a parameter that it does not have.
    """
    try:
        return domain.model(values)
    except KeyError as error:
        if error.args and error.args[0] in values:
            raise
        wanted = error.args[0] if error.args else ""
        raise InputError(
            "domain.parameters", ", ".join(values), f"{domain.name} needs the parameter {wanted}"
        ) from error
