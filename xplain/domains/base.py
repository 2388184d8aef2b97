"""The interface of a domain: a robot's task with parameters that people may believe incorrectly
(docs/method.md, section 1)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from xplain.domains.mdp import TaskModel


@dataclass(frozen=True)
class Parameter:
    """A value of the task that people may believe incorrectly, with sentences about it.

    Attributes:
        name: name of the parameter and of its message.
        accurate: the robot's value.
        inaccurate: the value that a user may believe instead.
        message: the sentence with the robot's value.
        belief: the sentence of a user with the inaccurate value (for briefings).
    """

    name: str
    accurate: Any
    inaccurate: Any
    message: str
    belief: str = ""


@dataclass(frozen=True)
class Item:
    """A thing on the map: cells (row, column) with a common symbol and name.

    Attributes:
        labels: text for each cell in pictures; if empty, pictures show the symbol.
        shows: names of the parameters whose values the item shows. Pages for people leave such an
            item out, because a participant may believe a different value.
    """

    name: str
    symbol: str
    cells: tuple[tuple[int, int], ...]
    labels: tuple[str, ...] = ()
    shows: tuple[str, ...] = ()


@dataclass(frozen=True)
class Scene:
    """A map for people, in reports, on the study's pages, and on terminals.

    Attributes:
        rows, columns: numbers of rows and columns of the grid.
        walls: cells that cannot be entered.
        items: the things on the map.
    """

    rows: int
    columns: int
    walls: tuple[tuple[int, int], ...] = ()
    items: tuple[Item, ...] = field(default_factory=tuple)


@runtime_checkable
class Domain(Protocol):
    """A task model as a function of its parameters' values.

    Attributes:
        name: name of the domain.
        parameters: in the order of the messages.
        actions: names of the model's actions.
        state_features: [S, F] float64, the features of a state that a labeler may use.
        feature_names: F names.
        starts: [n] int64 start states of traces, equally likely.
    """

    name: str
    parameters: tuple[Parameter, ...]
    actions: tuple[str, ...]
    state_features: NDArray[np.float64]
    feature_names: tuple[str, ...]
    starts: NDArray[np.int64]

    def model(self, values: Mapping[str, Any]) -> TaskModel:
        """Returns the task of a person with these beliefs.

        Args:
            values: the believed value of each parameter, by its name.
        """
        ...

    def describe(self, transition: NDArray[np.int64]) -> str:
        """Describes a transition (s, a, s') by a short phrase: "moves right to (2, 3)"."""
        ...

    def position(self, state: int) -> tuple[int, int] | None:
        """Returns the robot's cell (row, column); None if the domain has no map."""
        ...

    @property
    def scene(self) -> Scene | None:
        """The map for people: size, walls, items; None if the domain has no map."""
        ...


def transition_feature_names(domain: Domain) -> tuple[str, ...]:
    """Returns the names of the columns of :func:`transition_features`."""
    return (
        *domain.feature_names,
        *(f"action={action}" for action in domain.actions),
        *(f"next_{name}" for name in domain.feature_names),
    )


def transition_features(domain: Domain, transitions: NDArray[np.int64]) -> NDArray[np.float64]:
    """Returns the features [T, 2F + A] of transitions [T, 3]: the features of the state (F), the
    action one-hot (A), and the features of the next state (F) (docs/method.md, section 3)."""
    s, a, after = transitions.T
    action = np.eye(len(domain.actions))[a]
    return np.hstack([domain.state_features[s], action, domain.state_features[after]])


def cell_name(row: int, column: int) -> str:
    """Returns a cell's name: a letter for the column, and the row from 1, such as "B3"."""
    letters = ""
    column += 1
    while column:
        column, digit = divmod(column - 1, 26)
        letters = chr(ord("A") + digit) + letters
    return f"{letters}{row + 1}"


def changes_of(domain: Domain, transitions: NDArray[np.int64]) -> tuple[tuple[str, ...], ...]:
    """Describes the effects of each of m transitions [m, 3] by short phrases, for pictures without
    a map. The result is empty if the domain has no method ``changes(transition)``."""
    describe = getattr(domain, "changes", None)
    return (
        () if describe is None else tuple(tuple(describe(transition)) for transition in transitions)
    )
