"""Compares the questionnaire with Bayes' rule and mutual information by their definitions, and the
search for questions with the list of all questions."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.domains.users.corridor import Corridor
from tests.questions.tables import Rates, information, joint, random_hypotheses
from tests.refusals import refused
from xplain import Hypotheses, InputError, Questionnaire
from xplain.explanation.message_sets import indices, subsets
from xplain.questions.matrix import CLOSE, QuestionMatrix

seeds = st.integers(0, 10_000)


def drawn(seed, variants, clip=1, misread=0.0, **size):
    """Hypotheses and rates; in every second case people slip and guess, if questions are about
    one transition."""
    rng = np.random.default_rng(seed)
    h = random_hypotheses(seed, variants=variants, prior=rng.dirichlet(np.ones(8)), **size)
    slips = rng.uniform(0.02, 0.3, (2, h.n_transitions)) if clip == 1 and seed % 2 else (None, None)
    return h, Rates(0.1, 0.05, misread, *slips)


def answered(q, count, seed):
    """Answers this number of questions at random; returns the questions and answers."""
    rng, said = np.random.default_rng(seed), []
    for _ in range(count):
        transitions, told = q.next()
        clip = [transitions] if isinstance(transitions, int) else transitions
        labels = rng.integers(0, 2, len(clip)).tolist()
        q.answer(labels[0] if isinstance(transitions, int) else labels)
        said.append((clip, told, labels))
    return said


@given(seeds, st.integers(0, 1), st.integers(1, 3), st.sampled_from([0.0, 0.1]))
@settings(deadline=None, max_examples=40)
def test_the_posterior_is_bayes_rule(seed, variants, clip, misread):
    h, rates = drawn(seed, variants, clip, misread)
    q = Questionnaire(h, clip=clip, seed=seed, **rates._asdict())
    said = answered(q, 4, seed)
    weight = joint(h, rates, said).reshape(2 + variants, -1)
    assert (q.posterior, q.none) == (
        pytest.approx(weight[:-1].sum(axis=0)),
        pytest.approx(weight[-1].sum()),
    )
    assert q.posterior.sum() + q.none == pytest.approx(1)


@given(seeds, st.integers(0, 2), st.booleans())
@settings(deadline=None, max_examples=40)
def test_no_question_tells_more_than_the_next_one(seed, variants, told):
    """The information is about the variant, the candidate, and whether any hypothesis fits. Without
    messages each question comes once."""
    h, rates = drawn(seed, variants)
    q = Questionnaire(h, seed=seed, told=told, **rates._asdict())
    said = answered(q, seed % 5, seed)
    weight = joint(h, rates, said)
    left = set(range(h.n_transitions)) - {one.transitions[0] for one in q.asked if not told}
    values = {
        (t, messages): information(h, rates, weight, [t], messages)
        for t in left
        for messages in range(8 if told else 1)
    }
    chosen = q.next()
    assert values[chosen] == pytest.approx(max(values.values()), abs=1e-9)
    assert q.information(chosen) == pytest.approx(values[chosen], abs=1e-9)


@given(seeds, st.integers(0, 1), st.sampled_from([1, 5, 100]))
@settings(deadline=None, max_examples=20)
def test_alternatives_are_the_best_questions_and_new_ones_come_first(seed, variants, count):
    """Each transition has a twin with the same labels. Transitions with equal labels count as one
    question, which is about a transition that was not asked about, if there is one."""
    once, rates = drawn(seed, variants, 2, 0.1, transitions=3)
    twins = {"variants": once.variants.repeat(2, axis=2), "prior": once.prior}
    h = Hypotheses.of(once.labels.repeat(2, axis=1), **twins)
    q = Questionnaire(h, seed=seed, **rates._asdict())
    weight = joint(h, rates, answered(q, seed % 4, seed))
    values, seen = {}, {one.transitions[0] for one in q.asked}
    for t, facts in enumerate(h.matters.tolist()):
        for told in subsets(indices(facts)).tolist() if facts else ():
            key = h.tables[:, :, t].tobytes(), told
            values.setdefault(key, [information(h, rates, weight, [t], told), True])
            values[key][1] &= t in seen
    best = sorted((round(-value, 9), old) for value, old in values.values())[:count]
    found = [(h.tables[:, :, t].tobytes(), told, t) for t, told in q.alternatives(count)]
    assert [(round(-values[key, told][0], 9), t in seen) for key, told, t in found] == best
    assert len({key[:2] for key in found}) == len(found)


@given(seeds, st.integers(0, 1))
@settings(deadline=None, max_examples=15)
def test_a_clip_tells_the_sum_of_what_its_labels_tell_one_by_one(seed, variants):
    """Each transition of the clip, except the first, gives at least as much information as the
    transition outside."""
    h, rates = drawn(seed, variants, 3, 0.1, transitions=4)
    q = Questionnaire(h, clip=3, seed=seed, **rates._asdict())
    clip, told = q.next()
    weight = joint(h, rates, [])
    assert len(set(clip)) == 3
    each = [information(h, rates, weight, [t], told) for t in range(4)]
    assert q.information((clip, told)) == pytest.approx(sum(each[t] for t in clip), abs=1e-9)
    (left,) = {0, 1, 2, 3} - set(clip)
    assert all(each[t] >= each[left] - 1e-9 for t in clip[1:])


@pytest.mark.parametrize("clip", [1, 3])
def test_a_clip_is_a_walk_with_messages_that_matter(clip):
    h = Hypotheses.of_domain(Corridor())
    q = Questionnaire(h, clip=clip)
    for _ in range(6):
        shown, told = q.next()
        walk = [shown] if clip == 1 else shown
        assert 1 <= len(walk) <= clip
        assert (h.states[walk[1:], 0] == h.states[walk[:-1], 1]).all()
        assert told in subsets(indices(int(np.bitwise_or.reduce(h.matters[walk]))))
        q.answer([0] * len(walk) if clip > 1 else 0)


@given(seeds, st.integers(1, 2))
@settings(deadline=None, max_examples=25)
def test_json_takes_up_where_it_stood(seed, clip):
    h = random_hypotheses(seed, variants=1)
    q = Questionnaire(h, clip=clip, seed=seed, prior=np.arange(1, 9) / 36)
    answered(q, 3, seed)
    if seed % 2:
        q.next()
    text = q.to_json()
    again = Questionnaire.from_json(text, h)
    assert again.to_json() == text
    for _ in range(4):
        assert again.next() == q.next()
        for one in (q, again):
            one.answer([1] * clip if clip > 1 else 1)
    assert again.posterior == pytest.approx(q.posterior)


def test_done_counts_candidates_that_behave_alike_as_one():
    """Fact 1 changes no label."""
    labels = np.array([[1], [0], [1], [0]])
    q = Questionnaire(labels, error=0.01)
    assert not q.done
    q.answer(0, (0, 0))
    assert q.posterior.max() < 0.6
    assert q.done
    assert q.best == 1


@pytest.mark.parametrize(
    ("label", "question", "said"),
    [
        (2, (0, 0), "0 or 1"),
        (0.5, (0, 0), "0 or 1"),
        ("1", (0, 0), "0 or 1"),
        ([1, 0], (0, 0), "1 labels"),
        (1, (2, 0), "transition=2: a whole number in 0 … 1"),
        (1, (-1, 0), "transition=-1: a whole number in 0 … 1"),
        (1, (0, 2), "messages=2: a whole number in 0 … 1"),
        (1, ([], 0), "1 … 10 transitions"),
        (1, (0.5, 0), "a whole number"),
        (1, 3, "message set"),
        (1, None, "call next"),
    ],
)
def test_bad_answers_are_one_line(label, question, said):
    q = Questionnaire([[1, 1], [0, 1]])
    with refused(said):
        q.answer(label, question)
    assert not q.asked


@pytest.mark.parametrize(
    ("key", "options"),
    [
        *(("error", {"error": value}) for value in (-0.01, 1 / 3)),
        *((key, {key: x}) for key in ("none", "misread", "stop") for x in (-0.1, 1.0)),
        ("seed", {"seed": -1}),
        *(("clip", {"clip": 2} | more) for more in ({"clip": 0}, {"clip": 11}, {"told": False})),
        ("clip", {"clip": 2, "guess": 0.1}),
        ("repeats", {"repeats": 0}),
        *(
            ("slip and guess", dict(zip(("slip", "guess"), rates, strict=True)))
            for rates in ((1.0, None), (None, -0.1), ([0.5, 0.1], [0.5, 0.1]), ([0.1] * 3, 0), "xx")
        ),
    ],
)
def test_bad_options_are_one_line(key, options):
    Questionnaire([[1, 1], [0, 1]], clip=10, error=0.333)
    with refused(f"^{key}="):
        Questionnaire([[1, 1], [0, 1]], **options)


def test_an_answer_that_nobody_could_give_is_refused():
    q = Questionnaire([[1], [0]], error=0.0, none=0.0)
    q.answer(1, (0, 1))
    with pytest.raises(InputError, match="error > 0"):
        q.answer(0, (0, 1))


def test_with_nothing_told_no_question_comes_more_often_than_allowed():
    h = random_hypotheses(0, transitions=9)
    for repeats in (1, 2):
        questions = Questionnaire(h, 0.05, told=False, repeats=repeats)
        asked = []
        for _ in range(repeats * 9):
            asked.append(questions.next())
            questions.answer(1)
        assert sorted(asked) == sorted([(t, 0) for t in range(9)] * repeats)
        with pytest.raises(InputError, match="every question was asked"):
            questions.next()


PROGRAM = """
import sys

class Refused:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("pandas", "sklearn", "hydra", "omegaconf", "mlflow"):
            raise ImportError(name)

sys.meta_path.insert(0, Refused())
import xplain

print([m for m in ("numpy", "numba", "scipy") if m in sys.modules])
from xplain import Hypotheses, Questionnaire

q = Questionnaire([[1, 1], [0, 1], [1, 0], [0, 0]])
transition, told = q.next()
q.answer(0)
print(q.posterior.sum() + q.none)
"""


def test_the_package_imports_nothing_heavy_and_the_questionnaire_no_more_than_it_needs():
    """The questionnaire needs only numpy, scipy and numba."""
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120)
    heavy, total = done.stdout.splitlines()
    assert heavy == "[]"
    assert float(total) == pytest.approx(1, abs=1e-9)


FACTS, TRANSITIONS = 5, 6


def random_list(seed, variants=0):
    """Draws labels of all sets of at most 2 … 5 facts; each transition depends on a few facts."""
    rng = np.random.default_rng(seed)
    most = int(rng.integers(2, FACTS + 1))
    facts = np.array([f for f in range(1 << FACTS) if f.bit_count() <= most])
    about = rng.integers(1, 1 << FACTS, TRANSITIONS)
    tables = rng.integers(0, 2, (1 + variants, 1 << FACTS, TRANSITIONS), dtype=np.uint8)
    tables = tables[:, facts[:, None] & about, np.arange(TRANSITIONS)]
    tables[0, :, 0] = facts != 1  # some question tells something
    return Hypotheses.of(tables[0], facts, variants=tables[1:])


def questions_by_definition(hypotheses, weight):
    """Computes P(label 1) = Σ weight(v, R) f^v(R ∩ K) of all questions: {(transition, facts without
    a message): probability}."""
    return {
        (t, kept): float(
            (weight * hypotheses.tables[:, hypotheses.row(hypotheses.facts & kept), t]).sum()
        )
        for t, facts in enumerate(hypotheses.matters.tolist())
        for kept in range(1 << FACTS)
        if facts and kept & ~facts == 0
    }


@pytest.mark.parametrize("products", [1 << 26, 1])
@given(seed=seeds, variants=st.integers(0, 1), count=st.sampled_from([1, 3, 1000]))
@settings(deadline=None, max_examples=60)
def test_the_nearest_questions_are_found(seed, variants, count, products):
    """With few facts all questions are found. A search finds a question that is nearer than all
    questions with one fact more or less, or as near as the most probable candidate allows."""
    hypotheses = random_list(seed, variants)
    rng = np.random.default_rng(seed)
    weight = rng.dirichlet(np.full(hypotheses.tables[..., 0].size, 0.3))
    weight = weight.reshape(1 + variants, -1)
    every = questions_by_definition(hypotheses, weight)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("xplain.questions.matrix.PRODUCTS", products)
        patch.setattr("xplain.questions.matrix.SETS", 2)
        matrix = QuestionMatrix.of(hypotheses)
        found = matrix.nearest(weight, 0.5, count, rng)
    pairs = {}
    for off, g, told in zip(*found, strict=True):
        for t in matrix.having(g).tolist():
            kept = int(matrix.facts[g] & ~told)
            assert int(told) & ~int(matrix.facts[g]) == 0
            assert off == pytest.approx(abs(every[t, kept] - 0.5), abs=1e-9)
            pairs[t, kept] = off
    assert sum(len(matrix.having(g)) for g in found.function) == len(pairs)  # each once
    best, least = min(pairs.values()), max(weight.max() - 0.5, 0.0)
    assert best >= least - 1e-9
    if products > 1:
        nearest = sorted(abs(value - 0.5) for value in every.values())[:count]
        distinct = {key for key in every if abs(every[key] - 0.5) <= nearest[-1]}
        assert best == pytest.approx(nearest[0], abs=1e-9)
        assert count < 1000 or distinct == set(pairs)
    elif best > least + CLOSE:
        near = [
            [abs(every.get((t, kept ^ 1 << j), np.inf) - 0.5) for j in range(FACTS)]
            for (t, kept), off in pairs.items()
            if off <= best + 1e-9  # of equal questions one is looked into
        ]
        assert best <= max(map(min, near)) + 1e-9
