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
from xplain.learning.answers import AnswerModel, learn_answers
from xplain.learning.data.observers import Observations
from xplain.learning.landing import AcceptanceModel, learn_landing
from xplain.learning.mixture.classes import answer_classes
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


@pytest.mark.parametrize(
    ("cell", "person"),
    [([0, 1, 2, 3, 4, 5], [0, 0, 0, 1, 1, 1]), ([0, 0, 0, 1, 2, 2], [0, 1, 2, 3, 4, 5])],
)
@pytest.mark.parametrize("seed", range(4))
def test_a_step_is_that_of_the_posterior_over_all_truths_and_rates(seed, cell, person):
    """Either no two people share a cell, or everybody gives one answer: then one step of belief
    propagation is exact. The rest of the step is written out."""
    rng, e, base = np.random.default_rng(seed), [0, 0.04, 0.1, 0.2, 0.35], [0.5, 0.25, 0.15, 0.07]
    cell, person = np.array(cell), np.array(person)
    people, cells, question = person.max() + 1, cell.max() + 1, np.array([0, 1, 2, 0, 1, 0])
    label, prior = rng.integers(0, 2, 6), rng.choice([0.0, 0.3, 0.6, 0.98], cells)
    slip, guess, share = *rng.uniform(0.01, 0.4, (2, 5)), rng.dirichlet(np.ones(5))
    start = AnswerModel(slip, guess, np.vstack([np.eye(5), share]))
    model = learn_answers(listed(question, person, label, 4, people), cell, prior, start, steps=1)
    off = np.where(np.bincount(cell) >= 3, 0.05, 1e-6)  # a majority may be wrong
    one = prior.clip(off, 1 - off)
    joint, rates = np.zeros((6, 2, 5)), np.zeros((people, 5))
    for f in product((0, 1), repeat=cells):
        thought = np.array(f)[cell]
        a = np.where(thought == 1, 1 - slip[question], guess[question])[:, None]
        said = np.where(label[:, None] == 1, a, 1 - a)
        said = said * (1 - np.array(e)) + (1 - said) * e
        each = np.tile(share, (people, 1))  # [O, E] P(rate, own answers | f)
        np.multiply.at(each, person, said)
        whole = np.prod(np.where(f, one, 1 - one)) * each.sum(axis=1).prod()
        own = each / each.sum(axis=1, keepdims=True)
        rates += whole * own
        joint[np.arange(6), thought] += whole * own[person]
    joint, rates = joint / joint[0].sum(), rates / rates[0].sum()
    assert model.person[:-1] == pytest.approx(rates)
    whole = (rates.sum(axis=0) + 2 * np.array([*base, 0.03])) / (people + 2)
    whole[0] = whole.max()
    assert model.prior == pytest.approx(whole / whole.sum())
    times, others = np.zeros((2, 2, 4))
    for i, (f, rate) in product(range(6), product((0, 1), range(5))):
        chance = (guess, slip)[f][question[i]]
        as_thought = 1 - e[rate] if label[i] == f else e[rate]
        wrong = chance * (1 - as_thought)
        wrong /= wrong + (1 - chance) * as_thought
        times[1 - f, question[i]] += joint[i, f, rate] * wrong
        others[1 - f, question[i]] += joint[i, f, rate] * (1 - wrong)
    mean = (times.sum() + 50 * 0.02) / (6 + 50)
    kappa = max((16, 32, 64, 128), key=lambda k: (
        betaln(k * mean + times, k * (1 - mean) + others) - betaln(k * mean, k * (1 - mean))
    ).sum())  # fmt: skip
    shrunk = np.pad((times + kappa * mean) / (times + others + kappa), ((0, 0), (0, 1)))
    shrunk[:, -1] = mean
    assert np.stack([model.slip, model.guess]) == pytest.approx(shrunk.clip(0.002, 0.45))
    for said, limit in ((0, 0.45), (1, 0.002)):  # of a thousand people who all think 1
        who = np.arange(1000)
        alike = listed(0 * who, who, np.full(1000, said), 1, 1000)
        assert learn_answers(alike, who, np.ones(1000)).slip.tolist() == [limit] * 2
    either = shrunk[:, -1].clip(0.002, 0.45).mean()
    assert model.habits.error == pytest.approx(either + np.array(e) * (1 - 2 * either))


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
    wrong = [0.075, 0.075 + 0.35 * (1 - 0.15), 0.2 + 0.05 * (1 - 0.4)]
    assert model.wrong(question, who) == pytest.approx(np.mean(wrong))


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
    """Computes log P(partition), where α is drawn from an exponential of mean ½."""
    n, k = int(sizes.sum()), len(sizes)

    def weigh(alpha: float) -> float:
        return float(np.exp(k * np.log(alpha) + gammaln(alpha) - gammaln(alpha + n) - 2 * alpha))

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
        for c in (0.5, 1, 2, 4, 8, 16, 32):
            first, second = c * mean, c * (1 - mean)
            evidence = betaln(first + ones, second + zeros) - betaln(first, second)
            weight = np.exp(prior + evidence.sum())
            total += weight
            number[len(member)] += weight
            expected += weight * ((first + ones) / (c + ones + zeros))[partition]
    found = answer_classes(data, 0.5, 20, 0)
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
    other = max(known.one_type, known.question_mean)
    assert np.mean(known.gain) == pytest.approx(known.types - other)
    assert known.gain[1] > known.types - other > 0
    assert known.calibration[-1].ones > known.calibration[0].ones + 0.3
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


def test_a_step_of_learning_what_is_accepted_is_written_out(monkeypatch) -> None:
    """Twenty people, two facts; some receive one message, some both, at once or one by one. Each
    state is a level of slips, the facts believed incorrectly, and the facts that stay so."""
    monkeypatch.setattr("xplain.learning.landing.STEPS", 1)
    rng, both, chains = np.random.default_rng(0), np.arange(2), ([0, 1], [0, 2], [0, 1, 3], [0, 3])
    rows = [(o, t, h) for o in range(20) for h in chains[o % 4] for t in range(4)]
    who, item, told = np.array([row for row in rows if rng.random() < 0.8]).T
    label, table = rng.integers(0, 2, len(who)), rng.choice([0.0, 0.2, 1.0], (4, 4))
    data = replace(listed(item, who, label, 4, 20), message_set=told, messages=("a", "b"))
    found = learned(data, table)
    pairs = [(w, k) for w in range(4) for k in range(4) if not k & ~w]
    wrong, kept = np.array(pairs * 7).T
    level = np.array([0.03, 0.1, 0.3, 1, 3, 10, 30]).repeat(9)[:, None]

    def answer(slip, guess, item, told):
        odds, held = level * slip / (1 - slip), wrong[:, None] & ~told | kept[:, None] & told
        f = np.where(item < 0, 1, table[held, item])
        return f, odds / (1 + odds), f * (1 - odds / (1 + odds)) + (1 - f) * guess

    f, slips, one = answer(0.08, 0.2, item, told)  # [states, answers]
    chance = np.where(label == 1, one, 1 - one)
    had, stays = (own[:, None] >> both & 1 for own in (wrong, kept))
    land = (0.5**had).prod(axis=1)
    people = np.stack([land * chance[:, who == o].prod(axis=1) for o in range(20)])
    people /= people.sum(axis=1, keepdims=True)
    heard = np.stack([(told[who == o, None] >> both & 1).any(axis=0) for o in range(20)])
    corrected, held = ((people @ own * heard).sum(axis=0) for own in (had - stays, had))
    assert found.accept[:, 0] == pytest.approx((corrected + 1) / (held + 2))
    assert found.mean == pytest.approx((corrected.sum() + 1) / (held.sum() + 2))
    for j, (rate, *ends) in enumerate(found.accept.tolist()):
        grid = np.arange(1, 200) / 200
        ratio = np.where(stays[:, [j]], (1 - grid) / (1 - rate), grid / rate)
        log = np.log(people[heard[:, j]] @ np.where(had[:, [j]], ratio, 1)).sum(axis=0)
        below = np.exp(log).cumsum() / np.exp(log).sum()
        assert ends == pytest.approx([grid[(below < end).sum()] for end in (0.025, 0.975)])

    queries = sorted({*zip(item.tolist(), told.tolist(), strict=True)})
    query = [queries.index(own) for own in zip(item.tolist(), told.tolist(), strict=True)]
    assert found.number == {own: q for q, own in enumerate(queries)}
    for name, kind, more in (("slip", 0, slips / 0.08), ("guess", 1, 1.0)):
        weight = people[who].T * (f if kind == 0 else 1 - f)
        count = np.bincount(query, weight.sum(axis=0) * (label == kind))
        total = np.bincount(query, (weight * more).sum(axis=0))
        mean = (count.sum() + 1) / (total.sum() + 20)
        rates = ((count + 16 * mean) / (total + 16)).clip(0.001, 0.6)
        assert getattr(found, name) == pytest.approx([*rates, rates.mean()])

    by_facts = people.sum(axis=0).reshape(7, 9) @ (wrong[:9, None] == np.arange(4))
    new = (by_facts + 4 * by_facts.sum(axis=0) / 20 + 0.05)[:, wrong[:9]].ravel() * land
    assert found.people == pytest.approx(np.vstack([people, new / new.sum()]))
    expected, plain = np.empty(len(who)), told == 0
    for p in range(len(who)):
        belief = new * chance[:, (who == who[p]) & plain & (np.arange(len(who)) != p)].prod(axis=1)
        expected[p] = belief @ one[:, p] / belief.sum()
    surprise = np.zeros((21, 5))
    surprise[who[plain], item[plain]] = (label - expected)[plain]
    assert found.surprise == pytest.approx(surprise)
    own, off, later = (x[~plain] for x in (surprise[who, item], expected, label))
    repeats = (own * (later - off)).sum() / ((own**2 * off * (1 - off)).sum() + 1)
    assert found.repeats == pytest.approx(repeats)
    for o, t, h in ((0, 1, 1), (5, 0, 2), (2, 3, 2), (-1, 2, 3), (4, -1, 1)):
        q = found.number.get((t, h), -1)
        p = found.people[o] @ answer(found.slip[q], found.guess[q], np.array([t]), h)[2][:, 0]
        odds = p / (1 - p) * np.exp(repeats * surprise[o, t])
        assert found.predict(*np.array([[o], [t], [h]])) == pytest.approx(odds / (1 + odds))


def test_nothing_is_learned_where_nobody_was_told_for_good() -> None:
    """Nothing is learned if message sets differ from question to question, or with too few people,
    or without messages."""
    rng = np.random.default_rng(0)
    dataset = taught(rng, np.full(3, 0.5))
    drawn = replace(dataset, message_set=rng.integers(0, 8, len(dataset)))
    assert learn_landing(drawn, TABLE) is None
    assert learn_landing(dataset.of(np.arange(19)), TABLE) is None
    assert learn_landing(dataset.of(np.arange(20)), np.ones((128, ITEMS))) is None  # of seven facts
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
