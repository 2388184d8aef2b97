"""Labels of people who believe the inaccurate values of a domain's parameters, or other values
(half, double, …)."""

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
"""Total prior of variants with values on the other side of the robot's value."""
EACH = 8
"""If there are at most this many facts, each fact has a variant in which only the value of this
fact is on the other side."""
NUDGES = (1.0, 1.01, 0.99, 1.02, 0.98, 1.05, 0.95)
"""If ties at a value are ambiguous, the value times each of these factors is tried, in order.
People do not know a value more exactly."""
Values = Mapping[str, Any]
"""An inaccurate value of each parameter."""


@dataclass(frozen=True)
class FactLabels:
    """Computes labels of people who believe sets of facts incorrectly. :meth:`of` solves the models
    of each set only once.

    Attributes:
        domain: the domain of the models.
        transitions: [T, 3].
        values: 1 + V mappings: first the assumed values, which are the domain's inaccurate values;
            then the values of each variant, which people may believe instead.
        columns: [K] indices of the transitions that :meth:`of` labels; None: all, so K = T.
    """

    domain: Domain
    transitions: NDArray[np.int64]
    values: tuple[Values, ...] = ()
    columns: NDArray[np.int64] | None = None
    _known: dict[int, NDArray[np.uint8]] = field(default_factory=dict)

    def take(self, columns: NDArray[np.int64]) -> FactLabels:
        """Restricts :meth:`of` to fewer transitions. Labels that are already computed are not
        computed again.

        Args:
            columns: indices of the transitions to keep, among the present K.
        """
        return replace(self, columns=columns if self.columns is None else self.columns[columns])

    def of(self, facts: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Computes [1 + V, C, K] labels: first at the assumed values, then in each variant.

        Args:
            facts: [C] bitmasks of the facts that people believe incorrectly.

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
        """Computes [C, T] labels of people with the given inaccurate values.

        Args:
            values: the inaccurate value of each parameter.
            facts: [C] bitmasks of the facts that people believe incorrectly.

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
        """Finds inaccurate values without ambiguous ties, equal or close to the wanted values.

        If ties are ambiguous at the wanted values, the search starts from the assumed values and
        changes one parameter after the other. A parameter gets its wanted value, multiplied by the
        first factor of :data:`NUDGES` that leaves no ambiguous ties. If no factor does, the
        parameter keeps its assumed value, and a warning names it.

        Args:
            wanted: the wanted inaccurate value of each parameter.
            facts: [C] bitmasks of the facts that people believe incorrectly.

        Returns:
            The values, and the labels [C, T] at these values.
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
                stays = "hypotheses: no variant has %s=%s; the value stays %s: %s"
                log.warning(stays, name, wanted[name], assumed[name], reason)
        return chosen, labels

    def variants(
        self, facts: NDArray[np.int64], scales: Sequence[float]
    ) -> list[tuple[Values, NDArray[np.uint8], float]]:
        """Makes the variants: values that people may believe instead of the assumed values.

        There are three kinds of variant:

        - for each scale: all numeric inaccurate values are multiplied by the scale;
        - all inaccurate values are moved to the other side of the robot's value, at the same
          distance, because people may also believe that a dangerous fire is a bonus;
        - if there are at most EACH facts, for each fact: only its value is moved to the other side.

        If the domain refuses a value, the assumed value is used. :meth:`without_ties` removes
        ambiguous ties. A variant whose values all equal the assumed values is left out.

        Args:
            facts: [C] bitmasks of the facts that people believe incorrectly.
            scales: factors of the inaccurate values.

        Returns:
            For each variant: its values, the labels [C, T] at these values, and its prior
            probability.
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
    """Computes another inaccurate value of each parameter.

    Args:
        domain: has the parameters.
        other: computes the new value from the robot's value and the inaccurate value.

    Returns:
        The new value of each parameter by name. The domain's inaccurate value stays if it or the
        robot's value is not a number, or if the domain refuses the new value.
    """
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
    """Returns the inaccurate value of each parameter, multiplied by ``scale``. A value stays
    unchanged if it is not a number, or if the domain refuses the product."""
    return other_values(domain, lambda _, wrong: scale * wrong)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def few(facts: NDArray[np.int64], n: int, share: float) -> NDArray[np.float64]:
    """Computes [C] the prior of candidates: each fact is believed incorrectly with probability
    ``share``, independently of other facts; the probabilities are divided by their sum.

    Args:
        facts: [C] bitmasks of the candidates' facts.
        n: number of facts.
        share: probability that a fact is believed incorrectly.
    """
    size = np.bitwise_count(facts).astype(np.float64)
    weight = share**size * (1 - share) ** (n - size)
    return np.asarray(weight / weight.sum())


def with_subsets(facts: Sequence[int]) -> NDArray[np.int64]:
    """Returns the bitmasks of some sets of facts and of all of their subsets, ascending.

    Args:
        facts: bitmasks of the sets.
    """
    return np.unique(np.concatenate([subsets(indices(one)) for one in facts]))
