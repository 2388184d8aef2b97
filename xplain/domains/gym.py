"""Gymnasium environments with a tabular model (``env.unwrapped.P``) as domains.

FrozenLake, CliffWalking, Taxi and whatever else shows its model become tasks by configuration
alone: the robot knows the environment as it is, and each parameter that people may hold wrong is a
list of changes of its rewards or transitions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Item, Parameter, Scene
from xplain.domains.grid import Cell, discount_factor, number, parameters_of
from xplain.errors import InputError, XplainError
from xplain.mdp import MDP

CHANGES = ("arguments", "when", "actions", "next", "add", "like")
STAY = "stay"


@dataclass(frozen=True)
class Tables:
    """An environment's model: [S, A, K] successor, probability and reward, [S] terminal."""

    successor: NDArray[np.int64]
    probability: NDArray[np.float64]
    reward: NDArray[np.float64]
    terminal: NDArray[np.bool_]
    starts: NDArray[np.int64]


class Gymnasium:
    """A tabular Gymnasium environment. States are the environment's own, by number.

    Args:
        id: of the environment, as in ``gymnasium.make(id, **arguments)``.
        states: what a state's number means, ``{feature: how many values, or their names}``, the
            last one changing fastest; these are the labeler's features. Features called ``row``
            and ``column`` give the robot's place on a map.
        actions: names of the actions, by number.
        discount: γ of the task, in (0, 1).
        parameters: ``{name: {inaccurate, message, belief}}``. ``inaccurate`` is a list of changes
            that lead from the environment to what people believe. A change says where it applies
            (all of these are optional): ``when``, a condition on the state; ``actions``, names;
            ``next``, a condition on the state reached. And what changes there: ``add``, a number
            added to the reward; or ``like``, the action whose outcomes it has instead, or
            ``stay``. A change ``arguments`` alone takes rewards and transitions of the
            environment made with these arguments; it comes before the others.
            A condition is ``{feature: value, or a list of values}``.
        starts: condition on states where traces start, equally likely; states that are terminal
            never are. None: those of the environment's initial distribution.
        arguments: of the environment.
        items: for pictures, ``{name: {symbol, cells: [[row, column], ...]}}``.
        name: of the domain.

    Raises:
        XplainError: gymnasium is not installed.
        InputError: a value is not allowed, or the environment shows no model.
    """

    def __init__(
        self,
        id: str,
        states: Mapping[str, int | Sequence[str]],
        actions: Sequence[str],
        discount: float,
        parameters: Mapping[str, Mapping[str, Any]],
        starts: Mapping[str, Any] | None = None,
        arguments: Mapping[str, Any] | None = None,
        items: Mapping[str, Mapping[str, Any]] | None = None,
        name: str = "gymnasium",
    ) -> None:
        """Makes the environment, reads its model and tries every change."""
        self.name, self._id, self._arguments = name, id, dict(arguments or {})
        self.discount = discount_factor("domain.discount", discount)
        self._variants: dict[str, Tables] = {}
        tables = self._tables({})
        n_states, n_actions, _ = tables.successor.shape
        self.actions = tuple(actions)
        if len(self.actions) != n_actions or len(set(self.actions)) < n_actions:
            raise InputError("domain.actions", actions, f"{n_actions} different names for {id}")
        self._values = {feature: _values(feature, given) for feature, given in states.items()}
        sizes = [len(values) for values in self._values.values()]
        if not sizes or int(np.prod(sizes)) != n_states:
            raise InputError("domain.states", dict(states), f"their product must be {n_states}")
        self.feature_names = tuple(self._values)
        self._codes = np.stack(np.unravel_index(np.arange(n_states), sizes), axis=1)
        self.state_features = self._codes.astype(np.float64)
        where = tables.starts if starts is None else np.flatnonzero(self._where("starts", starts))
        self.starts = where[~tables.terminal[where]].astype(np.int64)
        if not len(self.starts):
            raise InputError("domain.starts", starts, "at least one state that is not terminal")
        if not isinstance(parameters, Mapping):
            raise InputError("domain.parameters", parameters, "{name: {inaccurate, message}}")
        # The robot's value is the environment as it is: no change.
        self.parameters: tuple[Parameter, ...] = parameters_of(
            {
                key: {"accurate": [], **fields} if isinstance(fields, Mapping) else fields
                for key, fields in parameters.items()
            },
            tuple(parameters),
        )
        accurate: dict[str, Any] = {parameter.name: [] for parameter in self.parameters}
        for parameter in self.parameters:
            self.model(accurate | {parameter.name: parameter.inaccurate})
        self._items = [
            Item(item, fields["symbol"], tuple((int(r), int(c)) for r, c in fields["cells"]))
            for item, fields in (items or {}).items()
        ]

    def model(self, values: Mapping[str, Any]) -> MDP:
        """The environment with the changes of someone who holds these values.

        Raises:
            InputError: a change is not allowed.
        """
        changes: list[tuple[str, Mapping[str, Any]]] = []
        arguments: dict[str, Any] = {}
        for parameter in self.parameters:
            key = f"domain.parameters.{parameter.name}"
            value = values[parameter.name]
            if isinstance(value, str) or not isinstance(value, Sequence):
                raise InputError(key, value, "a list of changes")
            for change in value:
                if not isinstance(change, Mapping) or not change:
                    raise InputError(key, change, f"a change with {', '.join(CHANGES)}")
                if unknown := change.keys() - set(CHANGES):
                    raise InputError(key, min(unknown), f"unknown; known: {', '.join(CHANGES)}")
                if sum(what in change for what in ("arguments", "add", "like")) != 1:
                    raise InputError(key, dict(change), "one of arguments, add, like")
                if "arguments" in change:
                    if len(change) > 1:
                        raise InputError(key, dict(change), "arguments stand alone in a change")
                    arguments |= change["arguments"]
                else:
                    changes.append((key, change))
        tables = self._tables(arguments)
        successor, probability = tables.successor.copy(), tables.probability.copy()
        reward = tables.reward.copy()
        for key, change in changes:
            at = np.zeros(successor.shape[:2], dtype=bool)
            at[:, self._numbers(key, change.get("actions", self.actions))] = True
            at &= self._where(key, change.get("when", {}))[:, None]
            if "like" in change:
                if "next" in change:
                    raise InputError(key, dict(change), "like goes with when and actions only")
                if change["like"] == STAY:
                    own = np.arange(len(successor))[:, None, None]
                    successor = np.where(at[:, :, None], own, successor)
                else:
                    (other,) = self._numbers(key, [change["like"]])
                    successor[at] = tables.successor[np.nonzero(at)[0], other]
                    probability[at] = tables.probability[np.nonzero(at)[0], other]
                    reward[at] = tables.reward[np.nonzero(at)[0], other]
            else:
                reached = self._where(key, change.get("next", {}))[successor]
                reward[at[:, :, None] & reached] += number(f"{key}.add", change["add"])
        return MDP(successor, probability, reward, self.discount, tables.terminal)

    def _tables(self, arguments: Mapping[str, Any]) -> Tables:
        """The environment's own model, made with some other arguments."""
        key = repr(sorted(arguments.items()))
        if key not in self._variants:
            self._variants[key] = read_model(self._id, self._arguments | dict(arguments))
            if len(self._variants[key].terminal) != len(
                next(iter(self._variants.values())).terminal
            ):
                raise InputError("domain.parameters", dict(arguments), "changes the states")
        return self._variants[key]

    def _where(self, key: str, condition: Mapping[str, Any]) -> NDArray[np.bool_]:
        """[S] the states that a condition names."""
        if not isinstance(condition, Mapping):
            raise InputError(key, condition, "{feature: value, or a list of values}")
        result = np.ones(len(self._codes), dtype=bool)
        for feature, wanted in condition.items():
            if feature not in self._values:
                raise InputError(
                    key, feature, f"unknown feature; known: {', '.join(self.feature_names)}"
                )
            known = self._values[feature]
            listed = (
                wanted if isinstance(wanted, Sequence) and not isinstance(wanted, str) else [wanted]
            )
            for value in listed:
                if value not in known:
                    raise InputError(
                        f"{key}.{feature}", value, f"one of {', '.join(map(str, known))}"
                    )
            codes = [known.index(value) for value in listed]
            result &= np.isin(self._codes[:, self.feature_names.index(feature)], codes)
        return result

    def _numbers(self, key: str, names: Iterable[str]) -> list[int]:
        """The numbers of actions."""
        names = [names] if isinstance(names, str) else list(names)
        for name in names:
            if name not in self.actions:
                raise InputError(key, name, f"unknown action; known: {', '.join(self.actions)}")
        return [self.actions.index(name) for name in names]

    def position(self, state: int) -> Cell | None:
        """The robot's cell, where the states have a row and a column."""
        if "row" not in self._values or "column" not in self._values:
            return None
        code = dict(zip(self.feature_names, self._codes[state], strict=True))
        return int(code["row"]), int(code["column"])

    def describe(self, transition: NDArray[np.int64]) -> str:
        """The action and what changes: "south: row 2 → 3", "pick up: passenger red → taxi"."""
        state, action, after = (int(x) for x in transition)
        changed = [
            f"{feature} {values[self._codes[state, f]]} → {values[self._codes[after, f]]}"
            for f, (feature, values) in enumerate(self._values.items())
            if self._codes[state, f] != self._codes[after, f]
        ]
        return f"{self.actions[action]}: {', '.join(changed) or 'stays'}"

    @property
    def scene(self) -> Scene | None:
        """The map, where the states have a row and a column."""
        if "row" not in self._values or "column" not in self._values:
            return None
        rows, columns = len(self._values["row"]), len(self._values["column"])
        return Scene(rows, columns, (), tuple(self._items))


def read_model(id: str, arguments: Mapping[str, Any]) -> Tables:
    """The model that an environment shows as ``env.unwrapped.P[s][a]``, a list of (probability,
    next state, reward, terminated).

    Raises:
        XplainError: gymnasium is not installed.
        InputError: there is no such environment, it shows no model, or a state ends some
            episodes and not others.
    """
    try:
        import gymnasium
    except ImportError:
        raise XplainError(
            "domain: Gymnasium environments need gymnasium: pip install 'xplain[gym]'"
        ) from None
    try:
        environment = gymnasium.make(id, **arguments)
    except (gymnasium.error.Error, TypeError, ValueError, KeyError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError("domain.id", id, f"gymnasium cannot make it: {reason}") from None
    table = getattr(environment.unwrapped, "P", None)
    initial = getattr(environment.unwrapped, "initial_state_distrib", None)
    environment.close()
    if not isinstance(table, Mapping):
        raise InputError("domain.id", id, "an environment with a tabular model (env.unwrapped.P)")
    states, actions = len(table), len(table[0])
    slots = max(len(outcomes) for row in table.values() for outcomes in row.values())
    successor = np.zeros((states, actions, slots), dtype=np.int64)
    probability, reward = np.zeros(successor.shape), np.zeros(successor.shape)
    ended = np.zeros(successor.shape, dtype=bool)
    for s, row in table.items():
        for a, outcomes in row.items():
            for k, (p, after, r, terminated) in enumerate(outcomes):
                successor[s, a, k], probability[s, a, k] = after, p
                reward[s, a, k], ended[s, a, k] = r, terminated
    terminal = np.zeros(states, dtype=bool)
    terminal[successor[ended & (probability > 0)]] = True
    starts = np.flatnonzero(np.ones(states) if initial is None else np.asarray(initial) > 0)
    # Tables also hold states that no episode reaches, with outcomes that make no sense.
    reached = np.zeros(states, dtype=bool)
    frontier = starts[~terminal[starts]]
    while len(frontier):
        reached[frontier] = True
        after = np.unique(successor[frontier][probability[frontier] > 0])
        frontier = after[~reached[after] & ~terminal[after]]
    goes_on = reached[:, None, None] & (probability > 0) & ~ended
    if (goes_on & terminal[successor]).any():
        raise InputError("domain.id", id, "an environment whose end depends on the state alone")
    return Tables(successor, probability, reward, terminal, starts)


def _values(feature: str, given: int | Sequence[str]) -> list[Any]:
    """A feature's values, by number."""
    if isinstance(given, int) and not isinstance(given, bool) and given >= 1:
        return list(range(given))
    if isinstance(given, Sequence) and not isinstance(given, str) and given:
        return list(given)
    raise InputError(f"domain.states.{feature}", given, "how many values, or a list of their names")
