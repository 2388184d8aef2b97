"""Compares label tables with models that are solved one by one, and tests which types count as
one."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.domains.configs import domain_of, setting_of
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

    with pytest.raises(
        InputError, match=r"domain\.parameters='end, tol'.*parameter toll"
    ) as caught:
        Setting.build(Misspelt(), (UserType("A", {"end": "left"}),))
    assert "\n" not in str(caught.value)


def test_types_that_other_messages_set_right_are_two() -> None:
    """Two facts have the same effect: their types give the same labels before any message."""

    class Twice(Corridor):
        parameters = (Corridor.parameters[0], Parameter("goal", "right", "left", "It is right."))

        def model(self, values: Mapping[str, Any]) -> mdp.MDP:
            left = "left" in (values["end"], values["goal"])
            return super().model({"end": "left" if left else "right", "toll": 0.0})

    one, other = UserType("one", {"end": "left"}), UserType("other", {"goal": "left"})
    assert Setting.build(Twice(), (one, other)).distinct.tolist() == [0, 1]


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


def test_types_that_label_alike_are_one_type() -> None:
    setting = setting_of(RESCUE)
    table = setting.label_table(setting.reachable)
    alike = (table[:, None] == table[None]).all(axis=(2, 3))
    assert np.array_equal(alike, setting.distinct[:, None] == setting.distinct[None])
