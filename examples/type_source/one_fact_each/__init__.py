"""Makes one user type for each fact: people who believe this fact incorrectly. Optionally adds a
newcomer, who believes all facts incorrectly."""

from dataclasses import dataclass

import numpy as np

from xplain import Domain, InputError, UserType


@dataclass(frozen=True)
class OneFactEach:
    """Attributes:
    newcomer: True adds a type that believes everything incorrectly.
    """

    newcomer: bool = True

    def types(self, domain: Domain, rng: np.random.Generator) -> tuple[UserType, ...]:
        """Makes types with the names of their incorrect facts. Nothing is random."""
        wrong = {parameter.name: parameter.inaccurate for parameter in domain.parameters}
        if self.newcomer and len(wrong) < 2:
            raise InputError("users.newcomer", True, "false if the domain has one parameter")
        each = [UserType(name, {name: value}) for name, value in wrong.items()]
        return (*each, UserType("newcomer", wrong)) if self.newcomer else tuple(each)
