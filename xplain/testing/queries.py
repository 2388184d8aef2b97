"""Tests of query designs (see :mod:`xplain.learning.data.queries`)."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from xplain.domains.base import Domain
from xplain.domains.users.setting import Setting, UserType
from xplain.learning.data.queries import QueryAnswers
from xplain.testing.suite import DomainUser

SIZES = np.array([23, 1, 12, 40])
"""Maximum number of labels of each of four observers."""


class QueriesConformance(DomainUser):
    """Tests a query design, ``ask(setting, sizes, answer, seed)``. Data sets and learning need
    these properties. The observers in these tests answer at random, because a design must accept
    any answers."""

    @pytest.fixture(scope="class")
    def setting(self, domain: Domain) -> Setting:
        """A setting with one type, which believes the first parameter incorrectly."""
        return _make_setting(domain, 0)

    def test_everybody_is_asked_no_more_than_agreed(self, component: Any, setting: Setting) -> None:
        """Observer o answers at least one question and at most ``sizes[o]``. Each observer has one
        ``QueryAnswers`` in the result."""
        asked, _ = _ask_observers(component, setting, self.seed)
        assert len(asked) == len(SIZES), "not one for each observer"
        counts = [len(one.labels) for one in asked]
        assert all(1 <= c <= s for c, s in zip(counts, SIZES, strict=True)), f"asked {counts}"
        for one in asked:
            assert one.transitions.shape == (len(one.labels), 3), "transitions are [p, 3]"
            assert one.message_sets.shape == one.labels.shape, "not one message set for each label"

    def test_answers_are_the_observers(self, component: Any, setting: Setting) -> None:
        """All questions and answers are returned, in the order in which they were asked."""
        asked, heard = _ask_observers(component, setting, self.seed)
        assert _are_equal(asked, heard), "the result has other questions or answers"

    def test_questions_are_about_what_the_robot_does(
        self, component: Any, setting: Setting
    ) -> None:
        """Transitions are possible under the robot's optimal policy, and message sets exist."""
        possible = set(map(tuple, setting.reachable.tolist()))
        for one in _ask_observers(component, setting, self.seed)[0]:
            assert set(map(tuple, one.transitions.tolist())) <= possible, "the robot never does it"
            assert (one.message_sets >= 0).all(), "a message set is a bitmask"
            assert (one.message_sets < 1 << setting.n_messages).all(), "there is no such message"

    def test_the_same_seed_asks_the_same(self, component: Any, setting: Setting) -> None:
        """Randomness comes from the seed alone."""
        once, again = (_ask_observers(component, setting, self.seed)[0] for _ in range(2))
        assert _are_equal(once, again), "two rounds with one seed and the same answers differ"

    def test_does_not_look_at_the_true_types(self, component: Any, domain: Domain) -> None:
        """If other types give the same answers, the design asks the same questions."""
        one, other = (
            _ask_observers(component, _make_setting(domain, j), self.seed)[0] for j in (0, -1)
        )
        assert _are_equal(one, other), "the questions depend on the true types"


def _make_setting(domain: Domain, wrong: int) -> Setting:
    parameter = domain.parameters[wrong]
    return Setting.build(domain, (UserType("one", {parameter.name: parameter.inaccurate}),))


def _ask_observers(
    design: Any, setting: Setting, seed: int
) -> tuple[list[QueryAnswers], list[QueryAnswers]]:
    """Asks four observers by the design. Returns the design's result, and the questions and answers
    as the observers saw them."""
    rngs = [np.random.default_rng([o, seed]) for o in range(len(SIZES))]
    nothing = np.zeros((0, 3), dtype=np.int64)
    heard = [QueryAnswers(nothing, nothing[:, 0], nothing[:, 0].astype(np.uint8)) for _ in SIZES]

    def answer(
        observer: int, transitions: NDArray[np.int64], message_sets: NDArray[np.int64]
    ) -> NDArray[np.uint8]:
        labels = np.round(rngs[observer].random(len(transitions))).astype(np.uint8)
        before = heard[observer]
        heard[observer] = QueryAnswers(
            np.concatenate([before.transitions, transitions]),
            np.concatenate([before.message_sets, message_sets]),
            np.concatenate([before.labels, labels]),
        )
        return labels

    return design.ask(setting, SIZES, answer, seed), heard


def _are_equal(one: list[QueryAnswers], other: list[QueryAnswers]) -> bool:
    return all(
        np.array_equal(a.transitions, b.transitions)
        and np.array_equal(a.message_sets, b.message_sets)
        and np.array_equal(a.labels, b.labels)
        for a, b in zip(one, other, strict=True)
    )
