"""Value of information: the value of a question for a policy that does not plan to ask.

    VOI(q) = Σ_y P(y | b) V(b_y) − V(b) − κ

(Howard 1966; one question ahead, "myopic"), where b_y is the belief after the answer y, and V(b) is
the return of QMDP's own decisions from the belief b, estimated by simulation. V(b) is not QMDP's
bound, which assumes that the state becomes known at no cost.

Let W(b) = Σ_s b_s V*(k, v, s), where V* are the values of known states. W is linear in b, and
answers do not change its mean. So V(b) is W(b) minus the expected losses of QMDP's decisions, each
relative to a decision in the known state. W cancels in VOI(q), and the losses vary little. So few
simulations are enough if all beliefs share their random numbers. If answers are certain, one
simulation of each state is exact.

Only the questions with the most informative answers (mutual information) are evaluated, as chosen
by :func:`telling_questions`.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.actions import Action, AskQuestion, VisibleState
from xplain.randomness import derive_seed
from xplain.solvers.base import TIE, Policy
from xplain.solvers.pomcp import make_memory, search_model
from xplain.solvers.pomcp_kernel import Memory, roll
from xplain.solvers.process import KnownValues, Process, before_step, hear_answer
from xplain.solvers.search_model import NO_NEWS, SearchModel, rank_questions

LOOKED_INTO = 12
"""Number of most informative questions that are evaluated at a decision."""
ROLLS = 40
"""Number of simulations from a belief."""
FAINT = 1e-6
"""Less likely states are not simulated."""
SPREAD = 0xD1342543DE82EF95
"""Distance between the streams of two simulations."""
WORDS = (1 << 64) - 1


def telling_questions(
    process: Process, visible: VisibleState, belief: NDArray[np.float64], most: int | None = None
) -> tuple[list[int], list[float]]:
    """Lists the possible questions that are informative, most informative first, with the
    information of their answers in nats (:func:`~xplain.solvers.search_model.rank_questions`)."""
    questions, asked = process.questions, visible.asked
    if asked.bit_count() >= questions.most or (questions.first and (visible.step or visible.given)):
        return [], []
    cells = questions.cells.at(before_step(process, visible.given))
    news = np.array([-(asked >> q & 1) for q in range(len(questions.answered))], np.float64)
    rank_questions(questions.answered, questions.likelier, cells, belief, news)
    ranked = [q for q in np.argsort(-news, kind="stable").tolist() if news[q] > NO_NEWS][:most]
    return ranked, news[ranked].tolist()


def with_questions(policy: Policy, process: Process, known: KnownValues, seed: int) -> Policy:
    """Returns a policy that also asks, if the problem has questions; otherwise the same policy."""
    if not len(process.questions.answered):
        return policy
    stream = derive_seed(seed, "value of information")
    return VoiPolicy(policy, process, search_model(process, known), stream)


@dataclass(frozen=True)
class VoiPolicy:
    """Asks the question with the largest positive value of information, if any.

    Attributes:
        policy: decides on messages.
        process, model: the model, and its form for simulations.
        stream: random stream of the simulations.
    """

    policy: Policy
    process: Process
    model: SearchModel
    stream: int

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """Chooses the best question if its value is positive, otherwise the policy's action. Of
        several questions with the largest value, the first is chosen."""
        gains = self._evaluate_questions(visible, belief)
        best = max(gains.values(), default=0.0)
        if best > TIE:
            return AskQuestion(min(q for q, gain in gains.items() if gain >= best - TIE))
        return self.policy.decide(visible, belief)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Returns the policy's values of messages. A question's value is the best message value
        plus the question's value of information."""
        values = dict(self.policy.values(visible, belief))
        best = max(values.values())
        gains = self._evaluate_questions(visible, belief)
        return values | {AskQuestion(q): best + gain for q, gain in gains.items()}

    def _evaluate_questions(
        self, visible: VisibleState, belief: NDArray[np.float64]
    ) -> dict[int, float]:
        """Computes the value of information of each question that is evaluated."""
        questions, _ = telling_questions(self.process, visible, belief, LOOKED_INTO)
        if not questions:
            return {}
        said, gains = before_step(self.process, visible.given), dict[int, float]()
        memory = make_memory(self.process, 1, self.stream)
        now = self._estimate_value(memory, visible.step, said, belief)
        for q in questions:
            gains[q] = -now - self.process.questions.cost
            for answer in (1, 0):
                joint = hear_answer(self.process, belief, said, q, answer)
                share = float(joint.sum())
                if share > 0:
                    gains[q] += share * self._estimate_value(
                        memory, visible.step, said, joint / share
                    )
        return gains

    def _estimate_value(
        self, memory: Memory, step: int, said: int, belief: NDArray[np.float64]
    ) -> float:
        """Estimates the value of QMDP's decisions from a belief [S]."""
        process, model = self.process, self.model
        # If answers are certain, a simulation has no randomness.
        certain = process.jump is None and not (process.answered % 1).any()
        states, weights, streams = _choose_states(belief, 1 if certain else ROLLS)
        seeds = np.array([self.stream + i * SPREAD & WORDS for i in streams], np.uint64)
        missed = None if process.jump is None else True
        _, codes, scratch = memory
        return float(
            roll(model, codes, scratch, missed, step, said, belief, states, weights, seeds)
        )


def _choose_states(
    belief: NDArray[np.float64], rolls: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], list[int]]:
    """Chooses the state of each simulation. Every likely state is simulated equally often. If there
    are more likely states than simulations, the simulated states are spread evenly over the belief.

    Returns:
        The state, the weight and the number of the random stream of each simulation.
    """
    likely = np.flatnonzero(belief > FAINT)
    if rolls > 1 and len(likely) > rolls:
        at = (np.arange(rolls) + 0.5) / rolls
        states = np.minimum(np.searchsorted(np.cumsum(belief), at), len(belief) - 1)
        return states, np.full(rolls, 1 / rolls), list(range(rolls))
    each = max(1, rolls // len(likely))
    streams = [s * ROLLS + i for s in likely.tolist() for i in range(each)]
    states = likely.repeat(each)
    return states, belief[states] / each, streams
