"""Ask first, then explain: a reference for solvers that weigh what a question is worth.

Before the first step it asks the question whose answer tells the most of what is hidden (greedy
mutual information), whatever it costs, as long as there is any news and ``ask.most`` allows; from
then on it is QMDP.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Positive, checks
from xplain.explanation.asking import NO_QUESTION
from xplain.explanation.message_sets import compress
from xplain.explanation.problem import Problem
from xplain.solvers.base import Knowledge, Policy
from xplain.solvers.inquiry import Inquiry, look, make_inquiry, make_room
from xplain.solvers.qmdp import greedy_policy


@checks("solver")
@dataclass(frozen=True)
class AskFirst:
    """Args:
    memory_gib: most that QMDP's tables may take.
    """

    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation, as :class:`xplain.solvers.base.Solver` says."""
        policy = greedy_policy(problem, "ask_first", self.memory_gib, "qhr plans without tables")
        if problem.questions is None:
            return policy
        kept = problem.messages_with_effect
        return Curious(policy, make_inquiry(problem.with_messages(kept)), kept)


@dataclass(frozen=True)
class Curious:
    """Asks for whatever is news.

    Attributes:
        policy: decides on messages.
        inquiry: the questions, over the messages kept.
        kept: their positions in the whole problem.
    """

    policy: Policy
    inquiry: Inquiry
    kept: tuple[int, ...]

    def question(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """As :class:`xplain.solvers.base.Asks` says."""
        if step or given:
            return NO_QUESTION
        room = make_room(self.inquiry, asked, 1)
        sure = np.ascontiguousarray(belief)
        found = look(self.inquiry, step, compress(given, self.kept), sure, room)
        return int(room.found[0]) if found else NO_QUESTION

    def messages(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """As :class:`xplain.solvers.base.Asks` says."""
        return self.policy.messages(step, given, belief)

    def values(
        self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0
    ) -> Mapping[int, float]:
        """QMDP's, of messages alone: questions are not weighed."""
        return self.policy.values(step, given, belief)
