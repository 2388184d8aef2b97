"""Users of types without observers think according to the task that they believe in."""

from dataclasses import replace

import numpy as np
import pytest

from tests.configurations import composed, world
from xplain.experiment.explanations import (
    COMPARED,
    WAYS,
    Costs,
    estimate_costs,
    evaluate,
    problem_of_types,
)
from xplain.experiment.from_config import components_of
from xplain.experiment.pipeline import with_others
from xplain.explanation.anybody import Open
from xplain.explanation.belief import Independent, fact_sets
from xplain.interaction.explainees import (
    AllWrong,
    Backlash,
    Between,
    Expert,
    Explainee,
    Misreads,
    Sticky,
    Union,
    Unseen,
)
from xplain.solvers.greedy import QMDP, KnownType
from xplain.solvers.simple import SayAll

TRUE = ("domain=rescue", "labeler=truth", "clusterer=perfect", "traces=3")
RESCUE = {
    "A": {"fire", "rubble"},
    "B": {"first_aid", "fence"},
    "C": {"fire", "puddle"},
    "D": {"first_aid", "rubble"},
    "E": {"refuel", "puddle"},
}


def wrong_of(explainee: Explainee, name: str, told: set[str]) -> set[str]:
    """Returns the facts that the user of this name believes incorrectly after these messages."""
    match explainee:
        case AllWrong():
            return set.union(*RESCUE.values()) - told
        case Union():
            one, other = name.split(" and ")
            return (RESCUE[one] | RESCUE[other]) - told
        case Unseen():
            return set(name.removeprefix("unseen ").split("+")) - told
    return RESCUE[name.removesuffix(", backlash")] ^ told


@pytest.mark.parametrize("explainee", [AllWrong(), Union(), Unseen(), Backlash()])
def test_their_labels_are_those_of_the_task_that_they_believe_in(explainee: Explainee) -> None:
    components, observed = components_of(composed(*TRUE)), world(*TRUE)[0]
    others = with_others(observed, components, explainee)
    domain, names = components.domain, observed.messages
    assert others.types
    for t, name in enumerate(others.types):
        parts = name.removeprefix("unseen ").split("+")
        assert len(parts) == len(set(parts))
        assert others.distinct[t] not in observed.distinct
        for given in (0, 1, 21, 63):
            told = {names[j] for j in range(6) if given >> j & 1}
            wrong = wrong_of(explainee, name, told)
            values = {
                one.name: one.inaccurate if one.name in wrong else one.accurate
                for one in domain.parameters
            }
            model = domain.model(values)
            (solved,) = model.solve([model], ["them"])
            for case in others.cases:
                labels = case.labels.label_probabilities(len(case.transitions), given)[t]
                assert np.array_equal(labels, solved.labels(case.transitions))


@pytest.mark.parametrize("explainee", [Expert(), Between(), Misreads(), Sticky(0.4)])
def test_nobody_costs_less_than_their_own_clairvoyant(explainee: Explainee) -> None:
    """Without a discount this holds, because the clairvoyant plans with this person's thoughts."""
    costs = Costs(1.0, 1.0, 1.0, 1.0, "action", "uniform")
    solvers = {"clairvoyant": KnownType("labels"), "qmdp": QMDP(), "everything": SayAll()}
    records = evaluate(world(*TRUE)[0], costs, solvers, Independent(), explainee, 3)
    paid = {(one.solver, one.trace, one.user_type): one.episode.cost for one in records}
    for (solver, trace, user), own in paid.items():
        assert own >= paid["clairvoyant", trace, user] - 1e-9, solver


@pytest.mark.parametrize("way", range(4))
def test_estimated_costs_are_those_of_people_like_the_observers(way: int) -> None:
    """With true types, and with people who answer what they think the estimate is exact. If people
    answer at random, explanations that use their types are not the cheapest."""
    prepared, costs = world(*TRUE)[0], Costs(1.0, 1.0, 1.0, 0.95, "action", "uniform")
    people = np.array([(facts, 0, way) for facts in fact_sets(prepared.wrong)])
    found = estimate_costs(replace(prepared, doubted=people), costs)
    records = evaluate(prepared, costs, COMPARED, Open(), WAYS[way], 1)
    for name, own in found.items():
        paid = np.mean([one.episode.cost for one in records if one.solver == name])
        assert abs(own.mean - paid) <= (1e-9 if way == 0 else 3 * (own.high - own.mean))
    # Each set of facts may be believed incorrectly.
    assert problem_of_types(prepared, prepared.cases[0], costs, Open()).n_types >= 1 << 6
    assert way < 3 or min(found, key=lambda name: found[name].mean) != "these types"
