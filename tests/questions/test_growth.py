"""Growing lists of candidates agree with the list of all sets, and a labeler's table over the
messages that matter with the whole table."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.domains.configs import setting_of
from tests.domains.example import warehouse
from xplain.domains.base import transition_features
from xplain.domains.users.hypotheses import Hypotheses, hypotheses_of
from xplain.domains.users.setting import Setting, UserType
from xplain.explanation.message_sets import mask_of
from xplain.learning.data.observers import Observations, SimulatedObservers
from xplain.learning.data.queries import Independent
from xplain.learning.mixture.labeler import MOST, HypothesisTrainer
from xplain.learning.mixture.likelihood import LIKELY, grow, posterior_by
from xplain.learning.mixture.sampler import DirichletMixture
from xplain.questions.designs import Adaptive

FACTS = 6


@cache
def every_set() -> Hypotheses:
    return Hypotheses.of_domain(warehouse(FACTS))


@cache
def few_sets(most: int) -> Hypotheses:
    return Hypotheses.of_domain(warehouse(FACTS), most=most)


@pytest.mark.parametrize("most", [1, 3])
def test_with_all_sets_it_is_the_whole_table(most):
    whole = few_sets(most).with_sets(np.arange(1 << FACTS))
    assert np.array_equal(whole.facts, every_set().facts)
    assert np.array_equal(whole.tables, every_set().tables)
    assert np.array_equal(whole.essential, every_set().essential)


@given(st.integers(0, 10_000), st.integers(1, 2))
@settings(deadline=None, max_examples=12)
def test_the_posterior_is_that_over_all_sets_within_the_list(seed, most):
    """The posterior agrees within the list, and the list has the neighbours of every likely set."""
    rng = np.random.default_rng(seed)
    every = every_set()
    person = int(rng.integers(0, 1 << FACTS))
    transitions = rng.integers(0, every.n_transitions, 60)
    told = rng.integers(0, 1 << FACTS, 60)
    labels = every.labels[person & ~told, transitions].astype(np.int64)
    answers = transitions, told, labels
    found = grow(few_sets(most), lambda known: posterior_by(known, *answers))
    own = posterior_by(found, *answers)
    whole = few_sets(most).with_sets(np.arange(1 << FACTS))
    dense = posterior_by(whole, *answers)[found.facts]
    assert own == pytest.approx(dense / dense.sum(), abs=1e-9)
    for likely in found.facts[own >= LIKELY].tolist():
        assert np.isin(likely | 1 << np.arange(FACTS), found.facts).all()


@cache
def many_facts() -> tuple[Setting, tuple[int, ...]]:
    """Makes sixteen facts, whose 2^16 sets no list can hold, and types of up to five facts."""
    domain = warehouse(16)
    wrong = {p.name: p.inaccurate for p in domain.parameters}
    names = list(wrong)
    sets = ((0, 5), (1, 3, 7, 12, 15), (2, 5, 9, 14))
    types = tuple(
        UserType(f"T{i}", {names[j]: wrong[names[j]] for j in own}) for i, own in enumerate(sets)
    )
    masks = tuple(mask_of(one.inaccurate, names) for one in types)
    return Setting.build(domain, types), masks


def test_types_of_more_facts_than_the_list_begins_with_are_found():
    setting, masks = many_facts()
    begun = hypotheses_of(setting.domain, None)
    assert not begun.complete
    assert max(int(held).bit_count() for held in begun.facts) < 5
    crowd = SimulatedObservers(per_type=2, points=40)
    observed = crowd.collect(setting, Adaptive(), 0)
    data, truth = observed.dataset, observed.truth
    trainer = HypothesisTrainer().adapt_to(observed)
    found = DirichletMixture(labeler=trainer).cluster(Observations(data), 0)
    assert found.assignment.tolist() == truth.tolist()
    features = transition_features(setting.domain, setting.reachable)
    for t, mask in enumerate(masks):
        labeler = trainer.fit(data.of(found.members(t)), 0)
        found_table = labeler.table(features)
        (relevant,), table = found_table.rows, found_table.p[:, :, 0]
        assert len(relevant) <= MOST
        silent = setting.labels(t, setting.reachable, np.zeros(len(features), dtype=np.int64))
        assert ((table[:, 0] > 0.5) == silent).mean() > 0.97
        assert (table[:, -1] > 0.5).all()  # told all that it looks at, everything is explicable
        shown = sum(1 << int(j) for j in relevant)
        assert (setting.labels(t, setting.reachable, np.full(len(features), shown)) == 1).all()
        assert shown & mask


def test_the_table_over_what_matters_is_the_whole_table(monkeypatch):
    setting = setting_of("domain=rescue")
    observed = SimulatedObservers(1, 40).collect(setting, Independent(), 0)
    labeler = HypothesisTrainer().adapt_to(observed).fit(observed.dataset.of(np.array([0])), 0)
    transitions = setting.reachable[::9]
    asked = [(transition_features(setting.domain, transitions), x) for x in (None, transitions)]
    whole = [labeler.table(*one) for one in asked]
    for module in ("xplain.learning.labelers", "xplain.learning.mixture.labeler"):
        monkeypatch.setattr(f"{module}.DENSE", 0)
    for one, table in zip(asked, whole, strict=True):
        assert table.rows == [list(range(6))] * table.n_types
        assert labeler.table(*one).array(6) == pytest.approx(table.array(6), abs=1e-9)
