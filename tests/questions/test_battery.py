"""One list for everybody: it separates all candidates, by the definition, and is short."""

from itertools import combinations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.questions.tables import random_hypotheses
from xplain.domains.users.hypotheses import Hypotheses
from xplain.questions.designs import battery


def separated(hypotheses, transitions, told):
    """Counts one by one how many questions separate each two classes of candidates."""
    facts = hypotheses.facts.tolist()
    found = {}
    for one, other in combinations(range(len(facts)), 2):
        if hypotheses.classes[one] != hypotheses.classes[other]:
            found[one, other] = sum(
                hypotheses.labels[facts.index(facts[one] & ~h), t]
                != hypotheses.labels[facts.index(facts[other] & ~h), t]
                for t, h in zip(transitions.tolist(), told.tolist(), strict=True)
            )
    return found


@given(st.integers(0, 10_000), st.integers(1, 3))
@settings(deadline=None, max_examples=30)
def test_every_pair_is_separated_as_often_as_asked_and_no_oftener(seed, redundancy):
    h = random_hypotheses(seed)
    assert min(separated(h, *battery(h, redundancy, seed)).values()) >= redundancy
    transitions, told = battery(h, 1, seed)
    assert min(separated(h, transitions[:-1], told[:-1]).values()) == 0


def test_six_facts_seen_one_by_one_need_six_questions():
    h = Hypotheses.of(1 - (np.arange(64)[:, None] >> np.arange(6) & 1))
    transitions, told = battery(h)
    assert sorted(transitions.tolist()) == list(range(6))
    assert not told.any()  # no message needs to be read


def test_each_transition_is_asked_about_before_one_is_asked_about_again():
    """Three transitions give the same information about each of two facts."""
    h = Hypotheses.of(np.repeat(1 - (np.arange(4)[:, None] >> np.arange(2) & 1), 3, axis=1))
    for seed in range(5):
        transitions, told = battery(h, 3, seed)
        assert sorted(transitions.tolist()) == list(range(6))
        assert not told.any()


def test_of_questions_that_separate_the_same_the_shortest_is_asked():
    """The first transition shows fact 0; the second transition shows it after the message about
    fact 1."""
    held = np.arange(4)
    h = Hypotheses.of(np.stack([(held & 1) == 0, held == 0], axis=1))
    for seed in range(20):
        transitions, told = battery(h, 1, seed)
        assert (1, 0b10) not in zip(transitions.tolist(), told.tolist(), strict=True)


def test_a_longer_list_begins_with_the_shorter():
    h = random_hypotheses(2)
    short, long = battery(h, seed=3), battery(h, seed=3, at_least=40)
    assert len(long[0]) >= 40
    for one, other in zip(short, long, strict=True):
        assert np.array_equal(one, other[: len(one)])
