"""From a plan to its policies at work, and what they decide for participants drawn at random."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from hydra.utils import instantiate

from xplain.explanation.label_table import LabelTable, joined
from xplain.interaction.episode import Episode, explain
from xplain.interaction.explainees import SimulatedUser
from xplain.people.study.flow import Study
from xplain.people.study.plan import ASKING, StudyPlan
from xplain.randomness import derived_seed
from xplain.solvers.base import CachedPolicy


def at_work(plan: StudyPlan) -> Study:
    """A plan with its policies, made from its conditions' configurations."""
    seed = derived_seed(plan.seed, "solver")
    policies = {
        condition: instantiate(solver).plan(plan.problem_of(condition), seed)
        for condition, solver in plan.conditions.items()
    }
    if ASKING in policies:
        # Which of two questions that are as good comes first shall not hang on rounding.
        policies[ASKING] = CachedPolicy(policies[ASKING])
    return Study(plan, policies, instantiate(plan.belief))


def difference(plan: StudyPlan) -> float:
    """How many messages (and questions) more or fewer a faultless participant gets under one
    condition than under another, on average over the types; of the two conditions that are most
    alike."""
    given = {
        condition: [(one.n_messages, one.n_questions) for one in met]
        for condition, met in faultless(at_work(plan)).items()
    }
    pairs = combinations(given.values(), 2)
    gaps = [np.abs(np.subtract(one, other)).sum(axis=1).mean() for one, other in pairs]
    return float(min(gaps, default=np.inf))


def faultless(study: Study) -> dict[str, list[Episode]]:
    """What people who never err meet under each condition, one of each kind."""
    plan = study.plan
    found: dict[str, list[Episode]] = {condition: [] for condition in study.policies}
    for condition, policy in study.policies.items():
        for person in range(len(plan.true_labels)):
            labels = LabelTable.dense(plan.true_labels[[person]])
            if plan.clip_labels is not None:
                labels = joined([labels, plan.clip_labels.of_types([person])])
            problem = plan.problem_of(condition)
            found[condition].append(explain(problem, policy, SimulatedUser(labels), study.belief))
    return found
