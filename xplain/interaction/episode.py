"""One episode: a policy explains a trace, step by step, to a user who answers.

docs/method.md, sections 5 and 7.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.actions import AskQuestion
from xplain.explanation.belief import BeliefUpdate
from xplain.explanation.problem import Problem
from xplain.interaction.dialogue import Dialogue, QuestionAnswered, StepLabelled
from xplain.interaction.explainees import SimulatedUser
from xplain.solvers.base import CachedPolicy, messages_of


@dataclass(frozen=True)
class Episode:
    """The record of one explanation of a trace with m transitions.

    Attributes:
        messages: [m] int64, the messages (bitmask) given before each *explain*.
        labels: [m, m] int8; row k has the labels given at step k, and −1 right of the diagonal.
        thoughts: [m, m] int8; row k has the labels that the user truly thinks at step k, and −1
            right of the diagonal. Costs count these labels.
        beliefs: [m + 1, M] beliefs over user types, before the first step and after each step.
        seconds: [m] the time that the policy took for each step's decisions. A cached decision
            counts with the time of its first computation.
        communication: Σ C_e of all messages given (not multiplied by λ).
        inexplicability: Σ C_inexp over all steps and all transitions that are inexplicable at the
            step.
        cost: Definition 2, λ · communication + inexplicability, undiscounted; plus ``asking``.
        asking: the cost of all questions, κ for each.
        fit: P(the user has a found type and the assumed habits) at the end.
        questions: [J, 3] the step, the number and the answer of each question.
    """

    messages: NDArray[np.int64]
    labels: NDArray[np.int8]
    thoughts: NDArray[np.int8]
    beliefs: NDArray[np.float64]
    seconds: NDArray[np.float64]
    communication: float
    inexplicability: float
    cost: float
    asking: float = 0.0
    fit: float = 1.0
    questions: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 3), np.int64))

    @property
    def n_questions(self) -> int:
        """Number of questions asked."""
        return len(self.questions)

    @property
    def n_messages(self) -> int:
        """Number of messages given over all steps, including repeated ones."""
        return sum(int(mask).bit_count() for mask in self.messages)

    @property
    def n_again(self) -> int:
        """Number of repeated messages."""
        return self.n_messages - int(np.bitwise_or.reduce(self.messages)).bit_count()

    @property
    def n_inexplicable(self) -> int:
        """Number of transitions found inexplicable, over all steps."""
        return int((self.thoughts == 0).sum())


def explain(
    problem: Problem,
    policy: CachedPolicy,
    user: SimulatedUser,
    belief_update: BeliefUpdate,
    sees_knowledge: bool = False,
) -> Episode:
    """Explains the whole trace of ``problem`` to ``user``.

    Args:
        problem: the agent's model of users; its costs are counted.
        policy: the policy for that problem; users share its cached decisions.
        user: a new user, who reacts to the trace.
        belief_update: decides which labels change the belief.
        sees_knowledge: True if the agent sees which facts a user of known type believes correctly
            now.

    Raises:
        InputError: the policy repeats a message, or gives one that does not exist.
    """
    m = problem.n_steps
    talk = Dialogue(problem, policy, belief_update)
    labels, thoughts = np.full((2, m, m), -1, dtype=np.int8)
    beliefs = [problem.type_belief(talk.state.belief)]
    seconds = np.zeros(m)
    questions = []
    while (k := talk.state.visible.step) < m:
        if sees_knowledge:
            known = user.kind.find_known(user, talk.state.visible.given)
            talk.state = talk.state._replace(belief=problem.sure(0, known))
        action = talk.decide()
        talk.hear(action)
        seconds[k] += policy.seconds
        given = talk.state.visible.given
        if isinstance(action, AskQuestion):
            answer = user.answer(m + action.question, given)
            talk.hear(QuestionAnswered(answer))
            questions.append((k, action.question, answer))
            continue
        user.hear(messages_of(action))
        thoughts[k, : k + 1], answers = user.react(given, k + 1)
        labels[k, : k + 1] = answers
        talk.hear(StepLabelled(tuple(answers.tolist())))
        beliefs.append(problem.type_belief(talk.state.belief))
    zeros = int((thoughts == 0).sum())
    return Episode(
        np.array(talk.said, np.int64),
        labels,
        thoughts,
        np.array(beliefs),
        seconds,
        problem.communication(talk.said),
        problem.inexplicability_cost * zeros,
        talk.cost(zeros),
        problem.questions.limits.cost * len(questions),
        problem.fit(talk.state.belief),
        np.array(questions, np.int64).reshape(-1, 3),
    )
