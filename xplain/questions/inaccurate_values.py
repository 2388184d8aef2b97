"""Labels of people who hold a domain's inaccurate values, or multiples of them."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Domain, Parameter
from xplain.errors import XplainError
from xplain.message_sets import subsets
from xplain.users.setting import Setting, UserType


def labels_of(
    domain: Domain, most: int, scale: float
) -> tuple[Setting, NDArray[np.int64], NDArray[np.uint8]]:
    """The sets of at most ``most`` facts [C], and who holds them, at the scaled values, labels
    what the robot can do [C, T]."""
    n = len(domain.parameters)
    value = {p.name: _scaled(domain, p, scale) for p in domain.parameters}
    names = [parameter.name for parameter in domain.parameters]
    largest = list(combinations(range(n), most))
    setting = Setting.build(
        domain,
        tuple(
            UserType(str(i), {names[j]: value[names[j]] for j in chosen})
            for i, chosen in enumerate(largest)
        ),
    )
    model: dict[int, int] = {}
    for i, chosen in enumerate(largest):
        own = subsets(chosen)
        models = setting.model_index(i, int(own[-1]) & ~own)
        model.update(zip(own.tolist(), models.tolist(), strict=True))
    facts = np.array(sorted(model))
    by_model = setting.label_by_model(setting.reachable)
    return setting, facts, by_model[[model[held] for held in facts.tolist()]]


def _scaled(domain: Domain, parameter: Parameter, scale: float) -> Any:
    """The inaccurate value times ``scale``, where it is a number and the domain takes it."""
    wrong = parameter.inaccurate
    if scale == 1 or isinstance(wrong, bool) or not isinstance(wrong, (int, float)):
        return wrong
    values = {one.name: one.accurate for one in domain.parameters}
    try:
        domain.model(values | {parameter.name: scale * wrong})
    except XplainError:
        return wrong
    return scale * wrong
