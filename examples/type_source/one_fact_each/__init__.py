"""One user type a fact: everybody has one wrong idea. And a newcomer, who has them all."""

from dataclasses import dataclass

import numpy as np

from xplain import Domain, InputError, UserType


@dataclass(frozen=True)
class OneFactEach:
    """Attributes:
    newcomer: whether there is a type that believes everything incorrectly.
    """

    newcomer: bool = True

    def types(self, domain: Domain, rng: np.random.Generator) -> tuple[UserType, ...]:
        """Named after what they believe incorrectly. Nothing is random here."""
        wrong = {parameter.name: parameter.inaccurate for parameter in domain.parameters}
        if self.newcomer and len(wrong) < 2:
            raise InputError("users.newcomer", True, "false where the domain has one parameter")
        each = [UserType(name, {name: value}) for name, value in wrong.items()]
        return (*each, UserType("newcomer", wrong)) if self.newcomer else tuple(each)
