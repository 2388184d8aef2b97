"""A session: one trace explained to one user, by names (paper, "Explaining a plan trace")."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError
from xplain.explanation.label_table import joined
from xplain.message_sets import indices, mask_of, names_of
from xplain.sessions.interaction import Interaction
from xplain.sessions.planner import Planner
from xplain.solvers.base import Policy

FORMAT = 1
"""Version of a session's JSON."""


@dataclass(frozen=True)
class Why:
    """The values behind a decision.

    Attributes:
        step: transitions shown before it.
        given: messages given before it.
        belief: in each type, by name.
        chosen: the messages that it gave; none is *explain* at once.
        values: estimated discounted return by the messages given next, the best first; ``()`` is
            *explain* at once. Some solvers weigh messages one at a time.
    """

    step: int
    given: tuple[str, ...]
    belief: Mapping[str, float]
    chosen: tuple[str, ...]
    values: Mapping[tuple[str, ...], float]

    def __str__(self) -> str:
        lines = [f"step {self.step + 1}: {', '.join(self.chosen) or 'nothing to say'}"]
        lines += [
            f"  {value:9.3f}  {', '.join(names) or 'say nothing more'}"
            for names, value in self.values.items()
        ]
        return "\n".join(lines)


class Session:
    """One trace, one user. Made by :meth:`xplain.Explainer.session`.

    Each step: :meth:`messages` to say, then the first ``shown`` transitions to show, then
    :meth:`observe` with the user's labels of them. :meth:`extend` at any time.
    """

    def __init__(self, planner: Planner, expected_steps: int = 0) -> None:
        self._planner = planner
        self._expected_steps = expected_steps
        self._trace: list[Any] = []
        self._table = planner.unknown(0)
        problem = planner.problem(planner.unknown(1))
        self._talk = Interaction(problem, planner.plan(problem), planner.beliefs)
        self._said: list[int] = []
        self._answers: list[NDArray[np.uint8]] = []
        self._decision: tuple[Policy, int, int, NDArray[np.float64]] | None = None

    @property
    def trace(self) -> tuple[Any, ...]:
        """All transitions known so far, in order, as they were given."""
        return tuple(self._trace)

    @property
    def shown(self) -> int:
        """How many transitions are shown to the user at this step."""
        return len(self._answers) + (not self.finished)

    @property
    def finished(self) -> bool:
        """Whether the user has labelled the whole trace known so far."""
        return len(self._answers) == len(self._trace)

    @property
    def said(self) -> tuple[str, ...]:
        """Names of all messages given so far, sorted."""
        return self._names(self._talk.given)

    @property
    def again(self) -> tuple[str, ...]:
        """Names of the messages of this step that had been said before, as users may miss or
        forget some."""
        *earlier, now = self._said or [0]
        return self._names(now & int(np.bitwise_or.reduce(np.array([0, *earlier]))))

    @property
    def belief(self) -> dict[str, float]:
        """``{type: probability}``, given all labels so far; they sum to 1."""
        return self._by_name(self._talk.belief)

    @property
    def cost(self) -> float:
        """Definition 2 of the paper for what happened so far, undiscounted."""
        problem = self._talk.problem
        said = sum(float(problem.message_cost[j]) for new in self._said for j in indices(new))
        zeros = sum(int((labels == 0).sum()) for labels in self._answers)
        return problem.trade_off * said + problem.inexplicability_cost * zeros

    def extend(self, transitions: Sequence[Any] | NDArray[Any]) -> None:
        """The robot did (or plans) more: they follow the known transitions.

        The next decision is planned with them. What was said and answered stays.

        Raises:
            InputError: a transition that ``types`` does not take.
        """
        new = [
            row.tolist() if isinstance(row, (np.ndarray, np.generic)) else row
            for row in transitions
        ]
        if not new:
            return
        table = joined([self._table, self._planner.types.label_table(new)])
        known = len(self._trace) + len(new)
        ahead = self._planner.unknown(max(self._expected_steps - known, 0))
        problem = self._planner.problem(joined([table, ahead]))
        self._talk.problem, self._talk.policy = problem, self._planner.plan(problem)
        if problem.tracks_knowledge:  # more facts may matter now, and a belief is over these
            self._talk.begin()
            for k, said in enumerate(self._said):
                self._talk.give(said)
                if k < len(self._answers):
                    self._talk.hear(self._answers[k])
        self._table = table
        self._trace += new

    def messages(self) -> tuple[str, ...]:
        """The messages to say now, before the first ``shown`` transitions are shown; none if it
        is best to say nothing. Asked again before :meth:`observe`, it answers the same.

        Raises:
            InputError: every transition known is answered.
        """
        if len(self._said) == len(self._answers):
            if self.finished:
                raise InputError("session", len(self._trace), "is finished; extend the trace first")
            self._decide()
            self._said.append(self._talk.say())
        return self._names(self._said[-1])

    def tell(self, names: Sequence[str]) -> None:
        """Says these messages at this step, whatever the plan.

        Raises:
            InputError: :meth:`messages` was called already, or a message is unknown, or was given
                and cannot have been missed.
        """
        if len(self._said) > len(self._answers) or self.finished:
            raise InputError("session", tuple(names), "told once a step, before messages()")
        new = mask_of(names, self._talk.problem.message_names, "session")
        if new & self._talk.given and not self._talk.problem.tracks_knowledge:
            raise InputError("session", tuple(names), f"not given before, as {self.said} were")
        self._decide()
        self._talk.give(new)
        self._said.append(new)

    def observe(self, labels: ArrayLike) -> None:
        """The user's labels of the first ``shown`` transitions, 1 = explicable.

        Raises:
            InputError: not so many labels, others than 0 and 1, or nothing was asked.
        """
        if len(self._said) == len(self._answers):
            raise InputError("labels", labels, "messages() comes first")
        given = np.asarray(labels)
        if given.shape != (self.shown,) or not np.isin(given, (0, 1)).all():
            wanted = f"{self.shown} labels, 0 or 1 for each transition shown so far"
            raise InputError("labels", given.tolist(), wanted)
        answer = given.astype(np.uint8)
        self._talk.hear(answer)
        self._answers.append(answer)

    def why(self) -> Why:
        """The values behind the last decision.

        Raises:
            InputError: nothing was decided yet.
        """
        if self._decision is None:
            raise InputError("session", 0, "messages() comes first")
        policy, step, given, belief = self._decision
        values = policy.values(step, given, belief)
        ranked = sorted(values.items(), key=lambda item: -item[1])
        return Why(
            step=step,
            given=self._names(given),
            belief=self._by_name(belief),
            chosen=self._names(self._said[-1]),
            values={self._names(mask): value for mask, value in ranked},
        )

    def to_json(self) -> str:
        """The whole session as text; :meth:`xplain.Explainer.from_json` takes it up again.

        Raises:
            InputError: a transition is nothing that JSON can hold.
        """
        state = {
            "format": FORMAT,
            "messages": self._planner.types.messages,
            "types": self._planner.types.names,
            "trace": self._trace,
            "expected_steps": self._expected_steps,
            "said": [self._names(mask) for mask in self._said],
            "answers": [answer.tolist() for answer in self._answers],
        }
        try:
            return json.dumps(state)
        except TypeError as error:
            raise InputError("trace", self._trace[0], f"transitions for JSON ({error})") from None

    def _decide(self) -> None:
        """Keeps what the decision rests on, for :meth:`why`."""
        talk = self._talk
        self._decision = (talk.policy, talk.step, talk.given, talk.belief)

    def _by_name(self, belief: NDArray[np.float64]) -> dict[str, float]:
        problem = self._talk.problem
        return dict(zip(problem.type_names, problem.type_belief(belief).tolist(), strict=True))

    def _names(self, mask: int) -> tuple[str, ...]:
        return names_of(mask, self._talk.problem.message_names)
