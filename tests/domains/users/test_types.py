"""Type sources: the paper's types, all completions, random covers, types of one's own."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hydra.utils import instantiate
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.domains.configs import configured, domain_of
from tests.domains.users.corridor import Painted
from xplain.domains.users import types
from xplain.domains.users.setting import Setting, UserType
from xplain.domains.users.types import Explicit, FewFacts, RandomCover
from xplain.errors import InputError
from xplain.randomness import stream

RNG = stream(0, "users")
BONUSES, OBSTACLES = {"first_aid", "fire", "refuel"}, {"rubble", "puddle", "fence"}


def types_of(*overrides: str) -> tuple[UserType, ...]:
    source = instantiate(configured(*overrides).users)
    types: tuple[UserType, ...] = source.types(domain_of(overrides[0]), stream(0, "users"))
    return types


def test_the_papers_types_are_the_default() -> None:
    types = {t.name: set(t.inaccurate) for t in types_of("domain=rescue")}
    assert list(types) == list("ABCDE")
    assert types["B"] == {"first_aid", "fence"}
    assert types["E"] == {"refuel", "puddle"}


def test_there_are_27_completions_and_the_default_is_one() -> None:
    source = instantiate(configured("domain=rescue", "users=rescue_completions").users)
    assert len(source.completions()) == 27
    everyone = set()
    for index in range(27):
        chosen = replace(source, index=index)
        types = chosen.types(domain_of("domain=rescue"), RNG)
        facts = [frozenset(t.inaccurate) for t in types]
        assert [t.name for t in types] == list("ABCDE")
        assert facts[1] == {"first_aid", "fence"}
        assert facts[4] == {"refuel", "puddle"}
        assert all(len(f & BONUSES) == len(f & OBSTACLES) == 1 for f in facts)
        assert len(set(facts)) == 5
        assert set().union(*facts) == BONUSES | OBSTACLES
        everyone.add(frozenset(facts))
    assert len(everyone) == 27
    assert frozenset(frozenset(t.inaccurate) for t in types_of("domain=rescue")) in everyone


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([2, 3, 4]), st.booleans())
def test_random_types_cover_all_parameters(seed: int, count: int, distinct: bool) -> None:
    domain = domain_of("domain=four_rooms")
    types = RandomCover(count, distinct).types(domain, stream(seed, "users"))
    facts = [frozenset(t.inaccurate) for t in types]
    assert len(set(facts)) == count
    assert all(facts)
    assert set().union(*facts) == {p.name for p in domain.parameters}
    if distinct:
        assert len(np.unique(Setting.build(domain, types).distinct)) == count


def test_types_that_differ_in_what_changes_nothing_are_drawn_only_if_asked_for() -> None:
    domain, alike = Painted(), 0
    for seed in range(20):
        for distinct in (True, False):
            types = RandomCover(2, distinct).types(domain, stream(seed, "users"))
            one, two = (set(t.inaccurate) - {"colour"} for t in types)
            assert one != two or not distinct
            alike += one == two
    assert alike > 0


def test_random_types_are_uniform_over_the_covers() -> None:
    """With three facts, all ordered pairs of different subsets that cover them are equally
    frequent."""
    pairs = [(a, b) for a in range(1, 8) for b in range(1, 8) if a != b and a | b == 7]
    names = [p.name for p in Painted.parameters]
    rng, count = np.random.default_rng(0), 2000
    found: Counter[tuple[int, ...]] = Counter()
    for _ in range(count):
        types = RandomCover(2, distinct=False).types(Painted(), rng)
        found[tuple(sum(1 << names.index(f) for f in t.inaccurate) for t in types)] += 1
    p = 1 / len(pairs)
    error = (p * (1 - p) / count) ** 0.5
    assert set(found) == set(pairs)
    assert all(abs(found[pair] / count - p) < 5 * error for pair in pairs)


def test_few_facts_are_as_many_as_said_and_any() -> None:
    """The number of facts is drawn uniformly from 1, 2, 3, then the facts. Each single fact and
    each pair has probability 1/9; all three facts have 1/3."""
    rng, count = np.random.default_rng(0), 300
    found = Counter(
        frozenset(FewFacts(1, 1, 3).types(Painted(), rng)[0].inaccurate) for _ in range(count)
    )
    assert len(found) == 7
    for facts, times in found.items():
        p = 1 / 3 if len(facts) == 3 else 1 / 9
        assert abs(times / count - p) < 5 * (p * (1 - p) / count) ** 0.5, facts


def test_types_of_few_facts_behave_differently(monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(30):
        drawn = FewFacts(2, 1, 2).types(Painted(), stream(seed, "users"))
        one, two = (set(t.inaccurate) - {"colour"} for t in drawn)
        assert one != two
    monkeypatch.setattr(types, "ATTEMPTS", 5)
    with pytest.raises(InputError, match=r"users\.count.*no draw of 5"):
        FewFacts(8, 1, 1).types(Painted(), RNG)


def test_a_draw_that_cannot_be_found_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(types, "ATTEMPTS", 1)
    domain = domain_of("domain=four_rooms")
    with pytest.raises(InputError, match="at most 31"):
        RandomCover(32).types(domain, RNG)
    with pytest.raises(InputError, match=r"no draw of 1 gives"):
        RandomCover(31).types(domain, RNG)


def test_written_types_may_bring_their_own_values() -> None:
    domain = domain_of("domain=rescue")
    groups = {"careful": {"rubble": -3.0, "fence": None}, "plain": ["fire"]}
    careful, plain = Explicit(groups).types(domain, RNG)
    default = {p.name: p.inaccurate for p in domain.parameters}
    assert careful.inaccurate == {"rubble": -3.0, "fence": default["fence"]}
    assert plain.inaccurate == {"fire": default["fire"]}


@pytest.mark.parametrize(
    ("groups", "text"),
    [
        ({}, "at least one user type"),
        ([["fire"]], "at least one user type"),
        ({"A": []}, "some of the parameters"),
        ({"A": "fire"}, "some of the parameters"),
        ({"A": ["wind"]}, "unknown parameter of rescue; known: first_aid"),
        ({"A": {"wind": 1.0}}, "unknown parameter"),
    ],
)
def test_bad_types_are_one_clear_line(groups: Any, text: str) -> None:
    with pytest.raises(InputError, match=text):
        Explicit(groups).types(domain_of("domain=rescue"), RNG)
