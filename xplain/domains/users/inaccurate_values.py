"""Labels of people who believe a domain's inaccurate values, or multiples of them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Domain
from xplain.domains.users.setting import MAX_MODELS, task_of
from xplain.errors import DomainError, InputError, TooLargeError, XplainError
from xplain.explanation.message_sets import indices, names_of, subsets

log = logging.getLogger(__name__)

AS_ASSUMED = 0.6
"""Prior of the assumed values, if there are variants."""
OPPOSITE = 0.05
"""Total prior of values on the other side of the robot's value."""
EACH = 8
"""Maximum number of facts for which each fact has a variant with only its value on the other
side."""
NUDGES = (1.0, 1.01, 0.99, 1.02, 0.98, 1.05, 0.95)
"""If ties at a value are ambiguous, the value times each of these factors is tried, in order.
People's ideas of a value are not that exact."""
Values = Mapping[str, Any]
"""An inaccurate value of each parameter."""


@dataclass(frozen=True)
class FactLabels:
    """Labels of people who believe sets of facts incorrectly. Each set is solved once.

    Attributes:
        domain: the domain of the models.
        transitions: [T, 3].
        values: [1 + V] the assumed values, and those of the variants.
        columns: [K] the transitions to label; None: all.
    """

    domain: Domain
    transitions: NDArray[np.int64]
    values: tuple[Values, ...] = ()
    columns: NDArray[np.int64] | None = None
    _known: dict[int, NDArray[np.uint8]] = field(default_factory=dict)

    def take(self, columns: NDArray[np.int64]) -> FactLabels:
        """Restricts the labels to some transitions; solved models are shared."""
        return replace(self, columns=columns if self.columns is None else self.columns[columns])

    def of(self, facts: NDArray[np.int64]) -> NDArray[np.uint8]:
        """[1 + V, C, K] labels of people who believe these sets [C] incorrectly.

        Raises:
            DomainError: ties of a model are ambiguous.
        """
        missing = np.array([one for one in facts.tolist() if one not in self._known], np.int64)
        if len(missing):
            solved = np.stack([self.at(values, missing) for values in self.values], axis=1)
            self._known.update(zip(missing.tolist(), solved, strict=True))
        columns = slice(None) if self.columns is None else self.columns
        return np.stack([self._known[one][:, columns] for one in facts.tolist()], axis=1)

    def at(self, values: Values, facts: NDArray[np.int64]) -> NDArray[np.uint8]:
        """[C, T] labels of people who believe these sets [C] incorrectly, at these values.

        Raises:
            DomainError: ties of a model are ambiguous.
            InputError: the domain refuses a value.
            TooLargeError: too many sets.
        """
        if len(facts) > MAX_MODELS:
            raise TooLargeError(f"hypotheses: {len(facts)} sets of facts; at most {MAX_MODELS}")
        accurate = {one.name: one.accurate for one in self.domain.parameters}
        wrong = [names_of(one, tuple(accurate)) for one in facts.tolist()]
        models = [task_of(self.domain, accurate | {x: values[x] for x in own}) for own in wrong]
        whose = [f"somebody who believes {', '.join(own)} incorrectly" for own in wrong]
        return np.array([one.labels(self.transitions) for one in models[0].solve(models, whose)])

    def without_ties(
        self, wanted: Values, facts: NDArray[np.int64]
    ) -> tuple[Values, NDArray[np.uint8]]:
        """Finds values near the wanted ones without ambiguous ties. Returns them with the labels
        [C, T] of people who believe these sets [C] incorrectly.

        If ties are ambiguous, each parameter in turn takes its wanted value, or its first
        :data:`NUDGES` without ambiguous ties. Earlier parameters then have the values already
        found, later ones the assumed values. If every nudge fails, the parameter keeps its assumed
        value and a warning names it.
        """
        try:
            return dict(wanted), self.at(wanted, facts)
        except DomainError:
            log.debug("hypotheses: ties are ambiguous at %s", wanted)
        assumed: Values = {one.name: one.inaccurate for one in self.domain.parameters}
        chosen, labels = assumed, self.at(assumed, facts)
        for name in (name for name in wanted if wanted[name] != assumed[name]):
            for nudge in NUDGES:
                value = wanted[name]
                tried = {**chosen, name: value * nudge if _is_number(value) else value}
                try:
                    chosen, labels = tried, self.at(tried, facts)
                    if nudge != 1:
                        log.info("hypotheses: a variant has %s=%s", name, tried[name])
                    break
                except (DomainError, InputError) as error:
                    reason = str(error)
            else:
                stays = "hypotheses: no variant with %s=%s, it stays %s: %s"
                log.warning(stays, name, wanted[name], assumed[name], reason)
        return chosen, labels

    def variants(
        self, facts: NDArray[np.int64], scales: Sequence[float]
    ) -> list[tuple[Values, NDArray[np.uint8], float]]:
        """Finds values that people may believe instead of the assumed ones, with the labels [C, T]
        of people who believe these sets [C] incorrectly, and their prior probability.

        If the domain refuses a value, the assumed value is used. :meth:`without_ties` resolves
        ambiguous ties. If all values equal the assumed ones, there is no variant.

        Args:
            facts: the sets.
            scales: one variant for each scale, with all numeric inaccurate values multiplied by it.
                In further variants values are on the other side of the robot's value, all together
                or (up to EACH facts) one alone: people may also believe that a dangerous fire is a
                bonus.
        """
        assumed = {one.name: one.inaccurate for one in self.domain.parameters}
        opposite = other_values(self.domain, lambda right, wrong: 2 * right - wrong)
        turned = [opposite]
        if len(opposite) <= EACH:
            turned += [assumed | {name: value} for name, value in opposite.items()]
        scaled = [scaled_values(self.domain, scale) for scale in scales]
        found = []
        for share, wanted in ((1 - AS_ASSUMED - OPPOSITE, scaled), (OPPOSITE, turned)):
            different = {str(one): one for one in wanted if one != assumed}
            made = [self.without_ties(one, facts) for one in different.values()]
            made = [(values, labels) for values, labels in made if values != assumed]
            found += [(values, labels, share / len(made)) for values, labels in made]
        return found


def other_values(domain: Domain, other: Callable[[float, float], float]) -> dict[str, Any]:
    """Other inaccurate values by parameter: ``other(robot's value, inaccurate value)`` if both are
    numbers and the domain accepts the result; otherwise the inaccurate value."""
    accurate = {one.name: one.accurate for one in domain.parameters}
    values = {one.name: one.inaccurate for one in domain.parameters}
    for name, wrong in values.items():
        if _is_number(wrong) and _is_number(accurate[name]):
            tried = other(accurate[name], wrong)
            try:
                domain.model({**accurate, name: tried})
                values[name] = tried
            except XplainError:
                log.debug("hypotheses: the domain refuses %s=%s", name, tried)
    return values


def scaled_values(domain: Domain, scale: float) -> dict[str, Any]:
    """All inaccurate values times ``scale``, by parameter; see :func:`other_values`."""
    return other_values(domain, lambda _, wrong: scale * wrong)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def few(facts: NDArray[np.int64], n: int, share: float) -> NDArray[np.float64]:
    """[C] probabilities of the sets if each of n facts is believed incorrectly with probability
    ``share``, independently, given that no other set is possible."""
    size = np.bitwise_count(facts).astype(np.float64)
    weight = share**size * (1 - share) ** (n - size)
    return np.asarray(weight / weight.sum())


def with_subsets(facts: Sequence[int]) -> NDArray[np.int64]:
    """These sets and all of their subsets, ascending."""
    return np.unique(np.concatenate([subsets(indices(one)) for one in facts]))
