"""Questions without hypotheses: by what all labels so far have taught.

Two learners look at the labels. The model of :mod:`xplain.learning.fact_model.model` shares what
it learned of a transition among all types; a decision tree, the labeler, sees those of one type
alone. Where the model thinks the tree wrong, or does not know itself, a label teaches the tree
most: questions are drawn in proportion to how often the robot makes the transition times the
probability that the tree's label is wrong (query by committee: Seung, Opper & Sompolinsky 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import comb
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit, logsumexp

from xplain.domains.users.setting import Setting
from xplain.errors import Count, checks
from xplain.explanation.message_sets import packed
from xplain.learning.data.dataset import Dataset, inputs, places
from xplain.learning.data.queries import Answer, Answered
from xplain.learning.fact_model.counts import REACH
from xplain.learning.fact_model.gibbs import sample
from xplain.learning.fact_model.model import (
    CELL,
    NOISE,
    ChainState,
    Prior,
    SortedLabels,
    facts_that_matter,
)
from xplain.learning.labelers import paper_tree
from xplain.questions.candidates import Candidates
from xplain.randomness import stream

MAX_SUBSETS = 256
"""Sets of facts that may matter at a transition, which are summed over."""
MAX_DEPTH = 5
MESSAGE_SETS = 64
"""Message sets that are weighed at each transition; drawn at random where there are more."""
SWEEPS = 24
"""Of a chain of the sampler, which goes on from what it found before, or begins anew."""
HEAT = 2.0


class Screen(NamedTuple):
    """Questions chosen together, Q of them.

    Attributes:
        transition: [Q] indices into the dataset's features, all different.
        message_set: [Q].
        facts: [O] what each observer is thought to hold wrong.
    """

    transition: NDArray[np.int64]
    message_set: NDArray[np.int64]
    facts: NDArray[np.int64]


def next_screen(
    dataset: Dataset,
    observer: int,
    weight: NDArray[np.float64],
    count: int,
    rng: np.random.Generator,
    facts: NDArray[np.int64] | None = None,
) -> Screen:
    """What to ask an observer next.

    Args:
        dataset: all answers so far; its ``features`` [T, F] are all that can be asked about.
        observer: who is asked, of the dataset's O observers; may have given no label yet.
        weight: [T] how much each transition matters, as its visits.
        count: questions, at most T.
        rng: of every draw.
        facts: [O] what observers were thought to hold wrong before, where the sampler begins.
    """
    n, count = dataset.n_messages, min(count, len(weight))
    everything = np.full(len(dataset.observers), (1 << n) - 1, dtype=np.int64)
    if len(dataset) == 0:  # nobody knows anything: what the robot does, unexplained
        transition = rng.choice(len(weight), count, replace=False, p=weight / weight.sum())
        return Screen(transition, np.zeros(count, dtype=np.int64), everything)
    answers, prior = SortedLabels.of(dataset), Prior.of(n, _depth(n))
    chains = [
        sample(answers, prior, 1.0, first, SWEEPS, HEAT, rng)
        for first in (everything if facts is None else facts, everything)
    ]
    told = _message_sets(n, rng)
    explicable = np.mean(
        [p_explicable(dataset, observer, told, prior, chain.best) for chain in chains], axis=0
    )
    best = max(chains, key=lambda chain: chain.score).best
    matter = facts_that_matter(prior, best)
    alike = np.flatnonzero((best.facts ^ best.facts[observer]) & matter == 0)
    said = _tree_labels(dataset, alike, told)
    score = weight[:, None] * np.where(said, 1 - explicable, explicable)
    # The largest of log score + Gumbel noise: drawn in proportion, none twice.
    key = np.log(np.maximum(score, np.finfo(float).tiny)) + rng.gumbel(size=score.shape)
    transition = np.argsort(-key.max(axis=1))[:count]
    return Screen(transition, told[key[transition].argmax(axis=1)], best.facts)


def p_explicable(
    dataset: Dataset, observer: int, told: NDArray[np.int64], prior: Prior, state: ChainState
) -> NDArray[np.float64]:
    """P(f = 1 | labels) of every transition under the message sets [K], for one observer, were
    everybody's facts those of ``state``: [T, K]. Which facts matter at a transition, and its noise,
    are summed out."""
    held = state.facts[dataset.observer] & ~dataset.message_set
    kept = state.facts[observer] & ~told
    count = np.zeros((len(dataset.features), 2))
    np.add.at(count, (dataset.transition, dataset.label), 1)
    # Of a cell's two labels the likelihoods beyond that of 1 depend on ones − zeros alone.
    log_noise = state.log_noise + count[:, ::-1] @ prior.log_flip.T  # [T, E]
    aheads, log_weights = [], []
    every = [facts[facts >= 0].tolist() for facts in prior.subsets]
    for facts, log_subset in zip(every, prior.log_subset, strict=True):
        ahead = _ones_less_zeros(dataset, packed(held, facts), len(facts))
        of_empty = prior.marginal[1][:, ahead[:, 0] + REACH]  # [E, T]
        of_others = prior.marginal[0][:, ahead[:, 1:] + REACH].sum(axis=2)
        log_weights.append(log_subset + log_noise + (of_empty + of_others).T)
        aheads.append(ahead)
    weight = np.stack(log_weights)  # [Z, T, E]
    weight = np.exp(weight - logsumexp(weight, axis=(0, 2), keepdims=True))
    result = np.zeros((len(count), len(told)))
    log_odds = np.log((1 - NOISE) / NOISE)[:, None, None]
    for facts, ahead, own in zip(every, aheads, weight, strict=True):
        first = np.where(np.arange(ahead.shape[1]) == 0, logit(CELL[1]), logit(CELL[0]))
        one = np.einsum("te,etc->tc", own, expit(first + ahead * log_odds))
        result += one[:, packed(kept, facts)]
    return result


def _ones_less_zeros(dataset: Dataset, cell: NDArray[np.int64], facts: int) -> NDArray[np.int64]:
    """By transition and cell, within the reach of the tables: [T, 2^facts]."""
    ahead = np.zeros((len(dataset.features), 1 << facts), dtype=np.int64)
    np.add.at(ahead, (dataset.transition, cell), 2 * dataset.label.astype(np.int64) - 1)
    return np.clip(ahead, -REACH, REACH)


def _tree_labels(
    dataset: Dataset, observers: NDArray[np.int64], told: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """What a tree that knows the labels of these observers (of everybody, where they gave none)
    says of all transitions under the message sets [K]: [T, K]."""
    own = dataset.of(observers)
    own = own if len(own) else dataset
    n = dataset.n_messages
    tree = paper_tree().set_params(random_state=0)
    tree.fit(inputs(own.features[own.transition], own.message_set, n), own.label)
    count = len(dataset.features)
    every = inputs(np.repeat(dataset.features, len(told), axis=0), np.tile(told, count), n)
    return np.asarray(tree.predict(every) == 1).reshape(count, len(told))


def _message_sets(n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Message sets to choose from: all of them; where they are many nothing, everything, and
    others drawn at random."""
    if 1 << n <= MESSAGE_SETS:
        return np.arange(1 << n)
    drawn = rng.integers(0, 1 << n, MESSAGE_SETS - 2)
    return np.unique(np.concatenate([[0, (1 << n) - 1], drawn]))


def _depth(n: int) -> int:
    """Facts that may matter together at a transition."""
    sizes = range(1, min(n, MAX_DEPTH) + 1)
    return max(d for d in sizes if d == 1 or sum(comb(n, k) for k in range(d + 1)) <= MAX_SUBSETS)


def next_screen_of(
    pool: Candidates, answers: Dataset, observer: str, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """What to ask somebody next by the answers so far, who may have given none yet.

    Args:
        pool: what can be asked about.
        answers: numbered as in the pool (:meth:`Candidates.answered`).
        observer: who is asked, by name.
        count: questions wanted; at most one a row of the pool's features.
        rng: of every draw.

    Returns:
        Transitions of the pool [Q] and message sets [Q].
    """
    if observer not in answers.observers:
        answers = replace(answers, observers=(*answers.observers, observer))
    asked = next_screen(answers, answers.observers.index(observer), pool.weight, count, rng)
    return pool.draw(asked.transition, rng), asked.message_set


@checks("queries")
@dataclass(frozen=True)
class Committee:
    """Each observer is asked screen by screen, by all answers so far, their own and those of the
    observers before; nothing is known of what they might hold wrong.

    Attributes:
        screen: questions chosen at a time.
    """

    screen: Count = 25

    def ask(
        self,
        setting: Setting,
        sizes: NDArray[np.int64],
        answer: Answer,
        seed: int,
        before: Sequence[Answered] = (),
    ) -> list[Answered]:
        """Exactly ``sizes`` labels an observer, one observer after the other; the first of them
        answered ``before``. Of transitions that share their features, which no labeler tells
        apart, the one asked about is drawn by how often the robot makes it."""
        rng = stream(seed, "queries", "committee")
        reachable, pool = setting.reachable, Candidates.of_setting(setting)
        data = pool.unanswered(setting.message_names)
        asked = list(before)
        for o, one in enumerate(asked):
            row = pool.which[places(one.transitions, reachable)]
            data = data.answered(o, row, one.message_sets, one.labels)
        facts = np.full(len(asked), (1 << setting.n_messages) - 1)
        for o, size in enumerate(sizes.tolist()[len(asked) :], len(asked)):
            data = replace(data, observers=tuple(map(str, range(o + 1))))
            facts = np.append(facts, (1 << setting.n_messages) - 1)
            shown: list[int] = []
            while len(shown) < size:
                count = min(self.screen, size - len(shown))
                screen = next_screen(data, o, pool.weight, count, rng, facts)
                facts = screen.facts
                chosen = pool.draw(screen.transition, rng)
                labels = answer(o, reachable[chosen], screen.message_set)
                shown += chosen.tolist()
                data = data.answered(o, screen.transition, screen.message_set, labels)
            rows = data.of(np.array([o]))
            asked.append(Answered(reachable[shown], rows.message_set, rows.label))
        return asked
