"""Labels of people who hold a domain's inaccurate values, or multiples of them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Domain, Parameter
from xplain.domains.users.setting import Setting, UserType
from xplain.errors import DomainError, InputError, XplainError
from xplain.explanation.message_sets import indices, names_of, subsets

log = logging.getLogger(__name__)

AS_ASSUMED = 0.6
"""Prior of the assumed values, where there are variants."""
OPPOSITE = 0.05
"""Prior of all values on the other side of the robot's, together."""
EACH = 8
"""Facts up to which each is also on the other side alone."""
NUDGES = (1.0, 1.01, 0.99, 1.02, 0.98, 1.05, 0.95)
"""Where ties at some values are ambiguous, the values times each of these are tried, in this order:
nobody's idea of a size is so exact."""


def labels_of(
    domain: Domain, most: int, value: Mapping[str, Any]
) -> tuple[Setting, NDArray[np.int64], NDArray[np.uint8]]:
    """The sets of at most ``most`` facts [C], and who holds them, at these wrong values, labels
    what the robot can do [C, T].

    Raises:
        DomainError: some model's ties are ambiguous.
        InputError: the domain refuses a value.
    """
    n = len(domain.parameters)
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


def variants_of(
    domain: Domain, most: int, scales: Sequence[float]
) -> list[tuple[dict[str, Any], NDArray[np.uint8], float]]:
    """Wrong values that people may hold in place of those assumed, by parameter, with their labels
    [C, T] and their prior probability.

    A value that the domain refuses stays as assumed. Where ties are ambiguous, values are nudged,
    or stay as assumed with a warning (:func:`without_ties`). Where no value is another than
    assumed, there is no variant.

    Args:
        domain: its inaccurate values are those assumed.
        most: parameters believed incorrectly together.
        scales: one variant each: all inaccurate values that are numbers times this. Further
            variants have them on the other side of the robot's values, all at once or, up to EACH
            facts, one alone.
    """
    assumed = {parameter.name: parameter.inaccurate for parameter in domain.parameters}
    opposite = opposite_values(domain)
    turned = [opposite]
    if len(opposite) <= EACH:
        turned += [assumed | {name: value} for name, value in opposite.items()]
    scaled = [scaled_values(domain, scale) for scale in scales]
    found = []
    for share, wanted in ((1 - AS_ASSUMED - OPPOSITE, scaled), (OPPOSITE, turned)):
        different = {str(one): one for one in wanted if one != assumed}
        made = [without_ties(domain, most, one) for one in different.values()]
        made = [(values, labels) for values, labels in made if values != assumed]
        found += [(values, labels, share / len(made)) for values, labels in made]
    return found


def without_ties(
    domain: Domain, most: int, wanted: Mapping[str, Any]
) -> tuple[dict[str, Any], NDArray[np.uint8]]:
    """Wrong values as near to those wanted as leaves no tie ambiguous, and their labels [C, T].

    Where ties are ambiguous at those wanted, each parameter in turn takes its wanted value, or the
    first of its :data:`NUDGES` at which none is, those before it being as found, those after it as
    assumed. One for which every nudge fails stays as assumed, and a warning tells so.

    Args:
        domain: its inaccurate values must leave no tie ambiguous.
        most: parameters believed incorrectly together.
        wanted: for each parameter a value that the domain takes.
    """
    try:
        return dict(wanted), labels_of(domain, most, wanted)[2]
    except DomainError:
        log.debug("hypotheses: ties are ambiguous at %s", wanted)
    assumed = {one.name: one.inaccurate for one in domain.parameters}
    chosen, labels = assumed, labels_of(domain, most, assumed)[2]
    for name in (name for name in wanted if wanted[name] != assumed[name]):
        for nudge in NUDGES:
            value = wanted[name]
            tried = chosen | {name: value * nudge if _is_number(value) else value}
            try:
                chosen, labels = tried, labels_of(domain, most, tried)[2]
                if nudge != 1:
                    log.info("hypotheses: a variant has %s=%s", name, tried[name])
                break
            except (DomainError, InputError) as error:
                reason = str(error)
        else:
            stays = "hypotheses: no variant with %s=%s, it stays %s: %s"
            log.warning(stays, name, wanted[name], assumed[name], reason)
    return chosen, labels


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


@dataclass(frozen=True)
class FurtherLabels:
    """Labels of sets of facts that no list holds yet, worked out when asked for, each once.

    Attributes:
        domain: whose models.
        values: [1 + V] wrong values by parameter: those assumed, and those of the variants.
        transitions: [T, 3].
        columns: [K] those of the transitions that are asked for.
    """

    domain: Domain
    values: tuple[Mapping[str, Any], ...]
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
            solved = np.stack([self._solved(missing, wrong) for wrong in self.values])
            self._known.update(zip(missing, np.moveaxis(solved, 1, 0), strict=True))
        return np.stack([self._known[held][:, self.columns] for held in facts.tolist()], axis=1)

    def _solved(self, facts: list[int], wrong: Mapping[str, Any]) -> NDArray[np.uint8]:
        accurate = {one.name: one.accurate for one in self.domain.parameters}
        held = [names_of(one, tuple(accurate)) for one in facts]
        models = [self.domain.model(accurate | {name: wrong[name] for name in own}) for own in held]
        whose = [f"who holds {', '.join(own)} wrong" for own in held]
        return models[0].solve(models, whose).labels(self.transitions)


def scaled_values(domain: Domain, scale: float) -> dict[str, Any]:
    """All inaccurate values times ``scale``, by parameter, where they are numbers and the domain
    takes them."""
    return {
        one.name: _taken(domain, one, lambda _, wrong: scale * wrong) for one in domain.parameters
    }


def opposite_values(domain: Domain) -> dict[str, Any]:
    """Of each parameter the value as far from the robot's on the other side, where both are numbers
    and the domain takes it: the fire that people fear may also be believed a bonus."""
    return {
        one.name: _taken(domain, one, lambda right, wrong: 2 * right - wrong)
        for one in domain.parameters
    }


def _taken(domain: Domain, parameter: Parameter, other: Callable[[float, float], float]) -> Any:
    """Another wrong value, or the inaccurate one where the domain does not take the other."""
    right, wrong = parameter.accurate, parameter.inaccurate
    if not _is_number(wrong) or not _is_number(right):
        return wrong
    values = {one.name: one.accurate for one in domain.parameters}
    try:
        domain.model(values | {parameter.name: other(right, wrong)})
    except XplainError:
        return wrong
    return other(right, wrong)


def few(facts: NDArray[np.int64], n: int, share: float) -> NDArray[np.float64]:
    """[C] probabilities of the sets, were each of n facts believed incorrectly with probability
    ``share``, independently, and no other sets possible."""
    size = np.bitwise_count(facts).astype(np.float64)
    weight = share**size * (1 - share) ** (n - size)
    return np.asarray(weight / weight.sum())


def with_subsets(facts: Sequence[int]) -> NDArray[np.int64]:
    """These sets and all of their subsets, ascending."""
    return np.unique(np.concatenate([subsets(indices(held)) for held in facts]))
