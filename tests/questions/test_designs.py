"""Designs that ask simulated observers find their types with few labels. One list for everybody
separates all candidates, by the definition, and is short."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.domains.users.corridor import Corridor
from tests.questions.tables import random_hypotheses
from xplain import InputError, Questionnaire, Setting, UserType
from xplain.domains.users.hypotheses import Hypotheses, hypotheses_of
from xplain.learning.data.observers import Observations, SimulatedObservers
from xplain.learning.mixture.labeler import HypothesisTrainer
from xplain.learning.mixture.sampler import DirichletMixture
from xplain.questions import designs
from xplain.questions.designs import Adaptive, Battery, battery, transitions_of


@pytest.fixture(scope="module")
def setting():
    domain = Corridor()
    types = (
        UserType("end", {"end": "left"}),
        UserType("toll", {"toll": -5.0}),
        UserType("both", {"end": "left", "toll": -5.0}),
    )
    return Setting.build(domain, types)


@pytest.mark.parametrize(
    "design",
    [
        Adaptive(),
        Adaptive(clip=3),
        Adaptive(in_turn=True),
        Adaptive(clip=3, in_turn=True),
        Battery(),
    ],
)
def test_few_labels_find_the_types(setting, design):
    """Three types of two facts, one answer in twenty wrong."""
    crowd = SimulatedObservers(per_type=3, points=14, label_noise=0.05)
    trainer = HypothesisTrainer(hypotheses=hypotheses_of(setting.domain, None))
    observed = crowd.collect(setting, design, 0)
    data, truth = observed.dataset, observed.truth
    assert len(data) == 14 * 9
    found = DirichletMixture(labeler=trainer).cluster(Observations(data), 0)
    assert found.rule == "hypotheses"
    assert found.assignment.tolist() == truth.tolist()


def test_later_observers_start_from_those_before(setting, monkeypatch):
    """Half of a prior is the mean of the earlier posteriors; the other half is the hypotheses'
    prior."""
    made = []

    class Kept(Questionnaire):
        def replace_hypotheses(self, hypotheses, prior):
            made.append(super().replace_hypotheses(hypotheses, prior))
            return made[-1]

    monkeypatch.setattr(designs, "Questionnaire", Kept)

    def answer(observer, transitions, told):
        return setting.labels(observer % 3, transitions, told)

    Adaptive(from_others=0.5).ask(setting, np.full(4, 8), answer, 0)
    own = made[0].hypotheses.prior
    assert made[0].given_prior == pytest.approx(own)
    for o in range(1, 4):
        before = np.mean([q.posterior / q.posterior.sum() for q in made[:o]], axis=0)
        assert made[o].given_prior == pytest.approx(0.5 * own + 0.5 * before)
        assert np.abs(made[o].given_prior - own).max() > 0.1


def asked_of(setting, design, sizes, types):
    """Records the questions to each observer."""

    def answer(observer, transitions, told):
        return setting.labels(types[observer], transitions, told)

    found = design.ask(setting, np.array(sizes), answer, 0)
    return [(a.transitions.tolist(), a.message_sets.tolist()) for a in found]


def test_in_turn_the_others_answers_tell_and_nothing_else_differs(setting):
    """If the prior ignores others, the order of observers has no effect. Otherwise the first
    observer gets other questions if others answer otherwise, unless this observer finishes before
    them."""
    alone = {"from_others": 0.0, "check": 0.0}
    one, other = (
        asked_of(setting, Adaptive(in_turn=in_turn, **alone), [6, 6, 6], [0, 1, 2])
        for in_turn in (False, True)
    )
    assert one == other
    nobody_else = [
        asked_of(setting, Adaptive(in_turn=in_turn, from_others=0.9, check=0.0), [8], [2])
        for in_turn in (False, True)
    ]
    assert nobody_else[0] == nobody_else[1]
    for in_turn in (False, True):
        design = Adaptive(in_turn=in_turn, from_others=0.9, check=0.0)
        first = [asked_of(setting, design, [8] * 5, [0, *[others] * 4])[0] for others in range(3)]
        assert (first[0] == first[1] == first[2]) is not in_turn


def test_hypotheses_must_be_about_the_robots_transitions(setting):
    full = Hypotheses.of_domain(setting.domain)
    names = full.messages
    few = Hypotheses.of(full.labels[:, :3], messages=names)
    assert np.array_equal(
        transitions_of(Hypotheses.of(full.labels, messages=names), setting), setting.reachable
    )
    with pytest.raises(InputError, match="transitions that the robot can make"):
        transitions_of(few, setting)
    with pytest.raises(InputError, match="must be end, toll"):
        transitions_of(Hypotheses.of(full.labels), setting)
    order = np.array([2, 0])  # with features they may be some of these, in any order
    part = Hypotheses.of(full.labels[:, order], messages=names, features=full.features[order])
    assert np.array_equal(transitions_of(part, setting), setting.reachable[order])
    foreign = Hypotheses.of(full.labels, messages=names, features=full.features + 50)
    with pytest.raises(InputError, match="transitions that the robot can make in corridor"):
        transitions_of(foreign, setting)
    with pytest.raises(InputError, match=r"queries\.check=1"):
        Adaptive(check=1.0)


@pytest.mark.parametrize(("check", "least", "most"), [(0.0, 0.0, 0.1), (0.5, 0.2, 0.7)])
def test_once_somebody_is_known_a_share_of_questions_asks_whether_that_is_all(
    setting, monkeypatch, check, least, most
):
    """The messages about all facts of the hypotheses are given, so everybody whom a hypothesis fits
    finds the transition explicable. No such question comes before the person's incorrect beliefs
    are known."""
    checked = []

    class Kept(Questionnaire):
        def answer(self, label, question=None):
            transitions, told = question
            if told == 0b11:
                assert self.done
                checked.append(self.hypotheses.labels[0, transitions].all())
            super().answer(label, question)

    monkeypatch.setattr(designs, "Questionnaire", Kept)

    def answer(observer, transitions, told):
        return setting.labels(observer % 3, transitions, told)

    asked = Adaptive(check=check).ask(setting, np.full(6, 40), answer, 0)
    assert all(checked)
    shares = [np.mean(one.message_sets == 0b11) for one in asked]
    assert least <= np.mean(shares) <= most


def test_who_holds_wrong_what_nobody_wrote_down_is_found(setting, tmp_path):
    """The hypotheses contain only the fact about the end; a third of the observers believe in the
    toll. Questions that no hypothesis would ask show that the message about the toll helps them."""
    full = Hypotheses.of_domain(setting.domain)
    end = Hypotheses.of(
        full.labels[:2], np.arange(2), full.messages, features=full.features,
        feature_names=full.feature_names,
    )  # fmt: skip
    end.save(tmp_path / "end.npz")
    path = str(tmp_path / "end.npz")
    crowd = SimulatedObservers(per_type=3, points=40)
    observed = crowd.collect(setting, Adaptive(hypotheses=path), 0)
    data, truth = observed.dataset, observed.truth
    found = DirichletMixture(labeler=HypothesisTrainer(path=path)).cluster(Observations(data), 0)
    needs = found.needs[found.assignment]
    assert (needs[truth == 0] == 0b01).all()
    assert (needs[truth > 0] & 0b10 > 0).all()


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
    short, long = battery(h, 1, 3), battery(h, 1, 3, at_least=40)
    assert len(long[0]) >= 40
    for i in range(40):  # each separates some pair that was separated least often
        before, after = (separated(h, long[0][:n], long[1][:n]) for n in (i, i + 1))
        least = min(before.values())
        assert any(after[pair] > least for pair, times in before.items() if times == least)
    enough = battery(h, 1, 3, at_least=len(short[0]))
    for one, same, other in zip(short, enough, long, strict=True):
        assert np.array_equal(one, other[: len(one)])
        assert np.array_equal(one, same)
