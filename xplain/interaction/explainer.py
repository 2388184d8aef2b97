"""What people embed: an explainer for users of unknown type.

    types ── Explainer ── session(trace) ── messages() / observe(labels) ── … ── finished

See docs/explainer.md.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, whole_number
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.interaction.moves import Candidate, candidates, check_texts
from xplain.interaction.planner import Planner
from xplain.interaction.session import FORMAT, Session


@dataclass(frozen=True)
class GivenTypes:
    """User types as a table or a function.

    Attributes:
        table: [N, T, 2^n], a transition being its index among T; or a function from a list of
            transitions (whatever they are) to such a table of them. With many messages a
            ``LabelTable.by_type(relevant, tables)`` takes the place of the array.
        messages: n names.
        names: N names.
        prior: [N]; empty for all alike.
        habits: how they listen and answer, where that was learned.
    """

    table: ArrayLike | LabelTable | Callable[[Sequence[Any]], ArrayLike | LabelTable]
    messages: tuple[str, ...]
    names: tuple[str, ...]
    prior: ArrayLike = ()
    habits: Habits | None = None

    def __post_init__(self) -> None:
        """Raises InputError for a table of other widths, or one of zeros."""
        if not callable(self.table) and not self._fitting(self.table).p.any():
            raise InputError("table", 0, "probabilities that a label is 1; all of these are 0")

    def _fitting(self, table: ArrayLike | LabelTable) -> LabelTable:
        """A table of these types and messages.

        Raises:
            InputError: it has other numbers of them.
        """
        types, n = len(self.names), len(self.messages)
        made = table if isinstance(table, LabelTable) else LabelTable.dense(table)
        if made.n_types != types:
            raise InputError("table", made.n_types, f"{types} types, as there are names")
        if not isinstance(table, LabelTable) and made.relevant.shape[1] != n:
            wanted = f"2**{n} = {1 << n} sets of {n} messages, as there are names"
            raise InputError("table", 1 << made.relevant.shape[1], wanted)
        return made

    def label_table(self, transitions: Sequence[Any]) -> LabelTable:
        """See :class:`~xplain.interaction.planner.Types`.

        Raises:
            InputError: an index outside the table.
        """
        if callable(self.table):
            made = self._fitting(self.table(transitions))
            if len(made.p) != len(transitions):
                raise InputError("table", len(made.p), f"{len(transitions)} rows, one a transition")
            return made
        table = self._fitting(self.table)
        last = len(table.p) - 1
        for index in transitions:
            number = isinstance(index, (int, np.integer)) and not isinstance(index, bool)
            if not number or not 0 <= index <= last:
                raise InputError("trace", index, f"indices 0 … {last} of the table")
        return table.of_steps(transitions)


@dataclass(frozen=True)
class Explainer(Planner):
    """Explains traces to people of unknown type.

    It takes what a :class:`~xplain.interaction.planner.Planner` takes: ``types``, ``solver``,
    ``trade_off``, ``message_cost``, ``inexplicability_cost``, ``discount``, ``discount_per``,
    ``belief_update``, ``seed``, ``ask``.
    """

    def session(
        self,
        trace: Sequence[Any] | NDArray[Any] = (),
        expected_steps: int = 0,
        clips: Sequence[Any] | NDArray[Any] | Mapping[str, Any] = (),
    ) -> Session:
        """Begins to explain a trace to somebody new.

        Args:
            trace: the transitions known already, as ``types`` takes them (learned types: rows of
                features). Give the whole plan where the robot has one.
            expected_steps: transitions that the trace is expected to have in the end. The planner
                takes those not yet known to be explicable to everybody: each shows the prefix
                once more, and that is all. At 0 it takes the trace to end with the last known one.
            clips: transitions that the user may be asked about, on the trace or off it, or those by
                what people call them; the nearest to the trace first.

        Raises:
            InputError: a transition or number that is not allowed, or clips where ``ask`` is None.
        """
        whole_number("expected_steps", expected_steps, 0)
        may_ask = candidates(clips)
        if may_ask and self.ask is None:
            raise InputError(
                "clips", len(may_ask), "none; Explainer(..., ask=Limits()) allows some"
            )
        check_texts(may_ask)
        session = Session(self, expected_steps, may_ask)
        session.extend(trace)
        return session

    def from_json(self, text: str) -> Session:
        """Takes up a session of :meth:`Session.to_json` where it stood, in this process or another.

        The belief is worked out again from the user's answers.

        Raises:
            InputError: no such text, or a session with other messages or types.
        """
        try:
            state = json.loads(text)
            written = state["format"]
            known = {key: tuple(state[key]) for key in ("messages", "types")}
            trace, expected = list(state["trace"]), int(state["expected_steps"])
            clips = [Candidate(*clip) for clip in state["clips"]]
            events = [(str(kind), content) for kind, content in state["events"]]
        except (ValueError, KeyError, TypeError) as error:
            raise InputError("session", text, f"JSON of Session.to_json ({error!r})") from None
        if written != FORMAT:
            raise InputError("session.format", written, str(FORMAT))
        for key, mine in (("messages", self.types.messages), ("types", self.types.names)):
            if known[key] != tuple(mine):
                raise InputError(f"session.{key}", known[key], f"must be {', '.join(mine)}")
        session = self.session(trace, expected, clips)
        session.take_up(events)
        return session
