"""Dual mode asks if a question lowers the cost."""

from dataclasses import replace

import numpy as np
import pytest
from dual_mode import DualMode

from xplain.explanation.actions import AskQuestion, VisibleState
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.habits import habits_of
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.solvers.evaluate import evaluate


@pytest.mark.parametrize("error", [0.0, 0.1])
@pytest.mark.parametrize("accept", [1.0, 0.7])
def test_it_asks_whatever_users_are_like(error: float, accept: float) -> None:
    """Each type needs another message. A question with cost 0.01 identifies the type."""
    p = np.full((2, 3, 4), 0.05)
    p[0, :, 1::2], p[1, :, 2:] = 0.95, 0.95
    problem = Problem(p, np.full(2, 0.5), discount=1.0)
    clip = np.full((2, 1, 4), 0.05)
    clip[1] = 0.95
    asking = replace(problem, questions=Questions(LabelTable.dense(clip), Limits(0.01)))
    habits = habits_of(error, accept, 0.0)
    asking, problem = asking.with_habits(habits), problem.with_habits(habits)
    policy = DualMode().plan(asking)
    assert policy.decide(VisibleState(), asking.start) == AskQuestion(0)
    silent = DualMode().plan(problem)
    assert evaluate(asking, policy).cost < evaluate(problem, silent).cost - 0.1
