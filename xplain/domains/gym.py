"""Gymnasium environments with a tabular model (``env.unwrapped.P``) as domains.

FrozenLake, CliffWalking, Taxi and other environments with a public model need only a configuration
to become tasks. The robot's values are those of the environment. Each parameter that people may
believe incorrectly is a list of changes of the environment's rewards or transitions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Item, Scene
from xplain.domains.grid import Cell, parameters_of
from xplain.domains.mdp import MDP, find_reached
from xplain.errors import (
    Discount,
    InputError,
    XplainError,
    checks,
    first_line,
    mapping,
    number,
    one_of,
    require_list,
)

EFFECTS = ("add", "like", "to", "arguments")
CHANGES = ("when", "actions", "next", *EFFECTS)
"""Fields of a change; exactly one field of a change is in EFFECTS."""


class Features:
    """The features of a state, encoded in its number in row-major order: the last feature changes
    fastest.

    Args:
        given: ``{feature: number of values, or their names}``.
        n_states: S.

    Raises:
        InputError: the numbers of values do not have the product S.
    """

    def __init__(self, given: Mapping[str, int | Sequence[str]], n_states: int) -> None:
        """Numbers the values of each feature."""
        self.values = {feature: _read_values(feature, values) for feature, values in given.items()}
        self.names = tuple(self.values)
        self.sizes = tuple(len(values) for values in self.values.values())
        if not self.sizes or int(np.prod(self.sizes)) != n_states:
            raise InputError("domain.states", dict(given), f"their product must be {n_states}")
        self.codes = np.stack(np.unravel_index(np.arange(n_states), self.sizes), axis=1)

    def where(self, key: str, condition: Any) -> NDArray[np.bool_]:
        """Returns [S] True for the states that meet ``{feature: value, or a list of values}``."""
        asked = mapping(key, condition, "{feature: value, or a list of values}")
        result = np.ones(len(self.codes), dtype=bool)
        for feature, wanted in asked.items():
            one = isinstance(wanted, str) or not isinstance(wanted, Sequence)
            values = [wanted] if one else wanted
            codes = [self._encode_value(key, feature, value) for value in values]
            result &= np.isin(self.codes[:, self.names.index(feature)], codes)
        return result

    def set_features(self, key: str, target: Any) -> NDArray[np.int64]:
        """Gives features the same new value in all states.

        Args:
            key: the configuration key, for errors.
            target: ``{feature: new value}``.

        Returns:
            [S] for each state, the number of the state with the new values.
        """
        codes = self.codes.copy()
        for feature, value in mapping(key, target, "{feature: value}").items():
            code = self._encode_value(key, feature, value)
            codes[:, self.names.index(feature)] = code
        return np.asarray(np.ravel_multi_index(tuple(codes.T), self.sizes), dtype=np.int64)

    def differences(self, before: int, after: int) -> list[str]:
        """Describes the features that differ between two states, such as "row 2 → 3"."""
        return [
            f"{feature} {values[a]} → {values[b]}"
            for (feature, values), a, b in zip(
                self.values.items(), self.codes[before], self.codes[after], strict=True
            )
            if a != b
        ]

    def _encode_value(self, key: str, feature: str, value: Any) -> int:
        known = self.values[one_of(key, feature, self.names, "feature")]
        return known.index(one_of(f"{key}.{feature}", value, known))


@checks("domain")
class Gymnasium:
    """A tabular Gymnasium environment. State numbers are those of the environment.

    Args:
        id: name of the environment, as in ``gymnasium.make(id, **arguments)``.
        states: the features that a state's number encodes, ``{feature: number of values, or their
            names}``; the last feature changes fastest. These are the labeler's features. The
            features ``row`` and ``column``, if present, give the robot's place on a map.
        actions: names of the actions, by number.
        discount: γ of the task, in (0, 1).
        parameters: ``{name: {inaccurate, message, belief}}``. ``inaccurate`` is a list of changes
            from the environment to the incorrect belief. A change has one of four fields: ``add``,
            a number added to the reward; ``like``, another action, whose outcomes the changed
            actions get; ``to``, new values of features of the next state, while all other features
            keep their values (``{}``: nothing happens); ``arguments``, with which the environment
            is made again before all other changes. ``add``, ``like`` and ``to`` change all states
            and actions, unless two further fields restrict them: ``when``, a condition on the
            state, and ``actions``, names of actions. ``add`` may have a third field: ``next``, a
            condition on the next state. A condition is ``{feature: value, or a list of values}``.
        starts: condition on start states of traces, which are equally likely; terminal states are
            excluded. None: the start states of the environment.
        arguments: arguments of the environment.
        items: for pictures, ``{name: {symbol, cells: [[row, column], ...]}}``. ``shows`` may name
            parameters whose values the item shows: pages for people leave such an item out.
        name: name of the domain.

    Raises:
        XplainError: gymnasium is not installed.
        InputError: a value is not allowed, or the environment has no public model.
    """

    def __init__(
        self,
        id: str,
        states: Mapping[str, int | Sequence[str]],
        actions: Sequence[str],
        discount: Discount,
        parameters: Mapping[str, Mapping[str, Any]],
        starts: Mapping[str, Any] | None = None,
        arguments: Mapping[str, Any] | None = None,
        items: Mapping[str, Mapping[str, Any]] | None = None,
        name: str = "gymnasium",
    ) -> None:
        """Makes the environment, reads its model and tries every change."""
        self.name, self._id, self._arguments = name, id, dict(arguments or {})
        self.discount = discount
        self._own, self.starts = read_model(id, self._arguments, discount)
        n_states, n_actions, _ = self._own.successor.shape
        self.actions = tuple(actions)
        if len(self.actions) != n_actions or len(set(self.actions)) < n_actions:
            raise InputError("domain.actions", actions, f"{n_actions} different names for {id}")
        self._features = Features(states, n_states)
        self.feature_names = self._features.names
        self.state_features = self._features.codes.astype(np.float64)
        if starts is not None:
            here = self._features.where("domain.starts", starts) & ~self._own.terminal
            self.starts = np.flatnonzero(here)
        if not len(self.starts):
            raise InputError("domain.starts", starts, "at least one state that is not terminal")
        given = mapping("domain.parameters", parameters, "{name: {inaccurate, message}}")
        # The robot's value is the unchanged environment.
        unchanged = {
            key: {"accurate": [], **fields} if isinstance(fields, Mapping) else fields
            for key, fields in given.items()
        }
        self.parameters = parameters_of(unchanged, tuple(parameters))
        accurate: dict[str, Any] = {parameter.name: [] for parameter in self.parameters}
        for parameter in self.parameters:
            self.model(accurate | {parameter.name: parameter.inaccurate})
        self._items = [
            Item(
                item,
                fields["symbol"],
                tuple((int(r), int(c)) for r, c in fields["cells"]),
                shows=tuple(
                    one_of(f"domain.items.{item}.shows", name, accurate, "parameter")
                    for name in fields.get("shows", ())
                ),
            )
            for item, fields in (items or {}).items()
        ]

    def model(self, values: Mapping[str, Any]) -> MDP:
        """Returns the environment as a person with these values believes it to be.

        Raises:
            InputError: a change is not allowed.
        """
        changes = [
            (f"domain.parameters.{parameter.name}", change)
            for parameter in self.parameters
            for change in _check_changes(
                f"domain.parameters.{parameter.name}", values[parameter.name]
            )
        ]
        start = self._own
        arguments = [change["arguments"] for _, change in changes if "arguments" in change]
        if arguments:
            every = {k: v for one in (self._arguments, *arguments) for k, v in one.items()}
            start, _ = read_model(self._id, every, self.discount)
            if start.successor.shape[:2] != self._own.successor.shape[:2]:
                raise InputError("domain.parameters", arguments, "arguments that keep the states")
        successor, probability = start.successor.copy(), start.probability.copy()
        reward = start.reward.copy()
        for key, change in changes:
            at = np.zeros(successor.shape[:2], dtype=bool)
            at[:, self._number_actions(key, change.get("actions", self.actions))] = True
            at &= self._features.where(key, change.get("when", {}))[:, None]
            if "add" in change:
                reached = self._features.where(key, change.get("next", {}))[successor]
                reward[at[:, :, None] & reached] += number(f"{key}.add", change["add"])
            elif "to" in change:
                led = self._features.set_features(key, change["to"])[:, None, None]
                successor = np.where(at[:, :, None], led, successor)
            elif "like" in change:
                (other,) = self._number_actions(key, [change["like"]])
                s = np.nonzero(at)[0]
                successor[at] = start.successor[s, other]
                probability[at] = start.probability[s, other]
                reward[at] = start.reward[s, other]
        return replace(start, successor=successor, probability=probability, reward=reward)

    def _number_actions(self, key: str, names: Any) -> list[int]:
        """Returns the numbers of the actions with these names."""
        return [self.actions.index(one_of(key, name, self.actions, "action")) for name in names]

    def position(self, state: int) -> Cell | None:
        """Returns the robot's cell; None if states have no row or no column."""
        if not {"row", "column"} <= set(self.feature_names):
            return None
        code = dict(zip(self.feature_names, self._features.codes[state], strict=True))
        return int(code["row"]), int(code["column"])

    def describe(self, transition: NDArray[np.int64]) -> str:
        """Describes the action and its effects: "south: row 2 → 3", "pick up: passenger red →
        taxi"."""
        state, action, after = (int(x) for x in transition)
        changed = ", ".join(self._features.differences(state, after))
        return f"{self.actions[action]}: {changed or 'nothing changes'}"

    @property
    def scene(self) -> Scene | None:
        """The map; None if states have no row or no column."""
        if not {"row", "column"} <= set(self.feature_names):
            return None
        rows, columns = (len(self._features.values[name]) for name in ("row", "column"))
        return Scene(rows, columns, (), tuple(self._items))


def _check_changes(key: str, value: Any) -> list[Mapping[str, Any]]:
    """Checks that the inaccurate value of a parameter is a list of changes, and returns the
    list."""
    for change in require_list(key, value, "a list of changes"):
        for field in mapping(key, change, f"a change with {', '.join(CHANGES)}"):
            one_of(key, field, CHANGES, "field")
        if sum(effect in change for effect in EFFECTS) != 1:
            raise InputError(key, dict(change), f"one of {', '.join(EFFECTS)}")
        if "arguments" in change and len(change) > 1:
            raise InputError(key, dict(change), "a change with arguments has no other field")
        if "next" in change and "add" not in change:
            raise InputError(key, dict(change), "next needs add")
        require_list(f"{key}.actions", change.get("actions", []), "a list of actions")
        mapping(f"{key}.arguments", change.get("arguments", {}), "{argument: value}")
    return list(value)


MODEL = (
    "states 0 … n − 1 and actions 0 … m − 1 in env.unwrapped.P[s][a], a list of (probability, "
    "next state, reward, terminated) with probabilities that add up to 1"
)
"""The required model of an environment."""
BROKEN = (TypeError, ValueError, LookupError, RuntimeError, ImportError, AttributeError, OSError)
"""Errors that an environment's own code may raise when it is created."""


def read_model(
    id: str, arguments: Mapping[str, Any], discount: float
) -> tuple[MDP, NDArray[np.int64]]:
    """Reads an environment's model ``env.unwrapped.P[s][a]``, lists of (probability, next state,
    reward, terminated), and the states where episodes start. An action without an entry is not
    available in that state; a state without actions ends episodes.

    Raises:
        XplainError: gymnasium is not installed.
        InputError: there is no such environment, it has no public model, or a state ends some
            episodes and not others.
    """
    try:
        import gymnasium
    except ImportError:
        raise XplainError(
            "domain: Gymnasium environments need gymnasium: pip install 'xplain-hri[gym]'"
        ) from None
    try:
        environment = gymnasium.make(id, **arguments)
        table = getattr(environment.unwrapped, "P", None)
    except (gymnasium.error.Error, *BROKEN) as error:
        raise InputError(
            "domain.id", id, f"gymnasium cannot make it: {first_line(error)}"
        ) from None
    environment.close()
    if table is None:
        raise InputError("domain.id", id, "an environment with a tabular model (env.unwrapped.P)")
    try:
        rows = [
            ((_to_int(s), _to_int(a), k, _to_int(after)), (float(p), float(r), bool(end)))
            for s, row in _list_pairs(table)
            for a, outcomes in _list_pairs(row)
            for k, (p, after, r, end) in enumerate(x for x in outcomes if float(x[0]))
        ]
        s, a, k, after = np.array([numbers for numbers, _ in rows]).T
        listed = [_to_int(state) for state, _ in _list_pairs(table)]
        inner = environment.unwrapped  # wrappers may have other spaces
        spaces = (getattr(inner, f"{x}_space", None) for x in ("observation", "action"))
        most = max(after.max(), *listed), a.max()
        states, actions = (getattr(x, "n", n + 1) for x, n in zip(spaces, most, strict=True))
        initial = getattr(environment.unwrapped, "initial_state_distrib", None)
        start = np.ones(states) if initial is None else np.asarray(initial, np.float64).ravel()
        successor = np.zeros((states, actions, k.max() + 1), dtype=np.int64)
        outcome = np.zeros((3, *successor.shape))  # probability, reward, 1 if the episode ends
        successor[s, a, k], outcome[:, s, a, k] = after, np.array([x for _, x in rows]).T
        probability, reward, ended = outcome[0], outcome[1], outcome[2] > 0
        total = probability.sum(axis=2)
        sound = np.isclose(total[total != 0], 1).all() and (probability >= 0).all()
        numbered = min(s.min(), a.min(), after.min(), *listed) >= 0 and after.max() < states
        if not (sound and numbered and np.isfinite(reward).all() and len(start) <= states):
            raise ValueError("not a model")
    except (TypeError, ValueError, LookupError, AttributeError):
        raise InputError("domain.id", id, MODEL) from None
    terminal = (probability == 0).all(axis=(1, 2))  # states without a row
    led = np.zeros(states, dtype=bool)
    led[successor[ended]] = True
    # The row of a state that ends episodes may lead anywhere, for example to the start.
    stays = successor == np.arange(states)[:, None, None]
    terminal[successor[ended & (stays | ~led[:, None, None])]] = True
    starts = np.flatnonzero(start > 0)
    # Tables also contain unreachable states with meaningless outcomes.
    possible = (probability > 0) & ~terminal[:, None, None]
    met = find_reached(starts, states, lambda s: successor[s][possible[s]])
    goes_on = met[:, None, None] & possible & ~ended
    if len(torn := successor[goes_on & terminal[successor]]):
        reason = f"state {torn[0]} ends some episodes and not others, or lacks a row"
        raise InputError("domain.id", id, f"an end that depends on the state alone: {reason}")
    return MDP(successor, probability, reward, discount, terminal), starts[~terminal[starts]]


def _list_pairs(table: Any) -> Any:
    """Returns the (key, value) pairs of a mapping, or the (index, value) pairs of a list."""
    return table.items() if isinstance(table, Mapping) else enumerate(table)


def _to_int(value: Any) -> int:
    """Converts the number of a state or an action to an integer; whole floats are accepted, too.

    Raises:
        ValueError: the value is no whole number.
    """
    if isinstance(value, str) or int(value) != value:
        raise ValueError("not a whole number")
    return int(value)


def _read_values(feature: str, given: Any) -> list[Any]:
    """Returns the values of a feature, in the order of their numbers: 0, 1, … if ``given`` is a
    number of values, or the names in the list ``given``."""
    if isinstance(given, (int, np.integer)) and not isinstance(given, bool) and given >= 1:
        return list(range(int(given)))
    if isinstance(given, Sequence) and not isinstance(given, str) and given:
        return list(given)
    raise InputError(f"domain.states.{feature}", given, "how many values, or a list of their names")
