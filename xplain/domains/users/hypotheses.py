r"""Hypotheses: what people might believe incorrectly, and the labels of such people.

A candidate is a set R of facts that a person may believe incorrectly. A person of candidate R who
was given the messages H still believes R \ H incorrectly. Apart from errors their label of
transition τ is ``labels[R \ H, τ]`` (docs/what-to-ask.md).
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from math import comb
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.domains.base import Domain, transition_feature_names, transition_features
from xplain.domains.users.inaccurate_values import (
    AS_ASSUMED,
    FactLabels,
    few,
    with_subsets,
)
from xplain.domains.users.setting import MAX_MODELS, Setting, UserType
from xplain.errors import InputError, TooLargeError, whole_number
from xplain.explanation.message_sets import names_of
from xplain.storage import open_atomic

SUM = 1e-6
"""Tolerance of a prior's sum."""


def prior_over(prior: ArrayLike | None, count: int, key: str) -> NDArray[np.float64]:
    """Checks ``count`` probabilities and makes their sum exactly 1; None becomes a uniform prior.

    Raises:
        InputError: another shape, a negative value, or a sum other than 1.
    """
    if prior is None:
        return np.full(count, 1 / count)
    try:
        weight = np.asarray(prior, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(key, prior, f"{count} probabilities") from None
    if weight.shape != (count,):
        raise InputError(key, weight.shape, f"{count} probabilities, one a candidate")
    if not (weight >= 0).all() or not abs(weight.sum() - 1) < SUM:
        raise InputError(key, float(weight.sum()), "probabilities that sum to 1")
    return np.asarray(weight / weight.sum())


def table_of_labels(labels: ArrayLike) -> NDArray[np.uint8]:
    """Checks a table [C, T] of labels 0 and 1, and converts it to uint8."""
    try:
        table = np.asarray(labels)
    except ValueError:
        table = np.zeros(0)
    if table.ndim != 2 or 0 in table.shape or table.dtype.kind not in "biuf":
        raise InputError("hypotheses.labels", table.shape, "a table [2^n, transitions]")
    if not np.isin(table, (0, 1)).all():
        other = table[~np.isin(table, (0, 1))][0]
        raise InputError("hypotheses.labels", other.item(), "labels 0 and 1")
    if len(table) > MAX_MODELS:
        raise TooLargeError(
            f"hypotheses: {len(table)} candidates are more than {MAX_MODELS}; leave out sets of "
            "many facts"
        )
    return table.astype(np.uint8)


FEW = 0.1
"""Prior probability that a fact is believed incorrectly, if there are too many facts to list all
sets."""
TEXTS = ("messages", "feature_names", "phrases")
ARRAYS = ("labels", "facts", "messages", "prior", "variants", "features", "states",
          "variant_weight", "feature_names", "phrases")  # fmt: skip
"""Names of the arrays in a file; only ``labels`` is required."""


@dataclass(frozen=True)
class Hypotheses:
    """C candidates for incorrect beliefs, and their labels of T transitions.

    The assumed value of a fact is the domain's inaccurate value of this parameter. A variant gives
    some facts other inaccurate values (half, double, …), because people may believe these, too.

    Attributes:
        labels: [C, T] uint8, labels of a person who believes exactly the facts in ``facts[c]``
            incorrectly, at the assumed values.
        facts: [C] int64 bitmasks, ascending; all subsets of a candidate are candidates too.
        messages: n names; bit j of a bitmask is fact j, which message j corrects.
        prior: [C] probabilities of the candidates; sums to 1.
        features: [T, F] float64 features of the transitions; None if unknown.
        feature_names: F names.
        phrases: T descriptions for people; may be empty.
        states: [T, 2] int64 start and end state of each transition, for clips of consecutive
            transitions; None if unknown.
        variants: [V, C, T] uint8, the labels in each variant; V may be 0.
        variant_weight: [V] prior probability of each variant; the assumed values have the rest.
            None: the variants are equally likely, and together less likely than the assumed values.
        further: computes labels of sets of facts that are not candidates, for :meth:`with_sets`;
            None if these labels are unknown.
    """

    labels: NDArray[np.uint8]
    facts: NDArray[np.int64]
    messages: tuple[str, ...]
    prior: NDArray[np.float64]
    features: NDArray[np.float64] | None = None
    feature_names: tuple[str, ...] = ()
    phrases: tuple[str, ...] = ()
    states: NDArray[np.int64] | None = None
    variants: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 1, 1), np.uint8))
    variant_weight: NDArray[np.float64] | None = None
    further: FactLabels | None = None

    @classmethod
    def of(
        cls,
        labels: ArrayLike,
        facts: ArrayLike | None = None,
        messages: Sequence[str] | None = None,
        prior: ArrayLike | None = None,
        **about: Any,
    ) -> Hypotheses:
        """Makes hypotheses from a table of labels; checks all values.

        Args:
            labels: [2^n, T] of 0 and 1, or [C, T] with ``facts``.
            facts: [C] bitmask of each row's facts; the rows may have any order. None: row i has the
                bitmask i.
            messages: n names; None: fact_0, fact_1, …
            prior: [C] prior of the rows; None is uniform.
            about: any other attributes, as keyword arguments.

        Raises:
            InputError: an argument contradicts its description, or no question separates two
                candidates.
        """
        table = table_of_labels(labels)
        if facts is None and len(table) & (len(table) - 1):
            raise InputError("hypotheses.labels", table.shape, "2^n rows, one a set of facts")
        masks = np.arange(len(table)) if facts is None else np.asarray(facts)
        if masks.shape != table.shape[:1] or masks.dtype.kind not in "iu" or (masks < 0).any():
            raise InputError("hypotheses.facts", masks.shape, "one bitmask a row of labels")
        masks = masks.astype(np.int64)
        n = int(masks.max()).bit_length()
        names = tuple(f"fact_{j}" for j in range(n)) if messages is None else tuple(messages)
        if len(names) < n or len(set(names)) < len(names):
            raise InputError("hypotheses.messages", ", ".join(names), f"{n} names, all different")
        weight = prior_over(prior, len(table), "hypotheses.prior")
        order = np.argsort(masks)
        if len(about.get("variants", ())):
            variants = np.stack([table_of_labels(one) for one in about["variants"]])
            if variants.shape[1:] != table.shape:
                allowed = f"tables like labels, {table.shape}"
                raise InputError("hypotheses.variants", variants.shape, allowed)
            about["variants"] = variants[:, order]
        made = cls(table[order], masks[order], names, weight[order], **about)
        made._check_attributes()
        return made

    @classmethod
    def of_domain(
        cls, domain: Domain, most: int | None = None, scales: Sequence[float] = (0.5, 2.0)
    ) -> Hypotheses:
        """Makes the hypotheses of a domain: each set of at most ``most`` parameters is a candidate.

        The transitions are those of the robot's optimal policies from any start.

        Args:
            domain: the robot's task.
            most: maximum number of parameters believed incorrectly together; None: the most that
                MAX_MODELS allows.
            scales: factors of the inaccurate values. Each factor gives one variant; further
                variants are described in :meth:`FactLabels.variants`.

        Raises:
            DomainError: ties of a model at the assumed values are ambiguous.
            InputError: the parameters change no label of these transitions.
            TooLargeError: more than MAX_MODELS models.
        """
        n = len(domain.parameters)
        if most is None:
            most = max(k for k in range(n + 1) if comb(n, k) << k <= MAX_MODELS)
            most = n if 1 << n <= MAX_MODELS else max(most, 1)
        most = min(whole_number("hypotheses.most", most, 1), n)
        assumed = {parameter.name: parameter.inaccurate for parameter in domain.parameters}
        robot = Setting.build(domain, (UserType("robot", {}),))
        transitions = robot.reachable
        facts = with_subsets([sum(1 << j for j in own) for own in combinations(range(n), most)])
        labels = FactLabels(domain, transitions)
        other = labels.variants(facts, scales)
        every_value = (assumed, *(values for values, _, _ in other))
        return cls.of(
            labels.at(assumed, facts),
            facts,
            robot.message_names,
            None if most == n else few(facts, n, FEW),
            features=transition_features(domain, transitions),
            feature_names=transition_feature_names(domain),
            phrases=tuple(domain.describe(transition) for transition in transitions),
            states=transitions[:, [0, 2]],
            variants=np.array([own for _, own, _ in other], dtype=np.uint8),
            variant_weight=np.array([prior for _, _, prior in other]) if other else None,
            further=replace(labels, values=every_value) if most < n else None,
        )

    @classmethod
    def load(cls, path: str | Path) -> Hypotheses:
        """Reads an ``.npz`` file: ``labels`` [2^n, T], and optionally ``features`` [T, F],
        ``feature_names``, ``messages``, ``phrases`` [T], ``states`` [T, 2], ``prior`` [2^n],
        ``variants`` [V, 2^n, T], and ``facts`` [C] if not all 2^n sets are candidates. No code in
        the file is executed.

        Raises:
            InputError: no such file, or its arrays are not valid for :meth:`of`.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {key: file[key] for key in file.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, TypeError) as error:
            reason = (str(error).splitlines() or [""])[0] or type(error).__name__
            raise InputError("hypotheses", str(path), f"an .npz file ({reason})") from None
        if "labels" not in arrays:
            raise InputError("hypotheses", str(path), "an .npz file with the array labels")
        if unknown := arrays.keys() - set(ARRAYS):
            raise InputError("hypotheses", min(unknown), f"arrays {', '.join(ARRAYS)}")
        texts = {key: tuple(map(str, arrays[key].ravel())) for key in TEXTS if key in arrays}
        return cls.of(**arrays | texts)

    def save(self, path: str | Path) -> None:
        """Writes the file for :meth:`load`, atomically."""
        given = {key: getattr(self, key) for key in ARRAYS}
        arrays: dict[str, Any] = {
            key: np.array(value, dtype=np.str_) if key in TEXTS else value
            for key, value in given.items()
            if value is not None and len(value)
        }
        with open_atomic(Path(path), "wb") as file:
            np.savez_compressed(file, **arrays)

    def traces(self) -> Iterator[list[int]]:
        """Yields traces: from each state to which no transition leads, the first transition of each
        state is followed. Yields nothing if states are unknown."""
        starts, ends = ([], []) if self.states is None else self.states.T.tolist()
        first = {state: starts.index(state) for state in starts}
        for state in sorted({*starts} - {*ends}):
            trace = [first[state]]
            while (new := first.get(ends[trace[-1]])) is not None and new not in trace:
                trace.append(new)
            yield trace

    def with_sets(self, facts: NDArray[np.int64]) -> Hypotheses:
        """Returns hypotheses with more candidates. Their prior comes from
        :func:`~xplain.domains.users.inaccurate_values.few`.

        Args:
            facts: bitmasks of sets of facts. These sets and all of their subsets become candidates.

        Raises:
            DomainError: ties of a model are ambiguous.
            TooLargeError: more than MAX_MODELS candidates.
        """
        new = np.setdiff1d(with_subsets(facts.tolist()), self.facts)
        if not len(new):
            return self
        assert self.further is not None, "labels of further sets are known"
        if len(new) + len(self.facts) > MAX_MODELS:
            raise TooLargeError(f"hypotheses: more than {MAX_MODELS} candidates")
        order = np.argsort(np.concatenate([self.facts, new]))
        tables = np.concatenate([self.tables, self.further.of(new)], axis=1)[:, order]
        listed = np.concatenate([self.facts, new])[order]
        prior = few(listed, self.n_messages, FEW)
        return replace(self, labels=tables[0], variants=tables[1:], facts=listed, prior=prior)

    @cached_property
    def complete(self) -> bool:
        """True if every combination of the facts that occur in candidates is a candidate."""
        return len(self.facts) == 1 << int(np.bitwise_or.reduce(self.facts)).bit_count()

    @property
    def n_messages(self) -> int:
        """n, the number of facts and of messages."""
        return len(self.messages)

    @property
    def n_transitions(self) -> int:
        """T, the number of transitions."""
        return int(self.labels.shape[1])

    def row(self, held: NDArray[np.int64]) -> NDArray[np.int64]:
        """Finds candidates in :attr:`labels`.

        Args:
            held: bitmasks of candidates' facts, an array of any shape.

        Returns:
            The row of each candidate, in the same shape.
        """
        every = len(self.facts) > self.facts[-1]  # then a set's bitmask is its row
        return held if every else np.searchsorted(self.facts, held)

    def label(self, transitions: ArrayLike, message_sets: ArrayLike) -> NDArray[np.uint8]:
        r"""Returns the labels in Q questions, [1 + V, C, Q]: first at the assumed values, then in
        each variant. In question (τ, H), a person of candidate R was given the messages H, and
        labels transition τ like a person who believes R \ H incorrectly.

        Args:
            transitions: [Q] the index τ of each question's transition.
            message_sets: [Q] bitmask H of each question's messages, or one bitmask for all
                questions.
        """
        held = self.facts[:, None] & ~np.asarray(message_sets, dtype=np.int64)
        return np.asarray(self.tables[:, self.row(held), np.asarray(transitions)])

    @cached_property
    def tables(self) -> NDArray[np.uint8]:
        """[1 + V, C, T] all labels: first at the assumed values, then in each variant."""
        variants = self.variants if len(self.variants) else self.labels[None][:0]
        return np.concatenate([self.labels[None], variants])

    @cached_property
    def variant_prior(self) -> NDArray[np.float64]:
        """[1 + V] prior probabilities: first of the assumed values, then of each variant."""
        count = len(self.variants)
        weight = np.full(count, (1 - AS_ASSUMED) / max(count, 1))
        weight = weight if self.variant_weight is None else self.variant_weight
        return np.append(1 - weight.sum(), weight)

    @cached_property
    def sizes(self) -> NDArray[np.bool_]:
        """[1 + V] True for the assumed values, and for each variant that differs from the assumed
        values only in size: all values are on the same side of the robot's values as the assumed
        values are.

        A variant with a value on the other side is recognised by its prior, which is below half of
        the largest variant's prior.
        """
        weight = self.variant_prior[1:]
        return np.append(True, weight >= weight.max(initial=0) / 2)

    def drop_indistinguishable(self) -> Hypotheses:
        """Returns hypotheses without transitions that have equal features and different labels. If
        only the features are known, an answer about such a transition gives no information.

        Returns these hypotheses unchanged if fewer candidates could be separated without these
        transitions.
        """
        if self.features is None:
            return self
        which = np.unique(self.features, axis=0, return_inverse=True)[1].ravel()
        every = self.tables.reshape(-1, self.n_transitions)
        _, column = np.unique(np.packbits(every, axis=0), axis=1, return_inverse=True)
        pairs = np.unique(np.stack([which, column.ravel()]), axis=1)
        keep = np.flatnonzero(np.bincount(pairs[0])[which] == 1)
        rest = replace(
            self,
            labels=self.labels[:, keep],
            features=self.features[keep],
            phrases=tuple(self.phrases[t] for t in keep) if self.phrases else (),
            states=None if self.states is None else self.states[keep],
            variants=self.variants[:, :, keep] if len(self.variants) else self.variants,
            further=None if self.further is None else self.further.take(keep),
        )
        return rest if np.array_equal(rest.essential, self.essential) else self

    @cached_property
    def matters(self) -> NDArray[np.int64]:
        """[T] for each transition, the bitmask of the facts that its label depends on."""
        found = np.zeros(self.n_transitions, dtype=np.int64)
        for j, more, less in self.pairs:
            differ = self.tables[:, more] != self.tables[:, less]
            found[differ.any(axis=(0, 1))] |= 1 << j
        return found

    @cached_property
    def pairs(self) -> list[tuple[int, NDArray[np.int64], NDArray[np.int64]]]:
        r"""For each fact j, the triple (j, rows of the candidates R that contain j, rows of the
        candidates R \ j). Both arrays of rows have the order of R."""
        having = [np.flatnonzero(self.facts >> j & 1) for j in range(self.n_messages)]
        less = [self.row(self.facts[more] & ~(1 << j)) for j, more in enumerate(having)]
        return [*zip(range(self.n_messages), having, less, strict=True)]

    @cached_property
    def essential(self) -> NDArray[np.int64]:
        r"""[C] for each candidate, the bitmask of its essential facts, at the assumed values. Two
        candidates behave alike if and only if these bitmasks are equal.

        Fact j of a candidate R is essential if there is a set K ⊆ R \ j such that people who
        believe K ∪ j incorrectly and people who believe K incorrectly differ in a label. A question
        with the messages R \ (K ∪ j) then separates the candidates R and R \ j.

        If two candidates behave alike, their intersection behaves like them, too (consider messages
        about all other facts). So each class of candidates that behave alike has one smallest
        member, which contains exactly the essential facts.
        """
        found = np.zeros_like(self.facts)
        for j, more, less in self.pairs:
            found[more[(self.labels[more] != self.labels[less]).any(axis=1)]] |= 1 << j
        # Such a K may be any subset of R: takes the union over all subsets, one fact at a time.
        for _, more, less in self.pairs:
            found[more] |= found[less]
        return found

    @cached_property
    def classes(self) -> NDArray[np.int64]:
        """[C] number of each candidate's class; no question separates candidates of one class."""
        return np.unique(self.essential, return_inverse=True)[1].ravel()

    def _check_attributes(self) -> None:
        """Raises InputError if attributes contradict each other."""
        if self.facts[0] != 0 or len(np.unique(self.facts)) < len(self.facts):
            raise InputError("hypotheses.facts", self.facts[0], "different sets, one of them empty")
        for j in range(int(self.facts[-1]).bit_length()):
            less = self.facts & ~(1 << j)
            if not np.isin(less, self.facts).all():
                lone = int(self.facts[~np.isin(less, self.facts)][0])
                names = ";".join(names_of(lone, self.messages))
                raise InputError("hypotheses.facts", names, "all subsets of each set, too")
        weight = self.variant_weight
        if weight is not None and (
            weight.shape != (len(self.variants),) or (weight <= 0).any() or weight.sum() >= 1
        ):
            allowed = f"{len(self.variants)} probabilities, below 1 together"
            raise InputError("hypotheses.variant_weight", weight.tolist(), allowed)
        for key, array in (("features", self.features), ("states", self.states)):
            if array is not None and (array.ndim != 2 or len(array) != self.n_transitions):
                raise InputError(f"hypotheses.{key}", array.shape, f"{self.n_transitions} rows")
        if self.features is not None and not np.isfinite(self.features).all():
            raise InputError("hypotheses.features", "NaN or infinite", "finite numbers")
        if self.phrases and len(self.phrases) != self.n_transitions:
            raise InputError("hypotheses.phrases", len(self.phrases), f"{self.n_transitions} texts")
        if not self.essential.any():
            raise InputError(
                "hypotheses",
                ", ".join(self.messages),
                "facts that change labels; no question can separate these, because no "
                "label depends on what is believed incorrectly",
            )


_OF_DOMAIN: WeakKeyDictionary[Domain, Hypotheses] = WeakKeyDictionary()


def hypotheses_of(domain: Domain | None, path: str | None) -> Hypotheses:
    """Returns the hypotheses of a file, or of the domain. The hypotheses of a domain are computed
    only once.

    Raises:
        InputError: there is neither a file nor a domain, or the hypotheses cannot be used.
    """
    if path is not None:
        return Hypotheses.load(path)
    if domain is None:
        raise InputError("hypotheses", None, "an .npz file of hypotheses")
    if domain not in _OF_DOMAIN:
        _OF_DOMAIN[domain] = Hypotheses.of_domain(domain)
    return _OF_DOMAIN[domain]
