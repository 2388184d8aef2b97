"""An embedded explainer expects people of other types if facts are known, and reports that no type
fits."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from xplain import Explainer, GivenTypes, Hypotheses
from xplain.explanation.anybody import Open
from xplain.explanation.belief import Independent
from xplain.interaction.explainer import GivenTypes as Types
from xplain.learning.data.dataset import Dataset
from xplain.learning.mixture.labeler import HypothesisTrainer
from xplain.learning.saved import LearnedTypes
from xplain.learning.types import Clustering
from xplain.learning.user_types import learn_types

N, STEPS = 3, 10
SETS = np.arange(1 << N)


def types_with_facts(seed: int = 0) -> Types:
    """Makes two types that believe one fact incorrectly each; labels are nearly certain."""
    labels = np.random.default_rng(seed).choice([0.02, 0.98], (STEPS, 1 << N))
    labels[:, 0] = 0.98
    table = np.stack([labels[:, wrong & ~SETS] for wrong in (1, 2)])
    everything = labels[None, :, 7 & ~SETS]
    return GivenTypes(table, ("a", "b", "c"), ("x", "y"), wrong=(1, 2), about_everything=everything)


def test_people_may_be_of_no_type_where_facts_are_known() -> None:
    types = types_with_facts()
    assert isinstance(Explainer(types).beliefs, Open)
    session = Explainer(types).session(range(STEPS))
    assert session.belief["none of these"] == pytest.approx(0.1, abs=0.08)
    before = session.fit
    assert before == pytest.approx(0.78, abs=0.03)
    session.messages()
    assert session.why().fit == before
    assert "fit none" not in str(session.why())
    for facts in (replace(types, wrong=None, about_everything=None), types):
        closed = Explainer(facts, belief_update=Independent()).session(range(STEPS))
        assert closed.belief.keys() == {"x", "y"}
        assert closed.fit == 1


def test_answers_that_fit_no_type_are_told_of() -> None:
    """A person who answers at random soon fits no type; a restored session says the same."""
    explainer, rng = Explainer(types_with_facts(), trade_off=100), np.random.default_rng(0)
    session = explainer.session(range(STEPS))
    while not session.finished:
        session.messages()
        session.observe(rng.integers(0, 2, session.shown))
    assert session.fit < 0.01
    assert "the answers fit none of the types" in str(session.why())
    assert explainer.from_json(session.to_json()).fit == pytest.approx(session.fit)


def test_where_facts_are_many_people_are_taken_as_found(caplog: pytest.LogCaptureFixture) -> None:
    p = np.full((1, 2, 1 << 13), 0.9)
    types = GivenTypes(p, tuple(map(str, range(13))), ("x",), wrong=(1,), about_everything=p)
    with caplog.at_level(logging.WARNING):
        assert not isinstance(Explainer(types).beliefs, Open)
    assert "all users are assumed to have one of the types" in caplog.text


def test_learned_types_keep_their_facts_in_a_file(tmp_path: Path) -> None:
    labels = np.random.default_rng(0).integers(0, 2, (1 << N, 8)).astype(np.uint8)
    features = np.arange(8.0)[:, None]
    known = Hypotheses.of(labels, messages=("a", "b", "c"), features=features, feature_names=("f",))
    rng = np.random.default_rng(1)
    transition, told = rng.integers(0, 8, 200), rng.integers(0, 8, 200)
    observer = np.repeat([0, 1], 100)
    answers = labels[np.array([1, 6])[observer] & ~told, transition]
    dataset = Dataset(
        features, ("f",), ("a", "b", "c"), ("one", "two"), observer, transition, told, answers
    )
    trainer = HypothesisTrainer(hypotheses=known)
    found = learn_types(dataset, Clustering(np.array([0, 1]), "", ""), trainer, 0)
    learned = LearnedTypes.of(found, dataset)
    assert learned.wrong == (1, 6)
    learned.save(tmp_path / "types.npz")
    loaded = LearnedTypes.load(tmp_path / "types.npz")
    assert (loaded.wrong, loaded.new) == (learned.wrong, learned.new)
    for types in (learned, loaded):
        everything = types.everything(features.tolist())
        assert everything is not None
        one = everything.array(N)[0]
        np.testing.assert_allclose(one, np.where(labels[7 & ~SETS].T, 0.998, 0.002))
        assert isinstance(Explainer(types).beliefs, Open)
