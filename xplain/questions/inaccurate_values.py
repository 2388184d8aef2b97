"""Labels of people who hold a domain's inaccurate values, or multiples of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Domain, Parameter
from xplain.errors import XplainError
from xplain.message_sets import names_of, subsets
from xplain.users.setting import Setting, UserType


def labels_of(
    domain: Domain, most: int, scale: float
) -> tuple[Setting, NDArray[np.int64], NDArray[np.uint8]]:
    """The sets of at most ``most`` facts [C], and who holds them, at the scaled values, labels
    what the robot can do [C, T]."""
    n = len(domain.parameters)
    value = scaled_values(domain, scale)
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


@dataclass(frozen=True)
class FurtherLabels:
    """Labels of sets of facts that no list holds yet, worked out when asked for, each once.

    Attributes:
        domain: whose models.
        scales: [1 + V] of the inaccurate values: 1, and those of the variants.
        transitions: [T, 3].
        columns: [K] those of the transitions that are asked for.
    """

    domain: Domain
    scales: tuple[float, ...]
    transitions: NDArray[np.int64]
    columns: NDArray[np.int64]
    _known: dict[int, NDArray[np.uint8]] = field(default_factory=dict)

    def take(self, columns: NDArray[np.int64]) -> FurtherLabels:
        """Of some transitions alone; what is worked out is shared."""
        return replace(self, columns=self.columns[columns])

    def of(self, facts: NDArray[np.int64]) -> NDArray[np.uint8]:
        """[1 + V, C, K] labels of who holds these sets [C] wrong.

        Raises:
            DomainError: some model's ties are ambiguous.
        """
        missing = [held for held in facts.tolist() if held not in self._known]
        if missing:
            solved = np.stack([self._solved(missing, scale) for scale in self.scales])
            self._known.update(zip(missing, np.moveaxis(solved, 1, 0), strict=True))
        return np.stack([self._known[held][:, self.columns] for held in facts.tolist()], axis=1)

    def _solved(self, facts: list[int], scale: float) -> NDArray[np.uint8]:
        accurate = {one.name: one.accurate for one in self.domain.parameters}
        wrong, names = scaled_values(self.domain, scale), tuple(accurate)
        held = [names_of(one, names) for one in facts]
        models = [self.domain.model(accurate | {name: wrong[name] for name in own}) for own in held]
        whose = [f"who holds {', '.join(own)} wrong" for own in held]
        return models[0].solve(models, whose).labels(self.transitions)


def scaled_values(domain: Domain, scale: float) -> dict[str, Any]:
    """All inaccurate values times ``scale``, by parameter, where they are numbers and the domain
    takes them."""
    return {one.name: _scaled(domain, one, scale) for one in domain.parameters}


def _scaled(domain: Domain, parameter: Parameter, scale: float) -> Any:
    wrong = parameter.inaccurate
    if scale == 1 or isinstance(wrong, bool) or not isinstance(wrong, (int, float)):
        return wrong
    values = {one.name: one.accurate for one in domain.parameters}
    try:
        domain.model(values | {parameter.name: scale * wrong})
    except XplainError:
        return wrong
    return scale * wrong


def few(facts: NDArray[np.int64], n: int, share: float) -> NDArray[np.float64]:
    """[C] probabilities of the sets, were each of n facts held wrong with probability ``share``,
    independently, and no other sets possible."""
    size = np.bitwise_count(facts).astype(np.float64)
    weight = share**size * (1 - share) ** (n - size)
    return np.asarray(weight / weight.sum())


def with_subsets(facts: Sequence[int]) -> NDArray[np.int64]:
    """These sets and all of their subsets, ascending."""
    from xplain.message_sets import indices

    return np.unique(np.concatenate([subsets(indices(held)) for held in facts]))
