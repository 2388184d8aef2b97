"""Compares models of answers with their definitions, sums over all truths or all partitions, and
with people whose errors, classes or missed messages are known."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.special import betaln, gammaln
from sklearn.metrics import adjusted_rand_score

from xplain import Dataset, Hypotheses, LabelerTrainer
from xplain.learning.answers import RATES, AnswerModel, learn_answers
from xplain.learning.data.observers import Observations
from xplain.learning.landing import AcceptanceModel, learn_landing
from xplain.learning.mixture.classes import SHRINKAGE, answer_classes
from xplain.learning.mixture.likelihood import KnownTransitions
from xplain.learning.mixture.partition import learn_ways
from xplain.learning.mixture.sampler import DirichletMixture
from xplain.learning.prediction import predict_held_out


def listed(
    item: np.ndarray, person: np.ndarray, label: np.ndarray, items: int, people: int
) -> Dataset:
    """Makes labels of items with different numbers."""
    features, names = np.arange(float(items))[:, None], tuple(f"o{i:03d}" for i in range(people))
    label = label.astype(np.uint8)
    return Dataset(features, ("item",), (), names, person, item, np.zeros_like(item), label)


def simulated(seed, errors, slips, people=20, each=40, types=4, sure=0.9995):
    """Draws answers of people with these error rates, in turn, to questions with these slips; f is
    mostly as expected. The cells are (type, question)."""
    rng = np.random.default_rng(seed)
    questions = len(slips)
    f = rng.integers(0, 2, (types, questions))
    prior = np.where(f == 1, sure, 1 - sure)
    person = np.repeat(np.arange(people), each)
    question = rng.integers(0, questions, len(person))
    kind = person % types
    thought = f[kind, question]
    said = np.where(rng.random(len(person)) < np.array(slips)[question] * thought, 0, thought)
    error = np.resize(errors, people * types).reshape(types, -1).T.ravel()[:people]
    label = said ^ (rng.random(len(person)) < error[person])
    answers = listed(question, person, label, questions, people)
    return learn_answers(answers, kind * questions + question, prior.ravel()), error


def mean_rate(model):
    return model.person[:-1] @ RATES


@pytest.mark.parametrize("seed", range(3))
def test_who_errs_and_who_does_not_is_told_apart(seed):
    model, error = simulated(seed, [0.0, 0.3], [0.0] * 60)
    assert mean_rate(model)[error == 0].max() < 0.05
    assert mean_rate(model)[error == 0.3].min() > 0.15
    assert model.prior[:2].sum() == pytest.approx(0.5, abs=0.15)
    assert model.prior[3:].sum() == pytest.approx(0.45, abs=0.15)
    assert model.slip.max() < 0.06


@pytest.mark.parametrize("error", [0.05, 0.15])
def test_errors_that_all_share_are_slips(error):
    model, _ = simulated(1, [error], [0.0] * 60, people=60)
    assert model.prior.argmax() == 0
    assert (model.slip[-1] + model.guess[-1]) / 2 == pytest.approx(error, abs=0.03)
    assert model.habits.error @ model.habits.prior == pytest.approx(error, abs=0.03)
    assert mean_rate(model).mean() < 0.02


def test_slips_of_single_questions_are_found():
    slips = [0.3] * 4 + [0.0] * 26
    model, _ = simulated(3, [0.0], slips, people=100)
    assert model.slip[:4] == pytest.approx(0.3, abs=0.1)
    assert model.slip[4:-1].max() < 0.1
    assert model.guess.max() < 0.1


def test_what_most_of_a_type_answer_is_what_they_think():
    """The prior is almost certainly 1, but all people of a type say 0 about ten questions: slips do
    not explain this, although slips are common at first. If only one in four says 0, it is a
    slip."""
    rng = np.random.default_rng(0)
    person = np.repeat(np.arange(8), 60)
    question = np.tile(np.arange(60), 8)
    kind = person // 4
    for contrary, allowed in ((np.arange(8) < 4, 0.05), (np.arange(8) % 4 == 0, 1.0)):
        label = np.where(contrary[person] & (question < 10), 0, 1)
        cell = rng.permutation(120)[kind * 60 + question]
        answers = listed(question, person, label, 60, 8)
        model = learn_answers(answers, cell, np.full(120, 1 - 1e-6), start=0.1)
        assert model.slip[:10].max() < allowed
        assert (mean_rate(model).max() < 0.01) == (allowed < 1)


def test_a_person_is_judged_as_by_the_sum_over_all_truths():
    """No two people share two cells, so that the posterior is exact."""
    cell, person = np.array([0, 1, 2, 2, 3, 4]), np.array([0, 0, 0, 1, 1, 1])
    label = np.array([1, 0, 1, 0, 0, 0])
    prior = np.array([0.9, 0.8, 0.3, 0.6, 0.05])
    model = learn_answers(listed(cell, person, label, 5, 2), cell, prior, steps=500)
    joint = np.zeros((5, 5))
    for f in product((0, 1), repeat=5):
        chance = np.prod(np.where(np.array(f) == 1, prior, 1 - prior))
        for i, j in product(range(5), repeat=2):
            rate = RATES[[i, j]][person]
            thought = np.array(f)[cell]
            one = np.where(thought == 1, 1 - model.slip[cell], model.guess[cell])
            one = one * (1 - rate) + (1 - one) * rate
            share = model.prior[i] * model.prior[j]
            joint[i, j] += share * chance * np.prod(np.where(label == 1, one, 1 - one))
    joint /= joint.sum()
    assert model.person[0] == pytest.approx(joint.sum(axis=1), abs=2e-3)
    assert model.person[1] == pytest.approx(joint.sum(axis=0), abs=2e-3)


def test_what_is_said_of_an_answer_is_a_mean_over_the_persons_rates():
    person = np.array([[1.0, 0, 0, 0, 0], [0, 0, 0, 0, 1], [0.75, 0, 0, 0.25, 0]])
    model = AnswerModel(np.array([0.1, 0.2]), np.array([0.05, 0.2]), person)
    question, who, label = np.array([0, 0, -1]), np.array([0, 1, -1]), np.array([1, 0, 1])
    expected = [
        [0.05, 0.9],
        [0.65 * 0.95 + 0.35 * 0.05, 0.65 * 0.1 + 0.35 * 0.9],
        [0.75 * 0.2 + 0.25 * (0.8 * 0.2 + 0.2 * 0.8), 0.75 * 0.8 + 0.25 * (0.8 * 0.8 + 0.2 * 0.2)],
    ]
    assert np.exp(model.log_given(listed(question, who, label, 2, 2))) == pytest.approx(
        np.array(expected)
    )
    assert model.wrong(question[:1], who[:1]) == pytest.approx((0.1 + 0.05) / 2)


def answered(labels: np.ndarray, asked: np.ndarray | None = None) -> Dataset:
    """Makes labels [O, T] of items with different numbers, only those ``asked`` [O, T]."""
    o, t = np.nonzero(np.ones_like(labels) if asked is None else asked)
    return listed(t, o, labels[o, t], labels.shape[1], len(labels))


def people(seed: int, per_class: int = 60, items: int = 12) -> tuple[Dataset, np.ndarray, float]:
    """Draws people of three classes; items have slips and guesses up to 0.3. Returns also each
    person's class, and the agreement index of a judge who knows all rates."""
    rng = np.random.default_rng(seed)
    true = rng.random((3, items)) < 0.5
    slip, guess = rng.uniform(0, 0.3, (2, items))
    truth = np.repeat(np.arange(3), per_class)
    one = np.where(true, 1 - slip, guess)
    labels = rng.random((len(truth), items)) < one[truth]
    likely = (labels @ np.log(one).T + ~labels @ np.log(1 - one).T).argmax(axis=1)
    return answered(labels), truth, adjusted_rand_score(truth, likely)


def partitions(count: int):
    """Lists all partitions into classes, as the class of each person."""

    def grow(begun: list[int]):
        if len(begun) == count:
            yield np.array(begun)
            return
        for k in range(max(begun, default=-1) + 2):
            yield from grow([*begun, k])

    return list(grow([]))


def restaurant(sizes: np.ndarray) -> float:
    """Computes log P(partition), where α is drawn from an exponential of mean 1."""
    n, k = int(sizes.sum()), len(sizes)

    def weigh(alpha: float) -> float:
        return float(np.exp(k * np.log(alpha) + gammaln(alpha) - gammaln(alpha + n) - alpha))

    return float(np.log(quad(weigh, 0, np.inf)[0]) + gammaln(sizes).sum())


def test_what_is_expected_is_that_of_all_partitions() -> None:
    labels = np.array([[1, 1, 0], [1, 1, 0], [0, 0, 1], [0, 1, 1]])
    asked = np.array([[1, 1, 1], [1, 1, 0], [1, 1, 1], [0, 1, 1]])
    data = answered(labels, asked)
    mean = ((labels * asked).sum(axis=0) + 1) / (asked.sum(axis=0) + 2)
    total, expected, number = 0.0, np.zeros((4, 3)), np.zeros(5)
    for partition in partitions(4):
        member = partition == np.arange(partition.max() + 1)[:, None]
        ones, zeros = member @ (labels * asked), member @ ((1 - labels) * asked)
        prior = restaurant(member.sum(axis=1))
        for c in SHRINKAGE:
            first, second = c * mean, c * (1 - mean)
            evidence = betaln(first + ones, second + zeros) - betaln(first, second)
            weight = np.exp(prior + evidence.sum())
            total += weight
            number[len(member)] += weight
            expected += weight * ((first + ones) / (c + ones + zeros))[partition]
    found = answer_classes(data, 1.0, 20, 0)
    assert found.expected == pytest.approx(expected / total, abs=0.02)
    for k, share in found.posterior.items():
        assert share == pytest.approx(number[k] / total, abs=0.03)


def test_classes_are_found_and_predict_better_than_means() -> None:
    data, truth, at_best = people(0)
    found = DirichletMixture().cluster(Observations(data), 0)
    assert adjusted_rand_score(truth, found.assignment) > at_best - 0.2
    assert found.n_types in (3, 4)
    assert found.expected.shape == (180, 12)
    known = predict_held_out(data, DirichletMixture(), LabelerTrainer(), 0)
    assert known.gain[0] > 0
    assert known.types > max(known.one_type, known.question_mean)
    assert "better" in known.verdict


def test_answers_without_types_support_none() -> None:
    rng = np.random.default_rng(0)
    labels = rng.random((80, 10)) < rng.random(10)
    known = predict_held_out(answered(labels), DirichletMixture(), LabelerTrainer(), 0)
    assert known.gain[0] <= 0
    assert known.types > known.question_mean - 0.02  # and cost next to nothing
    assert "not" in known.verdict


ITEMS, PEOPLE, EVERY = 15, 200, 7
SLIP, GUESS = 0.05, 0.1
FACTS = np.arange(8)
NEEDS = FACTS[1:][np.arange(ITEMS) % 7]
TABLE = (FACTS[:, None] & NEEDS == 0).astype(float)
WRONG = np.array([(w, k) for w in FACTS for k in FACTS if not k & ~w])


def taught(rng: np.random.Generator, accept: NDArray[np.float64]) -> Dataset:
    """Makes answers of people to all items, before and after three messages."""
    wrong = rng.integers(0, 8, PEOPLE)
    landed = (rng.random((PEOPLE, 3)) < accept) @ (1 << np.arange(3))
    one = np.concatenate([TABLE[wrong], TABLE[wrong & ~landed]], axis=1)
    label = rng.random(one.shape) < np.where(one == 1, 1 - SLIP, GUESS)
    person, item = np.indices(one.shape).reshape(2, -1)
    return Dataset(
        features=np.arange(ITEMS, dtype=float)[:, None],
        feature_names=("item",),
        messages=("a", "b", "c"),
        observers=tuple(map(str, range(PEOPLE))),
        observer=person,
        transition=item % ITEMS,
        message_set=np.where(item < ITEMS, 0, EVERY),
        label=label.ravel().astype(np.uint8),
    )


ASSUMED = np.array([0.8 * 0.99, 1 / 15, 1 / 15, 1 / 15, 0.8 * 0.01])
KNOWN = KnownTransitions.of(
    Hypotheses.of(
        TABLE, messages="abc", features=np.arange(ITEMS)[:, None], feature_names=("item",)
    )
)


def answers_one(way: int, wrong: int, kept: int, asked: NDArray, told: NDArray) -> NDArray:
    """Computes P(answer 1) of a person with this way of answering, if one answer in twenty is
    wrong. Somebody of the last way keeps the fact ``kept`` until all messages are given."""
    f = TABLE[wrong & ~np.where((way == 4) & (told < EVERY), told & ~kept, told), asked]
    one = (f, np.where(f == 1, 0.9, 0.1), np.where(f == 1, 1, 0.4), 0.5 + 0 * f, f)[way]
    return np.asarray(0.95 * one + 0.05 * (1 - one))


def joined(people: list[tuple[NDArray, NDArray, NDArray]]) -> Dataset:
    """Makes labels of the transitions, message sets and answers of each person."""
    person = np.arange(len(people)).repeat([len(one[0]) for one in people])
    item, told, label = map(np.concatenate, zip(*people, strict=True))
    return replace(listed(item, person, label, ITEMS, len(people)), message_set=told)


def asks(rng: np.random.Generator, count: int) -> tuple[NDArray, NDArray]:
    """Draws questions; a fifth of them after all messages."""
    told = np.where(rng.random(count) < 0.2, EVERY, rng.integers(0, 8, count))
    return rng.integers(0, ITEMS, count), told


def keep_others(shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Makes no share but the first smaller than the assumed one."""
    return np.array([1 - np.maximum(shares, ASSUMED)[1:].sum(), *np.maximum(shares, ASSUMED)[1:]])


@pytest.mark.parametrize(
    "counts",
    [(3, 3, 3, 3, 3), (15, 0, 0, 0, 0), (0, 15, 0, 0, 0), (0, 0, 10, 0, 5), (7, 0, 0, 8, 0)],
)
def test_shares_of_peoples_ways_are_recovered(counts: tuple[int, ...]) -> None:
    """Half of the result is the assumed shares, however many observers there are. Ways that
    are drawn for observers are the true ones, because the answers are many."""
    rng, people = np.random.default_rng(0), []
    for way in np.arange(5).repeat(counts).repeat(3).tolist():
        wrong, asked = int(rng.integers(1, 8)), asks(rng, 400)
        said = rng.random(400) < answers_one(way, wrong, wrong & -wrong, *asked)
        people.append((*asked, said))
    found, drawn = learn_ways(KNOWN, joined(people))
    assert found == pytest.approx(keep_others((np.array(counts) / 15 + ASSUMED) / 2), abs=0.02)
    assert (drawn[:, 2] == np.arange(5).repeat(counts) % 4).mean() > 0.8


def test_shares_of_peoples_ways_are_the_mode_of_their_posterior() -> None:
    """Facts and ways are enumerated."""
    rng, likely = np.random.default_rng(1), np.zeros((10, 5))
    people = [(*asks(rng, 6), rng.integers(0, 2, 6)) for _ in range(10)]
    for (o, (*asked, said)), way, wrong in product(enumerate(people), range(5), range(8)):
        for kept in [1 << j for j in range(3) if wrong >> j & 1 and way == 4] or [0]:
            one = np.abs(1 - said - answers_one(way, wrong, kept, *asked))
            likely[o, way] += one.prod() / 8 / max(wrong.bit_count() * (way == 4), 1)
    mode = ASSUMED
    for _ in range(500):
        mode = ((likely * mode / (likely @ mode)[:, None]).sum(axis=0) + 15 * ASSUMED) / 25
    assert learn_ways(KNOWN, joined(people))[0] == pytest.approx(keep_others(mode), abs=1e-5)


def learned(dataset: Dataset, table: NDArray[np.float64] | None = TABLE) -> AcceptanceModel:
    found = learn_landing(dataset, table)
    assert found is not None
    return found


@pytest.mark.parametrize("accept", [(0.2, 0.5, 0.8), (0.4, 0.4, 1.0), (1.0, 1.0, 1.0)])
def test_alpha_is_learned_by_message(accept: tuple[float, ...]) -> None:
    true, inside = np.array(accept), []
    for seed in range(3):
        found = learned(taught(np.random.default_rng(seed), true))
        rate, low, high = found.accept.T
        assert np.abs(rate - true).max() < 0.2
        assert found.missed == (min(accept) < 1)
        inside += [*((low <= true.clip(0, 0.99)) & (true.clip(0, 0.99) <= high))]
    assert np.mean(inside) >= 0.8


def test_answers_after_messages_are_predicted_nearly_as_by_who_knows_all_rates() -> None:
    """Predicts answers after messages that were not observed, and compares with Bayes' rule, which
    knows all rates and enumerates all (W, missed messages)."""
    accept = np.array([0.2, 0.5, 0.8])
    dataset = taught(np.random.default_rng(5), accept)
    test = (dataset.observer % 3 == 0) & (dataset.message_set > 0)
    found = learned(dataset.take(np.flatnonzero(~test)))
    asked = dataset.take(np.flatnonzero(test))
    own = found.predict(asked.observer, asked.transition, asked.message_set)
    one = np.where(TABLE == 1, 1 - SLIP, GUESS)
    stays = (WRONG[:, 1:] >> np.arange(3) & 1) == 1
    lands = (WRONG[:, :1] & ~WRONG[:, 1:]) >> np.arange(3) & 1
    prior = np.where(stays, 1 - accept, 1).prod(axis=1) * (accept**lands).prod(axis=1) / 8
    best = np.empty(len(asked))
    for o in np.unique(asked.observer):
        before = dataset.take(np.flatnonzero((dataset.observer == o) & (dataset.message_set == 0)))
        p = one[WRONG[:, 0]][:, before.transition]
        weight = prior * np.where(before.label == 1, p, 1 - p).prod(axis=1)
        rows = np.flatnonzero(asked.observer == o)
        best[rows] = weight @ one[WRONG[:, 1]][:, asked.transition[rows]] / weight.sum()
    mean = dataset.label[(dataset.message_set > 0) & ~np.isin(dataset.observer, asked.observer)]
    nats = [-np.log(np.where(asked.label == 1, p, 1 - p)).mean() for p in (own, best, mean.mean())]
    assert nats[1] < nats[0] < nats[1] + 0.1 * (nats[2] - nats[1])


def test_nothing_is_learned_where_nobody_was_told_for_good() -> None:
    """Nothing is learned if message sets differ from question to question, or with too few people,
    or without messages."""
    rng = np.random.default_rng(0)
    dataset = taught(rng, np.full(3, 0.5))
    drawn = replace(dataset, message_set=rng.integers(0, 8, len(dataset)))
    assert learn_landing(drawn, TABLE) is None
    assert learn_landing(dataset.of(np.arange(15)), TABLE) is None
    assert learn_landing(replace(dataset, message_set=0 * dataset.message_set), TABLE) is None


def test_without_hypotheses_people_differ_in_ability() -> None:
    """Somebody who answered 1 more often before does so after; α is unknown."""
    dataset = taught(np.random.default_rng(1), np.full(3, 0.2))
    found = learned(dataset, None)
    assert not len(found.accept)
    assert not found.missed
    before = np.bincount(dataset.observer, dataset.label * (dataset.message_set == 0))
    who = np.array([before.argmin(), before.argmax()])
    low, high = found.predict(who, np.zeros(2, np.int64), np.full(2, EVERY))
    assert low < high
