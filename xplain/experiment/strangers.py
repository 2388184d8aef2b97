"""Users of types that no observer has (``Explainee.others``)."""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from xplain.domains.base import Domain
from xplain.domains.users.setting import Setting, UserType
from xplain.errors import DomainError, InputError
from xplain.experiment.pipeline import Components, PreparedData
from xplain.interaction.explainees import Explainee
from xplain.randomness import stream


def with_others(
    prepared: PreparedData, components: Components, explainee: Explainee
) -> PreparedData:
    """Returns the same learned types and traces, with users of other types (``Explainee.others``).
    There are as many users as true types, if enough other types differ from every true type and
    from each other.

    Fields that need observers of a true type are empty: the oracle's labels, and the matching
    learned type.

    Raises:
        InputError: all other types behave like the true types.
    """
    domain, seed = components.domain, components.seed
    observed = components.users.types(domain, stream(seed, "users"))
    others = explainee.others(domain, observed, stream(seed, "explainee", "strangers"))
    setting = Setting.build(domain, (*observed, *(t for t in others if _is_solvable(domain, t))))
    alike = setting.distinct.tolist()
    new = [t for t in range(len(observed), len(alike)) if alike[t] not in alike[:t]]
    new = new[: len(observed)]
    if not new:
        name = type(explainee).__name__
        raise InputError(
            "explainee", name, "a domain in which such users differ from the true types"
        )
    return replace(
        prepared,
        types=tuple(setting.types[t].name for t in new),
        distinct=len(alike) + np.arange(len(new)),
        cases=tuple(
            replace(
                case,
                perfect=None,
                labels=setting.true_labels(case.transitions).of_types(new),
                questions=case.questions and case.questions.of_users(setting, new),
            )
            for case in prepared.cases
        ),
    )


def _is_solvable(domain: Domain, user_type: UserType) -> bool:
    """True if the task can be solved under the type's beliefs."""
    with suppress(DomainError):
        Setting.build(domain, (user_type,))
        return True
    return False
