"""Messages that stay valid on later pages: the questions, and the learned habits of listening."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.conftest import Run
from tests.people.bare_flow import observe
from tests.people.collect.stand_in import FAULTLESS, street_collection, street_plan
from tests.people.kinds import filled
from xplain.domains.users.hypotheses import Hypotheses
from xplain.errors import InputError
from xplain.explanation.habits import Habits, habits_of
from xplain.explanation.listening import PRIOR_PEOPLE, learn_habits
from xplain.explanation.message_sets import indices
from xplain.people.collect import bot
from xplain.people.collect.asking import (
    HEEDED,
    QUESTION,
    AskedClip,
    CollectState,
    mean_posterior,
)
from xplain.people.collect.bot import Observer
from xplain.people.collect.tables import PersonAnswers, collect_pages, listeners_in
from xplain.people.store import Store

MESSAGES = 3
COLLECTION = street_collection(listening=MESSAGES)
FEW_QUESTIONS = street_collection(points=8, listening=MESSAGES)
UNKNOWN = habits_of("learned", "learned", "learned")


def somebody(held: int, number: int, habits: bot.Habits = FAULTLESS) -> CollectState:
    person = Observer(COLLECTION.plan, held, habits, np.random.default_rng(number))
    return observe(COLLECTION, person, number, {})


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 15), st.integers(0, 1000))
def test_what_is_told_explains_a_step_and_is_asked_about_twice_more(held: int, number: int) -> None:
    known = COLLECTION.plan.hypotheses
    answered = somebody(held, number).answered
    told, later, again = ([c for c in answered if c.purpose == what] for what in HEEDED)
    assert [*told, *later, *again] == list(answered[-3 * MESSAGES :])
    assert [c.told for c in again] == [c.told for c in told]
    assert [c.told for c in later] == [0] * MESSAGES
    assert [c.transitions for c in told] == [c.transitions for c in later]
    assert [c.transitions for c in told] == [c.transitions for c in again]
    right = 0
    for clip in told:
        assert clip.told.bit_count() == 1
        assert not clip.told & right
        labels = [
            known.labels[known.row(np.array(held & ~facts))] for facts in (right, right | clip.told)
        ]
        before, after = (int(one[clip.transitions[0]]) for one in labels)
        left = held & ~right  # on the street a step goes with each fact, whatever else is held
        assert (before, after) == (0, 1) or not left
        right |= clip.told
    assert all(c.labels == (1,) for c in (*told, *later, *again))  # who never misses nor forgets


def enumerated(asked: PersonAnswers, habits: Habits) -> NDArray[np.float64]:
    """Computes [F] the posterior, over every way in which this person may miss and forget the
    messages of each page."""
    known, found = asked.known, np.zeros(len(habits))
    for (held, share), f in product(zip(asked.held, asked.prior, strict=True), range(len(habits))):
        ways = {0: share * habits.prior[f]}
        for clip in asked.clips:
            lasts = clip.purpose in HEEDED
            now = dict[tuple[int, int], float]()  # what is right on later pages, and on this one
            for right, p in ways.items():
                taken = {(right if lasts else 0): p}
                for j in indices(clip.told):
                    taken = _moved(taken, 1 << j, 0, habits.accept[f])
                for here, p_here in taken.items():
                    key = (here if lasts else right, here)
                    now[key] = now.get(key, 0) + p_here
            ways = {}
            for (right, here), p in now.items():
                row = known.row(np.array(int(held) & ~here))
                for transition, label in zip(clip.transitions, clip.labels, strict=True):
                    errs = known.labels[row, transition] != label
                    p *= habits.error[f] if errs else 1 - habits.error[f]
                ways[right] = ways.get(right, 0) + p
            for j in range(len(known.messages)):
                ways = _moved(ways, 0, 1 << j, habits.forget[f])
        found[f] += sum(ways.values())
    return found / found.sum()


def _moved(ways: dict[int, float], right: int, wrong: int, chance: float) -> dict[int, float]:
    after = dict[int, float]()
    for known, p in ways.items():
        for facts, share in ((known & ~wrong | right, chance), (known, 1 - chance)):
            after[facts] = after.get(facts, 0) + p * share
    return after


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_what_one_person_tells_equals_enumeration(seed: int) -> None:
    """This holds for any pages; pages without lasting messages may be in between."""
    rng = np.random.default_rng(seed)
    table = np.vstack([np.ones(4), rng.integers(2, size=(7, 4))])
    table[:, 0] = [not held & 1 for held in range(8)]  # some question tells candidates apart
    known = Hypotheses.of(table)
    purposes = rng.choice([QUESTION, *HEEDED], 5)
    clips = [
        AskedClip(
            str(what),
            tuple(rng.integers(4, size=2).tolist()),
            int(rng.integers(8)),
            tuple(rng.integers(2, size=2).tolist()),
        )
        for what in sorted(purposes, key=lambda what: what in HEEDED)
    ]
    habits = Habits(
        rng.choice([0.1, 0.3], 3), rng.choice([1, 0.6], 3), [0, 0.3, 0.1], [0.5, 0.3, 0.2]
    )
    asked = PersonAnswers(known, np.array([1, 3, 6]), rng.dirichlet(np.ones(3)), clips)
    assert asked.posterior(habits) == pytest.approx(enumerated(asked, habits), abs=1e-9)


@pytest.mark.parametrize(
    ("accept", "forget", "seed"), [(1.0, 0.0, 0), (0.8, 0.0, 1), (0.8, 0.1, 2), (1.0, 0.05, 3)]
)
def test_rates_of_simulated_people_are_found_again(accept: float, forget: float, seed: int) -> None:
    """Rates are right within four standard errors, plus the pull of the documented shares on half
    as many people. On the street a person believes two of four facts incorrectly. On the page with
    the first message about such a fact, the label is 1 with p = α (1 − e) + (1 − α) e, so the
    standard error of α is sd(p) / (1 − 2e). An accepted fact is still known three pages later with
    (1 − φ)³, whose slope is at most 3."""
    people, error, plan = 120, 0.05, FEW_QUESTIONS.plan
    habits = bot.Habits(error, forgetting=1 - accept, losing=forget, mistake=0)
    states: list[CollectState] = []
    for number in range(people):
        role = plan.roles[number % len(plan.roles)]
        person = Observer(plan, role.held, habits, np.random.default_rng([seed, number]))
        others = mean_posterior([state.belief for state in states[-10:]])
        states.append(observe(FEW_QUESTIONS, person, number, others))
    found = learn_habits([collect_pages(plan, state) for state in states])
    pull = PRIOR_PEOPLE / (people / 2 + PRIOR_PEOPLE)
    rates, stays = {"accept": accept, "forget": forget}, (1 - forget) ** MESSAGES
    noise = {"accept": (accept, 1.0, 1.0), "forget": (stays, 3 * (1 - forget) ** 2, accept)}
    for key, (chance, slope, share) in noise.items():
        one = chance * (1 - error) + (1 - chance) * error
        deviation = np.sqrt(one * (1 - one) / (people * share)) / (slope * (1 - 2 * error))
        true, before = rates[key], float(getattr(UNKNOWN, key) @ UNKNOWN.prior)
        tolerance = 4 * deviation + pull * abs(true - before)
        assert abs(float(getattr(found, key) @ found.prior) - true) <= tolerance, key
    mean = float(found.error @ found.prior)
    clips = sum(len(clip.labels) for clip in states[0].answered) * people
    assert abs(mean - error) <= 4 * np.sqrt(error / clips * 2) + pull * error


def test_the_command_learns_from_a_stream_alone(tmp_path: Path, run: Run) -> None:
    path = tmp_path / "c.sqlite"
    filled("collect", path)
    said = run("collect habits", path)[1]
    assert said.startswith("3 participants: ")
    assert [line.split("=")[0] for line in said.splitlines()[1:]] == [
        *("belief.error", "belief.accept", "belief.forget")
    ]
    with pytest.raises(InputError, match="a database with answers"):
        listeners_in(path, "bot")
    Store(tmp_path / "without.sqlite", street_collection()).close()
    with pytest.raises(InputError, match=r"rules\.listening.*nothing was asked again"):
        listeners_in(tmp_path / "without.sqlite")


def test_more_messages_than_facts_are_refused() -> None:
    with pytest.raises(InputError, match=r"rules\.listening.*at most one message for each fact: 4"):
        street_plan(listening=5)
    with pytest.raises(InputError, match=r"rules\.listening"):
        street_plan(listening=-1)
