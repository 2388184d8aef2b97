"""What a plan lets one expect, from simulated observers, before anybody is asked.

How well the types are found (adjusted Rand index), and what explanations for them then cost above
what they would cost if every label were known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Domain, transition_feature_names
from xplain.domains.users.setting import Setting
from xplain.domains.users.types import TypeSource
from xplain.experiment.explanations import Costs, evaluate
from xplain.experiment.pipeline import Components, prepare
from xplain.explanation.belief import Persistent
from xplain.interaction.explainees import Exact
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.encoding import align
from xplain.learning.data.observers import Observed
from xplain.learning.data.queries import Queries
from xplain.learning.fact_model.dirichlet import DirichletMixture
from xplain.learning.fact_sets.labeler import HypothesisTrainer
from xplain.people.collect.asking import CollectState, shared
from xplain.people.collect.bot import Habits, bot, take_part
from xplain.people.collect.flow import Collection
from xplain.people.collect.labels import dataset_of, fact_sets
from xplain.people.collect.plan import CollectPlan
from xplain.randomness import derived_seed
from xplain.solvers.known_type import KnownType
from xplain.solvers.qmdp import QMDP

RUNS = 2
"""Simulated collections."""
MORE = 10
TRACES = 5


def crowd(plan: CollectPlan, people: int, habits: Habits, seed: int) -> list[CollectState]:
    """Simulated observers one after the other, the roles in turn."""
    collection = Collection(plan)
    states: list[CollectState] = []
    for number in range(people):
        person = bot(plan, habits, seed, number)
        others = shared([state.belief for state in states])
        role = number % len(plan.roles) if plan.assigned else None
        # Each simulated collection draws questions and their order anew.
        states.append(take_part(collection, person, seed * 10_000 + number, others, role))
    return states


def truth_of(plan: CollectPlan, people: int) -> NDArray[np.int64]:
    """[people] the facts that each simulated observer holds wrong; roles that behave alike are
    one."""
    known = plan.hypotheses
    held = np.array([plan.roles[i % len(plan.roles)].held for i in range(people)])
    return known.essential[known.row(held)]


def rand_index(plan: CollectPlan, states: Sequence[CollectState]) -> float:
    """Adjusted Rand index of the types found in the labels of :func:`crowd`."""
    from sklearn.metrics import adjusted_rand_score

    facts, _ = fact_sets(plan, states)
    return float(adjusted_rand_score(truth_of(plan, len(states)), facts))


def expect(
    plan: CollectPlan, error: float, domain: Domain | None = None, users: TypeSource | None = None
) -> dict[str, float]:
    """The figures: ``people``, ``labels`` a person, ``error``, ``runs``; means over runs of
    ``rand_index`` and, with ten more people, ``rand_index_more``. With a domain ``cost`` of an
    explanation (λ = 1, QMDP), and the clairvoyant's, the ``floor``.

    Args:
        plan: without an expectation.
        error: share of wrong answers of simulated people.
        domain, users: the task, where there is a model of it.
    """
    habits = Habits(error=error, mistake=0.0)
    people = plan.rules.people
    runs = [crowd(plan, people + MORE, habits, seed) for seed in range(RUNS)]
    index = [rand_index(plan, states[:people]) for states in runs]
    found = {
        "people": float(people),
        "labels": float(plan.rules.points),
        "error": error,
        "runs": float(RUNS),
        "rand_index": float(np.mean(index)),
        "rand_index_more": float(np.mean([rand_index(plan, states) for states in runs])),
    }
    if domain is None or users is None:
        return found
    costs = [
        explanation_costs(plan, states[:people], domain, users, seed)
        for seed, states in enumerate(runs)
    ]
    cost, floor = np.mean(costs, axis=0)
    return found | {"cost": float(cost), "floor": float(floor)}


@dataclass(frozen=True)
class Gathered:
    """Labels that were given already, by people whose types are known."""

    dataset: Dataset
    truth: NDArray[np.int64]

    def collect(self, setting: Setting, queries: Queries, seed: int) -> Observed:
        """The labels, with the domain's features in its order."""
        dataset = align(self.dataset, transition_feature_names(setting.domain))
        return Observed(dataset, self.truth, setting)


def explanation_costs(
    plan: CollectPlan, states: Sequence[CollectState], domain: Domain, users: TypeSource, seed: int
) -> tuple[float, float]:
    """The mean cost of explaining traces to users of the roles, with the types found in these
    labels, and with every label known."""
    names = {f"person_{number:03d}": state for number, state in enumerate(states)}
    truth = np.arange(len(states)) % len(plan.roles)
    prepared = prepare(
        Components(
            domain=domain,
            users=users,
            observers=Gathered(dataset_of(plan, names), truth),
            queries=plan.design,
            labeler=HypothesisTrainer(),
            clusterer=DirichletMixture(),
            traces=TRACES,
            max_steps=40,
            seed=plan.seed,
        )
    )
    records = evaluate(
        prepared,
        Costs(1.0, 1.0, 1.0, 0.95, "action", "uniform"),
        {"qmdp": QMDP(), "clairvoyant": KnownType("labels")},
        Persistent("learned"),
        Exact(),
        derived_seed(seed, "expectation"),
    )
    cost = {
        name: float(np.mean([r.episode.cost for r in records if r.solver == name]))
        for name in ("qmdp", "clairvoyant")
    }
    return cost["qmdp"], cost["clairvoyant"]
