"""What every source of user types keeps to (see :mod:`xplain.users.types`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from xplain.testing.chosen import Chosen
from xplain.users.setting import Setting, UserType


class TypeSourceConformance:
    """Attributes:
    component: the source.
    domain: whose parameters the types hold wrong.
    """

    component: Any
    domain: Any = Chosen("domain", "rescue")

    def test_types_hold_parameters_of_the_domain_wrong(self) -> None:
        """At least one type, each with a name of its own and something it does not know."""
        known = {parameter.name for parameter in self.domain.parameters}
        types = self._types(0)
        assert types, "no types"
        names = [user_type.name for user_type in types]
        assert len(set(names)) == len(names), f"names are given twice: {names}"
        for user_type in types:
            assert isinstance(user_type, UserType), f"{user_type!r} is no UserType"
            assert user_type.inaccurate, f"{user_type.name} holds everything right"
            assert user_type.inaccurate.keys() <= known, f"{user_type.name}: unknown parameters"

    def test_the_same_stream_gives_the_same_types(self) -> None:
        """Whatever is random comes from ``rng``."""
        for seed in range(3):
            assert self._types(seed) == self._types(seed), "the types are random by themselves"

    def test_their_labels_can_be_computed(self) -> None:
        """Every model that they need is solved, with clear ties."""
        for seed in range(3):
            setting = Setting.build(self.domain, self._types(seed))
            assert len(setting.distinct) == len(setting.types)

    def test_types_can_be_told_apart(self) -> None:
        """No two types label every transition alike; otherwise they are one."""
        for seed in range(3):
            distinct = Setting.build(self.domain, self._types(seed)).distinct
            assert len(np.unique(distinct)) == len(distinct), f"alike: {distinct.tolist()}"

    def _types(self, seed: int) -> tuple[UserType, ...]:
        return tuple(self.component.types(self.domain, np.random.default_rng(seed)))
