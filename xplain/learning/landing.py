"""Learns from answers before and after messages how often messages are accepted.

A message corrects its fact with probability α; otherwise the person keeps the incorrect belief. The
facts that a person still believes incorrectly determine the label f, as in
:mod:`xplain.learning.answers`. Queries have slips and guesses, and people differ in how often they
slip: one of LEVELS multiplies the odds of all slips of a person, like the ability in the Rasch
model. Expectation maximisation learns everything from the answers of all people. Without hypotheses
it is unknown which facts matter at which transition; people then differ only in their slips.

A person whose answer before a message was unexpected is likely to repeat this answer. So the
difference between the earlier answer and its expectation, times a weight, is added to the log odds
of a later answer.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit, softmax

from xplain.explanation.message_sets import bits_of
from xplain.learning.data.dataset import Dataset, query_index

LEVELS = np.array([0.03, 0.1, 0.3, 1, 3, 10, 30])
PEOPLE = 20
"""Minimum number of people who answered both before and after messages."""
FACTS = 6
"""Maximum number n of facts; there are 3^n hidden states."""
NUMBERS = 1 << 23
"""Maximum number of answers times hidden states."""
WEIGHT = 16.0
"""The mean slip (or guess) over all queries counts as this number of answers to each query."""
SMOOTHING = 4.0
"""Number of pseudo-observers at each level, with the average incorrect beliefs."""
STEPS, STILL = 60, 1e-3
"""Maximum number of steps. The steps end earlier if no slip, guess or α changes by more than
STILL."""
LANDS = 0.95
"""All messages count as accepted unless the interval of some α ends below this value."""
GRID = np.linspace(0.005, 0.995, 199)


@dataclass(frozen=True)
class AcceptanceModel:
    """The acceptance of messages, and a model of the answers before and after messages: S hidden
    states, O people, Q queries.

    Attributes:
        accept: [n, 3] α of each message and the ends of its 95 % interval; [0, 3] without
            hypotheses.
        mean: mean α; each message is weighted by the number of people whom it could correct.
        table: [2^n, T] P(f = 1) by the facts believed incorrectly.
        wrong, kept: [S] bitmasks that define each hidden state: the facts believed incorrectly
            before any message, and the facts among these that messages do not correct.
        slip, guess: [Q + 1] slip and guess of each query; the last entry is for a query without
            answers.
        number: index of each query (transition, message set).
        people: [O + 1, levels · S] posterior over (slip level, hidden state) of each person; the
            last row is for an unknown person.
        surprise: [O + 1, T + 1] the answer about each transition before any message, minus its
            expectation given the person's other answers; 0 without such an answer.
        repeats: weight of a surprise in the log odds of an answer after messages.
    """

    accept: NDArray[np.float64]
    mean: float
    table: NDArray[np.float64]
    wrong: NDArray[np.int64]
    kept: NDArray[np.int64]
    slip: NDArray[np.float64]
    guess: NDArray[np.float64]
    number: dict[tuple[int, int], int]
    people: NDArray[np.float64]
    surprise: NDArray[np.float64]
    repeats: float

    @property
    def missed(self) -> bool:
        """True if some messages are not accepted."""
        return bool((self.accept[:, 2] < LANDS).any())

    def predict(
        self, who: NDArray[np.int64], transition: NDArray[np.int64], told: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Computes [P] P(answer 1) of people about transitions after the messages ``told``. The
        index −1 is an unknown person or an unknown transition."""
        result, both = np.empty(len(who)), np.stack([transition, told], axis=1)
        for query in np.unique(both, axis=0):
            rows = np.flatnonzero((both == query).all(axis=1))
            f = _predict_labels(self.table, self.wrong, self.kept, *query[:, None])
            at = [self.number.get((int(query[0]), int(query[1])), -1)]
            one = _predict_answers(f, self.slip[at], self.guess[at]).ravel()
            result[rows] = self.people[who[rows]] @ one
        return np.asarray(expit(logit(result) + self.repeats * self.surprise[who, transition]))


def learn_landing(dataset: Dataset, table: NDArray[np.float64] | None) -> AcceptanceModel | None:
    """Learns how often messages are accepted.

    Args:
        dataset: the answers.
        table: [2^n, T] P(f = 1) of each transition by the facts believed incorrectly; None if
            unknown.

    Returns:
        The learned model; None if it cannot be learned. This is so if fewer than PEOPLE observers
        answered with several message sets that form a chain (:func:`_is_chain`); if any other
        observer received messages; or if there are too many facts or hidden states. Without
        ``table`` it is also so if the message sets of all observers together form no chain, because
        the answers of observers may then differ by type instead of ability.
    """
    given = [
        np.unique(dataset.message_set[dataset.observer == o]) for o in range(len(dataset.observers))
    ]
    taught = sum(len(sets) > 1 and _is_chain(sets) for sets in given)
    if taught < PEOPLE or taught < sum(map(np.any, given)):
        return None
    if table is None:
        if not _is_chain(np.unique(dataset.message_set)):
            return None
        table = np.ones((1, len(dataset.features)))
    n = len(table).bit_length() - 1
    pairs = np.array([(w, k) for w in range(1 << n) for k in range(1 << n) if not k & ~w])
    wrong, kept = pairs.T
    query = query_index(dataset)
    first = np.unique(query, return_index=True)[1]
    states, observers = len(LEVELS) * len(pairs), len(given)
    if n > FACTS or len(dataset) * states > NUMBERS:
        return None
    transition, told = dataset.transition[first], dataset.message_set[first]
    counts = np.zeros((2, observers, len(first)))
    np.add.at(counts, (dataset.label, dataset.observer, query), 1)
    f = _predict_labels(table, wrong, kept, transition, told)
    had, stays = bits_of(wrong, n), bits_of(kept, n)
    after = bits_of(np.array([int(np.bitwise_or.reduce(own)) for own in given]), n) == 1  # [O, n]
    slip, guess = np.full(len(first), 0.08), np.full(len(first), 0.2)
    accept, prior = np.full(n, 0.5), np.full((len(LEVELS), 1 << n), 1 / (len(LEVELS) << n))
    for _ in range(STEPS):
        before = np.concatenate([slip, guess, accept])
        one = _predict_answers(f, slip, guess).reshape(states, len(first))
        land = (had - stays) @ np.log(accept) + stays @ np.log1p(-accept)
        joint = (np.log(prior)[:, wrong] + land).ravel()
        joint = joint + counts[1] @ np.log(one).T + counts[0] @ np.log1p(-one).T
        people = softmax(joint, axis=1).reshape(observers, len(LEVELS), len(pairs))
        by_facts = people.sum(axis=0) @ (wrong[:, None] == np.arange(1 << n))
        prior = by_facts + SMOOTHING * by_facts.sum(axis=0) / observers + 0.05
        prior /= prior.sum()
        corrected, held = (
            np.einsum("ols,sj,oj->j", people, own, after) for own in (had - stays, had)
        )
        accept = (corrected + 1) / (held + 2)
        weight = people.reshape(observers, states)
        zero, all_ = (
            (own.T @ weight).reshape(len(first), len(LEVELS), len(pairs))
            for own in (counts[0], counts.sum(axis=0))
        )
        more = expit(logit(slip) + np.log(LEVELS)[:, None]) / slip  # [levels, Q]
        slip = _shrink_rates(
            np.einsum("qls,sq->q", zero, f), np.einsum("qls,sq,lq->q", all_, f, more)
        )
        guess = _shrink_rates(*(np.einsum("qls,sq->q", own, 1 - f) for own in (all_ - zero, all_)))
        if np.abs(np.concatenate([slip, guess, accept]) - before).max() < STILL:
            break
    ends = [
        _compute_interval(
            people[after[:, j]].sum(axis=1), had[:, j] == 1, stays[:, j] == 1, accept[j]
        )
        for j in range(n)
    ]
    new = (np.log(prior)[:, wrong] + land).ravel()
    surprise, repeats = _compute_surprises(dataset, query, one, new)
    return AcceptanceModel(
        accept=np.column_stack([accept, np.array(ends).reshape(n, 2)]),
        mean=float((corrected.sum() + 1) / (held.sum() + 2)),
        table=table,
        wrong=wrong,
        kept=kept,
        slip=np.append(slip, slip.mean()),
        guess=np.append(guess, guess.mean()),
        number={
            key: q for q, key in enumerate(zip(transition.tolist(), told.tolist(), strict=True))
        },
        people=np.concatenate([weight, softmax(new)[None]]),
        surprise=surprise,
        repeats=repeats,
    )


def _compute_surprises(
    dataset: Dataset, query: NDArray[np.int64], one: NDArray[np.float64], new: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Computes ``surprise`` and ``repeats`` of :class:`AcceptanceModel`. ``repeats`` is one Newton
    step from 0.

    Args:
        dataset: the answers.
        query: [P] index of the query of each answer.
        one: [states, Q] P(answer 1) of each query.
        new: [states] log of the probability that the next person is in the state.
    """
    log = np.log([1 - one, one])[dataset.label, :, query]  # [P, states]
    plain, observer = dataset.message_set == 0, dataset.observer
    about = np.zeros((len(dataset.observers), len(new)))
    np.add.at(about, observer[plain], log[plain])
    others = softmax(new + about[observer] - log * plain[:, None], axis=1)
    expected = (others * one.T[query]).sum(axis=1)
    surprise = np.zeros((len(dataset.observers) + 1, len(dataset.features) + 1))
    surprise[observer[plain], dataset.transition[plain]] = (dataset.label - expected)[plain]
    own, off = surprise[observer, dataset.transition][~plain], expected[~plain]
    slope = (own * (dataset.label[~plain] - off)).sum()
    return surprise, float(slope / ((own**2 * off * (1 - off)).sum() + 1))


def _is_chain(sets: NDArray[np.int64]) -> bool:
    """True if these message sets, sorted by size, form a chain: each set contains the set before
    it. Then no message was taken back."""
    ordered = sets[np.argsort(np.bitwise_count(sets))]
    return bool((ordered[:-1] & ~ordered[1:] == 0).all())


def _predict_labels(
    table: NDArray[np.float64],
    wrong: NDArray[np.int64],
    kept: NDArray[np.int64],
    transition: NDArray[np.int64],
    told: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Computes P(f = 1) of each query in each hidden state.

    Args:
        table, wrong, kept: see :class:`AcceptanceModel`.
        transition: [Q] transition of each query; f is 1 for an unknown transition (−1).
        told: [Q] message set of each query.

    Returns:
        [S, Q] the probabilities.
    """
    held = (wrong[:, None] & ~told | kept[:, None] & told) & len(table) - 1
    return np.where(transition >= 0, table[held, transition], 1.0)


def _predict_answers(
    f: NDArray[np.float64], slip: NDArray[np.float64], guess: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Computes [levels, S, Q] P(answer 1) of each query, by slip level and hidden state.

    Args:
        f: [S, Q] P(f = 1).
        slip, guess: [Q].
    """
    slips = expit(logit(slip) + np.log(LEVELS)[:, None])
    return np.asarray(f * (1 - slips[:, None]) + (1 - f) * guess)


def _shrink_rates(count: NDArray[np.float64], total: NDArray[np.float64]) -> NDArray[np.float64]:
    """Computes [Q] the rates ``count`` / ``total``, shrunk towards their overall mean."""
    mean = (count.sum() + 1) / (total.sum() + 20)
    return np.asarray(((count + WEIGHT * mean) / (total + WEIGHT)).clip(0.001, 0.6))


def _compute_interval(
    people: NDArray[np.float64], had: NDArray[np.bool_], stays: NDArray[np.bool_], accept: float
) -> tuple[float, float]:
    """Computes the 95 % interval of a message's α, with all other parameters fixed. The likelihood
    of each person's answers is linear in α.

    Args:
        people: [O, S] posterior over hidden states of each person who received the message,
            computed with α = ``accept``.
        had: [S] True if the message's fact is believed incorrectly before any message.
        stays: [S] True if the message does not correct this belief.
        accept: the estimate of α.

    Returns:
        The lower and the upper end.
    """
    landed = people[:, had & ~stays].sum(axis=1) / accept
    missed = people[:, stays].sum(axis=1) / (1 - accept)
    rest = people[:, ~had].sum(axis=1)
    log = np.log(rest + landed * GRID[:, None] + missed * (1 - GRID[:, None])).sum(axis=1)
    below = softmax(log).cumsum()
    return tuple(float(GRID[np.searchsorted(below, end)]) for end in (0.025, 0.975))  # type: ignore[return-value]
