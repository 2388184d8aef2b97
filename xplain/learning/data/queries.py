"""Queries: the transitions that observers label, with message sets. Most transitions come from the
robot's traces (docs/method.md, section 2)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.domains.mdp import TaskModel
from xplain.domains.users.setting import Setting
from xplain.errors import Count, Probability, checks
from xplain.randomness import stream


def sample_trace(
    model: TaskModel,
    starts: NDArray[np.int64],
    rng: np.random.Generator,
    max_length: int,
) -> NDArray[np.int64]:
    """Draws one trace: [m, 3] transitions (s, a, s'), 1 ≤ m ≤ max_length.

    Args:
        model: the robot's model, solved; ties are broken at random.
        starts: start states, equally likely.
        rng: random stream.
        max_length: the trace ends after this number of transitions if it reaches no terminal state
            before.
    """
    state = int(starts[rng.integers(len(starts))])
    steps: list[tuple[int, int, int]] = []
    while len(steps) < max_length and not model.terminal[state]:
        actions = model.optimal[state].nonzero()[0]
        action = int(actions[rng.integers(len(actions))])
        # Draws like choice(p=…) in a third of the time.
        share = model.probability[state, action].cumsum()
        slot = (share / share[-1]).searchsorted(rng.random(), side="right")
        after = int(model.successor[state, action, slot])
        steps.append((state, action, after))
        state = after
    return np.array(steps, dtype=np.int64)


def count_expected_visits(
    model: TaskModel,
    starts: NDArray[np.int64],
    transitions: NDArray[np.int64],
    max_length: int,
) -> NDArray[np.float64]:
    """Computes [T] the expected number of times that a trace of :func:`sample_trace` contains each
    transition.

    Args:
        model, starts, max_length: see :func:`sample_trace`.
        transitions: [T, 3] all possible transitions, each once.
    """
    before, action, after = transitions.T
    leads = model.successor[before, action] == after[:, None]
    share = (model.probability[before, action] * leads).sum(axis=1)
    share = share / model.optimal[before].sum(axis=1)
    here: NDArray[np.float64] = np.bincount(starts, minlength=model.n_states) / len(starts)
    visits = np.zeros(len(transitions))
    for _ in range(max_length):
        made = here[before] * share
        visits += made
        here = np.bincount(after, made, model.n_states).astype(np.float64)
    return visits


Answer = Callable[[int, NDArray[np.int64], NDArray[np.int64]], NDArray[np.uint8]]
"""``answer(observer, transitions [c, 3], message_sets [c])`` → labels [c], with that observer's
errors. It is called once for each screen of questions. An observer who is asked again may give
another answer."""


@dataclass(frozen=True)
class QueryAnswers:
    """The questions and the answers of one observer, in order.

    Attributes:
        transitions: [p, 3].
        message_sets: [p] bitmasks.
        labels: [p], 1 = explicable.
        likely: fact sets (bitmasks) that the answers made likely and that no hypothesis contained.
    """

    transitions: NDArray[np.int64]
    message_sets: NDArray[np.int64]
    labels: NDArray[np.uint8]
    likely: NDArray[np.int64] | None = None


class Queries(Protocol):
    """A query design: the interface of every component ``queries``."""

    def ask(
        self, setting: Setting, sizes: NDArray[np.int64], answer: Answer, seed: int
    ) -> list[QueryAnswers]:
        """Asks O observers; each question may depend on all earlier answers.

        A design knows the domain. It must not use the types in ``setting``, because these types are
        to be found.

        Args:
            setting: the domain, its messages, and the robot's behaviour.
            sizes: [O] maximum number of labels that each observer gives.
            answer: returns an observer's labels.
            seed: seed of every draw.

        Returns:
            For each observer o, between 1 and ``sizes[o]`` questions with their answers.
        """
        ...


def ask_in_order(
    transitions: NDArray[np.int64],
    message_sets: NDArray[np.int64],
    sizes: NDArray[np.int64],
    answer: Answer,
) -> list[QueryAnswers]:
    """Asks all observers the same questions in the same order; observer o receives the first
    ``sizes[o]`` questions."""
    each = [(transitions[:size], message_sets[:size]) for size in sizes]
    return [QueryAnswers(*own, answer(o, *own)) for o, own in enumerate(each)]


@dataclass(frozen=True)
class RandomTraces:
    """Base class of query designs with the paper's questions: transitions of the robot's traces. A
    trace starts at random, follows an optimal policy (ties broken at random) and has one random
    message set.

    Attributes:
        trace_length: maximum length of a trace.
        message_probability: probability that a message is in the message set of a trace.
    """

    trace_length: Count = 10
    message_probability: Probability = 0.5

    def draw(
        self, setting: Setting, count: int, rng: np.random.Generator
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Draws traces until they have ``count`` transitions; the last trace may be shortened.
        Returns the transitions [count, 3] and the message set of each [count]."""
        weights = 1 << np.arange(setting.n_messages, dtype=np.int64)
        robot, starts = setting.models[0], setting.domain.starts
        traces: list[NDArray[np.int64]] = []
        message_sets: list[NDArray[np.int64]] = []
        total = 0
        while total < count:
            traces.append(sample_trace(robot, starts, rng, self.trace_length))
            given = rng.random(setting.n_messages) < self.message_probability
            message_sets.append(np.full(len(traces[-1]), int(weights[given].sum())))
            total += len(traces[-1])
        return np.concatenate(traces)[:count], np.concatenate(message_sets)[:count]


@checks("queries")
@dataclass(frozen=True)
class Independent(RandomTraces):
    """The paper's query design: each observer labels different random traces."""

    def ask(
        self, setting: Setting, sizes: NDArray[np.int64], answer: Answer, seed: int
    ) -> list[QueryAnswers]:
        """Asks observer o exactly ``sizes[o]`` questions, drawn independently for each observer."""
        asked = []
        for o, size in enumerate(sizes):
            questions = self.draw(setting, int(size), stream(seed, "queries", o))
            asked.append(QueryAnswers(*questions, answer(o, *questions)))
        return asked


@checks("queries")
@dataclass(frozen=True)
class Shared(RandomTraces):
    """A query design in which all observers label the same random traces. This is best for a
    clusterer that counts repeated questions, such as the paper's clusterer: without errors,
    observers of one type then give identical data."""

    def ask(
        self, setting: Setting, sizes: NDArray[np.int64], answer: Answer, seed: int
    ) -> list[QueryAnswers]:
        """Asks observer o the first ``sizes[o]`` questions of one common list."""
        battery = self.draw(setting, int(sizes.max()), stream(seed, "queries", "shared"))
        return ask_in_order(*battery, sizes, answer)
