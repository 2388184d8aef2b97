"""Label tables against one model solved at a time, and what counts as one type."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.domains.configs import domain_of, setting_of
from tests.domains.example import warehouse
from tests.domains.users.corridor import SIZE, Corridor, Padded
from xplain.domains import mdp
from xplain.domains.base import Parameter
from xplain.domains.users import setting as module
from xplain.domains.users.setting import Setting, UserType
from xplain.errors import InputError, TooLargeError

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
        expected = mdp.MDP.solve([model], ["theirs"]).labels(transitions)[0]
        assert np.array_equal(table[t, :, given], expected)
        one_by_one = setting.labels(t, transitions, np.full(len(transitions), given))
        assert np.array_equal(one_by_one, expected)


def test_told_everything_every_type_agrees_with_the_robot() -> None:
    setting = setting_of(RESCUE)
    assert setting.label_table(setting.reachable)[:, :, -1].all()


def test_messages_about_what_a_type_knows_change_nothing() -> None:
    setting = setting_of(RESCUE)
    table = setting.label_table(setting.reachable)
    for t, bits in enumerate(setting.bits):
        for j in set(range(6)) - set(bits):
            given = np.arange(64)
            assert np.array_equal(table[t][:, given], table[t][:, given | 1 << j])


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
    model, optimal = setting.models[0], setting.optimal[0]
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
    """Its name in the configuration is misspelt."""

    class Misspelt(Corridor):
        parameters = (Corridor.parameters[0], replace(Corridor.parameters[1], name="tol"))

    with pytest.raises(
        InputError, match=r"domain\.parameters='end, tol'.*parameter toll"
    ) as caught:
        Setting.build(Misspelt(), (UserType("A", {"end": "left"}),))
    assert "\n" not in str(caught.value)


def test_types_that_label_alike_are_one() -> None:
    domain = domain_of(RESCUE)
    default = {p.name: p.inaccurate for p in domain.parameters}
    types = (
        UserType("one", {"fire": default["fire"]}),
        UserType("two", {"fire": default["fire"] * 1.01}),
        UserType("three", {"rubble": default["rubble"]}),
    )
    assert Setting.build(domain, types).distinct.tolist() == [0, 0, 1]


def test_types_that_other_messages_set_right_are_two() -> None:
    """Two facts of one effect: their types label alike as long as nothing is said."""

    class Twice(Corridor):
        parameters = (Corridor.parameters[0], Parameter("goal", "right", "left", "It is right."))

        def model(self, values: Mapping[str, Any]) -> mdp.MDP:
            left = "left" in (values["end"], values["goal"])
            return super().model({"end": "left" if left else "right", "toll": 0.0})

    one, other = UserType("one", {"end": "left"}), UserType("other", {"goal": "left"})
    assert Setting.build(Twice(), (one, other)).distinct.tolist() == [0, 1]


def test_a_table_of_a_million_message_sets_is_refused() -> None:
    for facts in (20, 21):
        domain = warehouse(facts)
        wrong = domain.parameters[-1]
        setting = Setting.build(domain, (UserType("A", {wrong.name: wrong.inaccurate}),))
        few = setting.reachable[:2]
        if facts == 20:
            assert setting.label_table(few).shape == (1, 2, 1 << 20)
        else:
            with pytest.raises(InputError, match="at most 20 messages"):
                setting.label_table(few)
        assert setting.labels_by_type(few).p.shape == (2, 2, 1)


def test_bad_types_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    domain = domain_of(RESCUE)
    fire = UserType("A", {"fire": -1.0})
    with pytest.raises(InputError, match="at least one"):
        Setting.build(domain, ())
    with pytest.raises(InputError, match="different names"):
        Setting.build(domain, (fire, fire))
    with pytest.raises(InputError, match="unknown parameter"):
        Setting.build(domain, (UserType("A", {"wind": 1.0}),))
    monkeypatch.setattr(module, "MAX_MODELS", 4)
    assert len(Setting.build(domain, (UserType("A", {"fire": -1.0, "fence": -1.0}),)).models) == 4
    monkeypatch.setattr(module, "MAX_MODELS", 3)
    with pytest.raises(TooLargeError, match="more than 3 task models"):
        Setting.build(domain, (UserType("A", {"fire": -1.0, "fence": -1.0}),))


def test_labels_by_type_are_those_of_the_table() -> None:
    setting = setting_of(RESCUE)
    by_type = setting.labels_by_type(setting.reachable)
    assert np.array_equal(by_type.array(6), setting.label_table(setting.reachable))


def test_types_that_label_alike_are_one_type() -> None:
    setting = setting_of(RESCUE)
    table = setting.label_table(setting.reachable)
    alike = (table[:, None] == table[None]).all(axis=(2, 3))
    assert np.array_equal(alike, setting.distinct[:, None] == setting.distinct[None])
