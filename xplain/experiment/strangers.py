"""Users of types that nobody was of among the observers (``explainee=stranger``)."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from xplain.domains.base import Domain
from xplain.domains.users.setting import Setting, UserType
from xplain.domains.users.types import user_type
from xplain.errors import DomainError, InputError
from xplain.experiment.pipeline import Components, Prepared
from xplain.randomness import stream

TRIES = 40
"""Sets of facts drawn."""


def with_strangers(prepared: Prepared, components: Components) -> Prepared:
    """The same learned types and traces, to users of other types: as many as there are true types,
    if so many are found, whose facts behave unlike those of every true type and of each other.

    What needs a true type's observers is empty: the oracle's labels, and which learned type is the
    right one.

    Raises:
        InputError: no set of facts behaves unlike the true types.
    """
    domain, seed = components.domain, components.seed
    observed = components.users.types(domain, stream(seed, "users"))
    candidates = _candidates(domain, max(len(t.inaccurate) for t in observed) + 1, seed)
    setting = Setting.build(domain, (*observed, *candidates))
    alike = setting.distinct.tolist()
    new = [t for t in range(len(observed), len(alike)) if alike[t] not in alike[:t]]
    new = new[: len(observed)]
    if not new:
        raise InputError("explainee", "stranger", "a domain in which other facts behave otherwise")
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


def _candidates(domain: Domain, most: int, seed: int) -> list[UserType]:
    """Types with at most so many facts, drawn at random, whose task has a way to its goal."""
    rng = stream(seed, "explainee", "strangers")
    names = [parameter.name for parameter in domain.parameters]
    found: dict[tuple[str, ...], UserType] = {}
    for _ in range(TRIES):
        size = int(rng.integers(1, min(most, len(names)) + 1))
        facts = tuple(names[j] for j in sorted(rng.choice(len(names), size, replace=False)))
        stranger = user_type(domain, f"stranger {'+'.join(facts)}", facts)
        with suppress(DomainError):
            Setting.build(domain, (stranger,))
            found[facts] = stranger
    return list(found.values())
