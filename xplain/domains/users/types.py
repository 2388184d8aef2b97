"""Sources of the user types of a setting (docs/choices.md, "Lost or not given").

Each source has one method, ``types(domain, rng)``.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any, Protocol

import numpy as np

from xplain.domains.base import Domain
from xplain.domains.users.setting import Setting, UserType
from xplain.errors import Count, InputError, checks, one_of, whole_number
from xplain.explanation.message_sets import indices


class TypeSource(Protocol):
    """A source of user types: the interface of every component ``users``."""

    def types(self, domain: Domain, rng: np.random.Generator) -> tuple[UserType, ...]:
        """Returns the user types, in the order of their numbers.

        Args:
            domain: has the parameters that the types believe incorrectly.
            rng: the stream ``types``.

        Raises:
            InputError: the types do not fit the domain.
        """
        ...


def user_type(domain: Domain, name: str, facts: Sequence[str] | Mapping[str, Any]) -> UserType:
    """Makes a type with inaccurate values of these parameters.

    Args:
        domain: has the parameters.
        name: name of the type.
        facts: names of parameters, or ``{parameter: the type's inaccurate value}``; the value None
            becomes the domain's inaccurate value.

    Raises:
        InputError: no facts, or an unknown parameter.
    """
    default = {parameter.name: parameter.inaccurate for parameter in domain.parameters}
    key = f"users.{name}"
    if isinstance(facts, str) or not isinstance(facts, (Sequence, Mapping)) or not facts:
        raise InputError(key, facts, f"some of the parameters {', '.join(default)}")
    own = facts if isinstance(facts, Mapping) else dict.fromkeys(facts)
    for fact in own:
        one_of(key, fact, default, f"parameter of {domain.name}")
    return UserType(name, {f: default[f] if own[f] is None else own[f] for f in own})


@dataclass(frozen=True)
class Explicit:
    """A source of types that are given in YAML.

    Attributes:
        groups: ``{name: [parameter, ...]}``, or ``{name: {parameter: value}}`` for a type with
            other inaccurate values (null: the domain's inaccurate value).
    """

    groups: Mapping[str, Sequence[str] | Mapping[str, Any]]

    def __post_init__(self) -> None:
        """Raises InputError if ``groups`` is not a mapping with at least one type."""
        if not isinstance(self.groups, Mapping) or not self.groups:
            raise InputError("users.groups", self.groups, "at least one user type, {name: [facts]}")

    def types(self, domain: Domain, rng: np.random.Generator) -> tuple[UserType, ...]:
        """Returns the types from YAML; ``rng`` is not used."""
        return tuple(user_type(domain, name, facts) for name, facts in self.groups.items())


@dataclass(frozen=True)
class Completions:
    """A source that completes a partly known list of types: the paper's figure with three of the
    five rescue types is lost (docs/choices.md).

    A completion gives one bonus and one obstacle to each type in ``free``. All types must be
    distinct, and each fact must be in some type. For ``rescue`` there are 27 completions;
    completions that differ only in the order of the free types count once.

    Attributes:
        known: ``{name: [bonus, obstacle]}`` of the types in the paper's text.
        free: names of the types to complete.
        bonuses, obstacles: the facts.
        index: index of the completion, from 0, in the order of the facts.
    """

    known: Mapping[str, Sequence[str]]
    free: Sequence[str]
    bonuses: Sequence[str]
    obstacles: Sequence[str]
    index: int = 0

    def __post_init__(self) -> None:
        """Raises InputError if there is no completion ``index``."""
        whole_number("users.index", self.index, 0, len(self.completions()) - 1)

    def completions(self) -> tuple[tuple[tuple[str, str], ...], ...]:
        """Returns all completions; each is a tuple of one (bonus, obstacle) for each type in
        ``free``."""
        known = {tuple(pair) for pair in self.known.values()}
        pairs = [p for p in product(self.bonuses, self.obstacles) if p not in known]
        facts = {*self.bonuses, *self.obstacles}
        return tuple(
            chosen
            for chosen in combinations(pairs, len(self.free))
            if {fact for pair in (*known, *chosen) for fact in pair} == facts
        )

    def types(self, domain: Domain, rng: np.random.Generator) -> tuple[UserType, ...]:
        """Returns the types of the chosen completion, sorted by name; ``rng`` is not used."""
        groups = dict(self.known) | dict(
            zip(self.free, self.completions()[self.index], strict=True)
        )
        return tuple(user_type(domain, name, groups[name]) for name in sorted(groups))


ATTEMPTS = 1000
"""Maximum number of draws."""


def first_distinct(
    domain: Domain, count: int, draws: Iterable[Sequence[Sequence[int]]], distinct: bool = True
) -> tuple[UserType, ...]:
    """Returns the types of the first suitable draw. In a suitable draw, any two types differ in the
    label of some reachable (transition, message set).

    Args:
        domain: has the parameters that the types believe incorrectly.
        count: number of types.
        draws: the draws in order. A draw has one list for each type: the indices of the facts that
            the type believes incorrectly.
        distinct: False accepts the first draw.

    Raises:
        InputError: no draw is suitable.
    """
    names = [parameter.name for parameter in domain.parameters]
    for facts in draws:
        drawn = tuple(
            user_type(domain, f"T{i + 1}", [names[j] for j in own]) for i, own in enumerate(facts)
        )
        if not distinct or len(np.unique(Setting.build(domain, drawn).distinct)) == count:
            return drawn
    allowed = f"no draw of {ATTEMPTS} gives so many types of {domain.name} that behave differently"
    raise InputError(
        "users.count", count, f"{allowed}; ask for fewer, or replace facts that change no label"
    )


@checks("users")
@dataclass(frozen=True)
class RandomCover:
    """A source of random types: each type is a non-empty subset of the parameters, and each
    parameter is in some type (paper, four rooms).

    Attributes:
        count: number of types.
        distinct: True requires types that differ in the label of some reachable (transition,
            message set). The draw of all types is then repeated until it is suitable.
    """

    count: Count
    distinct: bool = True

    def types(self, domain: Domain, rng: np.random.Generator) -> tuple[UserType, ...]:
        """Draws lists of subsets until a list is suitable: its subsets are distinct, cover all
        parameters and, if required, differ in behaviour. All suitable lists are equally likely.

        Raises:
            InputError: there are fewer subsets than ``count``, or no draw is suitable.
        """
        n = len(domain.parameters)
        full = (1 << n) - 1
        if n < 31 and self.count > full:
            raise InputError("users.count", self.count, f"at most {full} subsets exist")
        masks = (rng.integers(1, full + 1, self.count).tolist() for _ in range(ATTEMPTS))
        covers = (
            [indices(mask) for mask in drawn]
            for drawn in masks
            if len({*drawn}) == self.count and np.bitwise_or.reduce(drawn) == full
        )
        return first_distinct(domain, self.count, covers, self.distinct)


@checks("users")
@dataclass(frozen=True)
class FewFacts:
    """A source of random types for domains with many facts. People of each type believe a few
    facts incorrectly.

    Attributes:
        count: number of types.
        fewest, most: smallest and largest number of facts of a type; the number is drawn uniformly,
            then the facts.
    """

    count: Count
    fewest: Count = 2
    most: Count = 6

    def __post_init__(self) -> None:
        """Raises InputError if ``most`` < ``fewest``."""
        whole_number("users.most", self.most, self.fewest)

    def types(self, domain: Domain, rng: np.random.Generator) -> tuple[UserType, ...]:
        """Draws types that differ in the label of some reachable (transition, message set). The
        draw of all types is repeated until it is suitable.

        Raises:
            InputError: fewer parameters than ``most``, or no suitable draw.
        """
        n = len(domain.parameters)
        if self.most > n:
            raise InputError("users.most", self.most, f"at most {n}, {domain.name}'s facts")
        sizes = (rng.integers(self.fewest, self.most + 1, self.count) for _ in range(ATTEMPTS))
        facts = ([sorted(rng.permutation(n)[:size].tolist()) for size in drawn] for drawn in sizes)
        return first_distinct(domain, self.count, facts)
