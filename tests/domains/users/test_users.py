"""Compares label tables with models that are solved one by one, and tests which types count as
one. Type sources: the paper's types, all completions, random covers, types of one's own."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hydra.utils import instantiate
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.domains.configs import configured, domain_of, setting_of
from tests.domains.users.corridor import SIZE, Corridor, Padded, Painted
from tests.refusals import refused
from xplain import InputError, Parameter, Setting, TooLargeError, UserType, stream
from xplain.domains import mdp
from xplain.domains.users import setting as module
from xplain.domains.users import types
from xplain.domains.users.types import Explicit, FewFacts, RandomCover

RESCUE = "domain=rescue"


def test_the_label_table_is_what_each_corrected_model_says() -> None:
    setting = setting_of(RESCUE)
    domain = setting.domain
    transitions = setting.reachable[::7]
    table = setting.label_table(transitions)
    rng = np.random.default_rng(0)
    for _ in range(40):
        t, given = int(rng.integers(len(setting.types))), int(rng.integers(64))
        own = setting.types[t].inaccurate
        values = {
            p.name: own[p.name] if p.name in own and not given >> j & 1 else p.accurate
            for j, p in enumerate(domain.parameters)
        }
        model = domain.model(values)
        expected = mdp.MDP.solve([model], ["theirs"])[0].labels(transitions)
        assert np.array_equal(table[t, :, given], expected)
        one_by_one = setting.labels(t, transitions, np.full(len(transitions), given))
        assert np.array_equal(one_by_one, expected)


def test_each_distinct_model_is_solved_once() -> None:
    setting = setting_of(RESCUE)
    values = {
        tuple(sorted(set(t.inaccurate) - set(told)))
        for t in setting.types
        for told in [(), *((f,) for f in t.inaccurate), tuple(t.inaccurate)]
    }
    assert len(setting.models) == len(values)


def test_reachable_is_what_every_optimal_policy_can_do() -> None:
    setting = setting_of(RESCUE)
    model, optimal = setting.models[0], setting.models[0].optimal
    found, todo = set(), {int(s) for s in setting.domain.starts}
    seen: set[int] = set()
    while todo:
        s = todo.pop()
        seen.add(s)
        for a in np.flatnonzero(optimal[s]):
            for k in np.flatnonzero(model.probability[s, a]):
                after = int(model.successor[s, a, k])
                found.add((s, int(a), after))
                if after not in seen and not model.terminal[after]:
                    todo.add(after)
    assert found == {tuple(t) for t in setting.reachable.tolist()}


def test_what_cannot_happen_is_not_reachable() -> None:
    plain, padded = (
        Setting.build(domain, (UserType("A", {"end": "left"}),))
        for domain in (Corridor(), Padded())
    )
    right = [[cell, 1, cell + 1] for cell in range(1, SIZE - 1)]
    assert plain.reachable.tolist() == padded.reachable.tolist() == right


def test_a_parameter_that_the_domain_reads_and_does_not_have_is_one_line() -> None:
    """The name of the parameter in the configuration is misspelt."""

    class Misspelt(Corridor):
        parameters = (Corridor.parameters[0], replace(Corridor.parameters[1], name="tol"))

    with refused(r"domain\.parameters='end, tol'.*parameter toll"):
        Setting.build(Misspelt(), (UserType("A", {"end": "left"}),))


def test_types_that_other_messages_set_right_are_two() -> None:
    """Two facts have the same effect: their types give the same labels before any message."""

    class Twice(Corridor):
        parameters = (Corridor.parameters[0], Parameter("goal", "right", "left", "It is right."))

        def model(self, values: Mapping[str, Any]) -> mdp.MDP:
            left = "left" in (values["end"], values["goal"])
            return super().model({"end": "left" if left else "right", "toll": 0.0})

    one, other = UserType("one", {"end": "left"}), UserType("other", {"goal": "left"})
    assert Setting.build(Twice(), (one, other)).distinct.tolist() == [0, 1]


def test_no_more_models_are_solved_than_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    domain, types = domain_of(RESCUE), (UserType("A", {"fire": -1.0, "fence": -1.0}),)
    monkeypatch.setattr(module, "MAX_MODELS", 4)
    assert len(Setting.build(domain, types).models) == 4
    monkeypatch.setattr(module, "MAX_MODELS", 3)
    with pytest.raises(TooLargeError, match="more than 3 task models"):
        Setting.build(domain, types)


def test_types_that_label_alike_are_one_type() -> None:
    setting = setting_of(RESCUE)
    table = setting.label_table(setting.reachable)
    alike = (table[:, None] == table[None]).all(axis=(2, 3))
    assert np.array_equal(alike, setting.distinct[:, None] == setting.distinct[None])


RNG = stream(0, "users")
BONUSES, OBSTACLES = {"first_aid", "fire", "refuel"}, {"rubble", "puddle", "fence"}


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
    assert frozenset(frozenset(t.inaccurate) for t in setting_of(RESCUE).types) in everyone


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
    for seed in range(30):
        for source in (RandomCover(2, True), RandomCover(2, False), FewFacts(2, 1, 2)):
            types = source.types(domain, stream(seed, "users"))
            one, two = (set(t.inaccurate) - {"colour"} for t in types)
            assert one != two or source == RandomCover(2, False)
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


@pytest.mark.parametrize(
    ("source", "said"),
    [
        (RandomCover(32), "at most 31"),
        (RandomCover(31), "no draw of 1 gives"),
        (FewFacts(8, 1, 1), r"users\.count.*no draw of 1"),
    ],
)
def test_a_draw_that_cannot_be_found_says_so(
    source: Any, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(types, "ATTEMPTS", 1)
    with pytest.raises(InputError, match=said):
        source.types(domain_of("domain=four_rooms"), RNG)


def test_written_types_may_bring_their_own_values() -> None:
    domain = domain_of("domain=rescue")
    groups = {"careful": {"rubble": -3.0, "fence": None}, "plain": ["fire"]}
    careful, plain = Explicit(groups).types(domain, RNG)
    default = {p.name: p.inaccurate for p in domain.parameters}
    assert careful.inaccurate == {"rubble": -3.0, "fence": default["fence"]}
    assert plain.inaccurate == {"fire": default["fire"]}


def build(*types: UserType) -> None:
    Setting.build(domain_of(RESCUE), types)


def explicit(groups: Any) -> None:
    Explicit(groups).types(domain_of(RESCUE), RNG)


FIRE = UserType("A", {"fire": -1.0})


@pytest.mark.parametrize(
    ("make", "given", "text"),
    [
        (build, [], "at least one"),
        (build, [FIRE, FIRE], "different names"),
        (build, [UserType("A", {"wind": 1.0})], "unknown parameter"),
        (explicit, [{}], "at least one user type"),
        (explicit, [[["fire"]]], "at least one user type"),
        (explicit, [{"A": []}], "some of the parameters"),
        (explicit, [{"A": "fire"}], "some of the parameters"),
        (explicit, [{"A": ["wind"]}], "unknown parameter of rescue; known: first_aid"),
        (explicit, [{"A": {"wind": 1.0}}], "unknown parameter"),
    ],
)
def test_bad_types_are_one_clear_line(make: Any, given: list[Any], text: str) -> None:
    with refused(text):
        make(*given)
