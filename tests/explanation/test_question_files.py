"""Questions in files, and the rule that selects them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.explanation.problems import random_problem
from xplain.explanation.asking import make_question
from xplain.explanation.files import load, save
from xplain.testing.problems import with_questions


@given(st.integers(0, 2**32 - 1), st.booleans())
@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_a_saved_problem_carries_its_questions(tmp_path: Path, seed: int, words: bool) -> None:
    rng = np.random.default_rng(seed)
    problem = with_questions(rng, random_problem(rng))
    asked = problem.questions
    assert asked is not None
    if words:
        right = rng.integers(-1, 2, len(asked))
        texts = tuple(
            f"“{q}” is so.\nIt is not." if r >= 0 else f"{q}" for q, r in enumerate(right)
        )
        shows = rng.random((len(asked), problem.n_steps)) < 0.5
        asked = replace(asked, texts=texts, right=right, shows=shows)
        problem = replace(problem, questions=asked)
    save(problem, tmp_path / "problem.npz")
    loaded = load(tmp_path / "problem.npz").questions
    assert loaded is not None
    assert (loaded.limits, loaded.texts) == (asked.limits, asked.texts)
    np.testing.assert_array_equal(loaded.right, asked.right)
    np.testing.assert_array_equal(loaded.shows, asked.shows)
    for given_ in range(1 << problem.n_messages):
        for table in ("label_probabilities", "answer_probabilities"):
            one, other = (getattr(q.table, table)(len(asked), given_) for q in (asked, loaded))
            np.testing.assert_array_equal(one, other)
    assert [loaded.question(q) for q in range(len(asked))] == [
        asked.question(q) for q in range(len(asked))
    ]


def test_a_belief_shows_its_sentences_in_the_order_given() -> None:
    for right in (0, 1):
        question = make_question(3, "It needs fuel.\nIt needs none.", right)
        assert [words for words, _ in question.replies] == ["It needs fuel.", "It needs none."]
        assert question.replies[right][1] == 1
        assert question.replies[1 - right][1] == 0
        assert "fuel" in str(question)
