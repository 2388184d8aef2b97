"""Tests of sources of user types (see :mod:`xplain.domains.users.types`)."""

from typing import Any

import numpy as np

from xplain.domains.base import Domain
from xplain.domains.users.setting import Setting, UserType
from xplain.testing.suite import DomainUser


class TypeSourceConformance(DomainUser):
    """Tests a source of user types, ``types(domain, rng)``. Observers and labels need these
    properties."""

    def test_types_hold_parameters_of_the_domain_wrong(
        self, component: Any, domain: Domain
    ) -> None:
        """There is at least one type, each with a unique name and at least one fact believed
        incorrectly."""
        known = {parameter.name for parameter in domain.parameters}
        types = _draw_types(component, domain, self.seed)
        assert types, "no types"
        names = [user_type.name for user_type in types]
        assert len(set(names)) == len(names), f"names are given twice: {names}"
        for user_type in types:
            assert isinstance(user_type, UserType), f"{user_type!r} is no UserType"
            assert user_type.inaccurate, f"{user_type.name} believes everything correctly"
            assert user_type.inaccurate.keys() <= known, f"{user_type.name}: unknown parameters"

    def test_the_same_stream_gives_the_same_types(self, component: Any, domain: Domain) -> None:
        """All randomness comes from ``rng``."""
        one, other = (_draw_types(component, domain, self.seed) for _ in range(2))
        assert one == other, "the types do not depend on rng alone"

    def test_types_can_be_told_apart(self, component: Any, domain: Domain) -> None:
        """Every model that the types need is solved, with unambiguous ties. No two types have the
        same labels for all transitions: such types would be one type."""
        for seed in range(self.seed, self.seed + 3):
            distinct = Setting.build(domain, _draw_types(component, domain, seed)).distinct
            assert len(np.unique(distinct)) == len(distinct), f"alike: {distinct.tolist()}"


def _draw_types(source: Any, domain: Domain, seed: int) -> tuple[UserType, ...]:
    return tuple(source.types(domain, np.random.default_rng(seed)))
