"""Questions by what labels have taught: the model's probabilities against a sum over all that
might be true, and what is asked because of them."""

from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xplain.domains.base import transition_features
from xplain.domains.users.setting import Setting, UserType
from xplain.errors import InputError
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.observers import SimulatedObservers
from xplain.learning.data.queries import Independent
from xplain.learning.fact_model.gibbs import init
from xplain.learning.fact_model.model import CELL, NOISE, SUBSET, Prior, SortedLabels
from xplain.learning.labelers import LabelerTrainer
from xplain.questions.candidates import Candidates
from xplain.questions.committee import next_screen, p_explicable
from xplain.questions.designs import Adaptive
from xplain.testing import Chosen, QueriesConformance


class TestWithoutHypotheses(QueriesConformance):
    chosen = Chosen("queries", "adaptive", "queries.hypotheses=none")


def dataset_of(transitions, facts, rows):
    """Labels (observer, transition, message set, label) of two observers."""
    columns = np.array(rows, dtype=np.int64).reshape(-1, 4).T
    return Dataset(
        features=np.arange(transitions, dtype=np.float64)[:, None],
        feature_names=("place",),
        messages=tuple(f"m{j}" for j in range(facts)),
        observers=("a", "b"),
        observer=columns[0],
        transition=columns[1],
        message_set=columns[2],
        label=columns[3].astype(np.uint8),
    )


def plainly(data, held_wrong, observer, transition, told, depth):
    """P(f = 1 | labels) at a transition: a sum over the facts that matter there, the noise, and
    all tables of labels."""
    n = data.n_messages
    rows = np.flatnonzero(data.transition == transition)
    held = held_wrong[data.observer] & ~data.message_set
    over = np.zeros(2)
    for size in range(depth + 1):
        for chosen in combinations(range(n), size):
            matter = sum(1 << j for j in chosen)
            asked = {
                int(held_wrong[data.observer[p]] & ~data.message_set[p] & matter) for p in rows
            }
            own = int(held_wrong[observer] & ~told & matter)
            cells = sorted(asked | {own})
            share = SUBSET**size / len(list(combinations(range(n), size)))
            for table in product((0, 1), repeat=len(cells)):
                f = dict(zip(cells, table, strict=True))
                prior = share * np.prod(
                    [CELL[int(c == 0)] if f[c] else 1 - CELL[int(c == 0)] for c in cells]
                )
                for noise in NOISE:
                    likelihood = 1.0
                    for p in rows:
                        agrees = f[int(held[p] & matter)] == data.label[p]
                        likelihood *= 1 - noise if agrees else noise
                    over[f[own]] += prior * likelihood / len(NOISE)
    return over[1] / over.sum()


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=15)
def test_the_model_sums_over_what_might_be_true(seed):
    rng = np.random.default_rng(seed)
    rows = np.stack([rng.integers(0, top, 9) for top in (2, 3, 8, 2)], axis=1)
    data, held = dataset_of(3, 3, rows), rng.integers(0, 8, 2)
    prior = Prior.of(3, 2)
    state = init(SortedLabels.of(data), prior, held)
    told = rng.integers(0, 8, 3)
    found = p_explicable(data, 1, told, prior, state)
    for t, k in product(range(3), range(3)):
        assert found[t, k] == pytest.approx(plainly(data, held, 1, t, int(told[k]), 2))


def test_at_first_nobody_is_told_anything_and_the_robots_way_is_asked_about():
    weight = np.array([0.0, 3.0, 1.0, 0.0, 2.0])
    asked = next_screen(dataset_of(5, 2, []), 0, weight, 3, np.random.default_rng(0))
    assert sorted(asked.transition.tolist()) == [1, 2, 4]
    assert not asked.message_set.any()


def firsts(rows, transitions=6, facts=2, draws=60, weight=None):
    """The first question of many screens after these labels: (transition, message set)."""
    data = dataset_of(transitions, facts, rows)
    weight = np.ones(transitions) if weight is None else weight
    found = []
    for seed in range(draws):
        one = next_screen(data, 0, weight, 1, np.random.default_rng(seed))
        found.append((int(one.transition[0]), int(one.message_set[0])))
    return found


def test_what_all_agree_on_is_hardly_asked_and_what_is_odd_is():
    """Transitions 0 to 4 were explicable ten times however explained, 5 not when unexplained:
    with which of the messages it is, nobody has said."""
    rows = [(o, t, told, 1) for o in (0, 1) for t in range(5) for told in range(4)] * 3
    rows += [(o, 5, 0, 0) for o in (0, 1)] * 3
    asked = firsts(rows)
    about_odd = [told for t, told in asked if t == 5]
    assert len(about_odd) > 0.8 * len(asked)
    assert np.mean(np.array(about_odd) != 0) > 0.8


def test_where_the_robot_goes_often_is_asked_more():
    rows = [(0, 0, 0, 1), (0, 0, 3, 1)]
    weight = np.array([1.0, 0.0, 30.0, 1.0, 1.0, 1.0])
    asked = [t for t, _ in firsts(rows, weight=weight)]
    assert asked.count(2) > 0.6 * len(asked)
    assert asked.count(1) == 0


def test_a_screen_asks_about_a_transition_once():
    rows = [(0, t, t % 4, t % 2) for t in range(6)]
    asked = next_screen(dataset_of(6, 2, rows), 1, np.ones(6), 6, np.random.default_rng(0))
    assert sorted(asked.transition.tolist()) == list(range(6))


def test_many_messages_are_no_hindrance():
    """Twenty messages have a million message sets; saying all of them stays among the choices."""
    told = [0, (1 << 20) - 1, 5, 77]
    rows = [(o, t, told[t], 1 - t % 2) for o in (0, 1) for t in range(4)]
    asked = next_screen(dataset_of(4, 20, rows), 0, np.ones(4), 4, np.random.default_rng(0))
    assert len(asked.message_set) == 4
    assert (asked.message_set < 1 << 20).all()


def right(setting, design, seed):
    """Labels that trees get right, of all transitions and message sets, by 60 labels each."""
    crowd = SimulatedObservers(2, 60, 0.05)
    observed = crowd.collect(setting, design, seed)
    data, truth = observed.dataset, observed.truth
    features = transition_features(setting.domain, setting.reachable)
    labels = setting.label_table(setting.reachable)
    hits = []
    for kind in range(len(setting.types)):
        labeler = LabelerTrainer().fit(data.of(np.flatnonzero(truth == kind)), seed)
        table = labeler.table(features).array(setting.n_messages)[0] > 0.5
        hits.append((table == labels[kind]).mean())
    return np.mean(hits)


def test_trees_learn_more_from_it_than_from_random_questions():
    """The shipped rescue map: two types, one answer in twenty wrong."""
    domain = Chosen("domain", "rescue").component
    wrong = {p.name: p.inaccurate for p in domain.parameters}
    types = tuple(
        UserType(name, {fact: wrong[fact] for fact in facts})
        for name, facts in (("A", ("fire", "rubble")), ("B", ("first_aid", "fence")))
    )
    setting = Setting.build(domain, types)
    chosen = [right(setting, Adaptive(hypotheses="none", screen=20), seed) for seed in range(2)]
    random = [right(setting, Independent(), seed) for seed in range(2)]
    assert np.mean(chosen) > np.mean(random) + 0.02


def test_the_first_question_is_about_what_the_robot_does_by_how_often_it_does_it():
    """One question: each transition by its weight. Two: never the same."""
    nothing = dataset_of(4, 2, [])
    weight, count = np.array([5.0, 0.0, 3.0, 2.0]), 4000
    rng = np.random.default_rng(0)
    first = [next_screen(nothing, 0, weight, 1, rng).transition[0] for _ in range(count)]
    share, expected = np.bincount(first, minlength=4) / count, weight / 10
    assert (abs(share - expected) <= 5 * (expected * (1 - expected) / count) ** 0.5).all()
    pairs = [next_screen(nothing, 1, weight, 2, rng).transition.tolist() for _ in range(50)]
    assert all(one != other for one, other in pairs)


def test_of_transitions_that_share_their_features_one_is_drawn_by_its_visits():
    """Three of one row of features, of which the first comes half of the time; -0 is 0."""
    features = np.array([[1.0], [0.0], [1.0], [1.0]])
    pool = Candidates.of(features, ("x",), np.array([3.0, 1.0, 2.0, 1.0]))
    assert pool.weight.tolist() == [1, 6]
    assert pool.features.tolist() == [[0], [1]]
    count = 6000
    drawn = pool.draw(np.ones(count, dtype=np.int64), np.random.default_rng(0))
    share = np.bincount(drawn, minlength=4) / count
    expected = np.array([1 / 2, 0, 1 / 3, 1 / 6])
    assert (abs(share - expected) <= 5 * (expected * (1 - expected) / count) ** 0.5).all()
    assert pool.draw(np.array([0, 0]), np.random.default_rng(0)).tolist() == [1, 1]
    answers = pool.unanswered(("m",))
    told = replace(answers, features=np.array([[1.0], [-0.0]]), transition=np.array([1, 0, 1]))
    assert pool.answered(told).transition.tolist() == [0, 1, 0]
    with pytest.raises(InputError, match=r"'x': 7\.0"):
        pool.answered(replace(told, features=np.array([[1.0], [7.0]])))


def test_a_screen_has_a_question():
    with pytest.raises(InputError, match=r"queries\.screen"):
        Adaptive(screen=0)
