"""A planning task in PDDL as a domain: ``domain=pddl``."""

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import chain, combinations, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Parameter
from xplain.domains.goal_task import GoalTask
from xplain.domains.pddl.facts import Words, describe, find_differences, read_changes
from xplain.domains.pddl.grounding import BelievedTask, Condition
from xplain.domains.pddl.task import Items, Source, read_task, read_text
from xplain.errors import (
    Count,
    DomainError,
    InputError,
    Positive,
    checks,
    mapping,
    one_of,
    sentence,
)

log = logging.getLogger(__name__)

COMBINATIONS = 1024
"""Number of combinations with other facts that are tried before a fact is reported to have no
effect."""


@checks("domain")
class PDDL:
    """A task in PDDL: STRIPS with types, equality, negative preconditions, conditional effects and
    action costs. Its states are all states that the robot can reach, and all states that actions
    of believed tasks reach from these states. Its actions are the ground actions between the
    states.

    The task is undiscounted: plans are compared by their costs; without a metric each action costs
    1. A person with an incorrect belief about the start state keeps this belief in later states,
    until the robot changes an atom that the belief is about. In a state without a plan, every
    action is inexplicable.

    Args:
        file, problem: the robot's domain and problem; ``pkg://package/path`` is a file inside an
            installed package.
        believed: people's belief, as the path of another domain file, or ``{file, problem}``
            (either may be missing): each difference from the robot's task becomes a parameter.
        facts: ``{name: {change, message, belief}}``. ``change`` is one change or a list of them
            (:mod:`xplain.domains.pddl.facts`). Without ``change``, the fact is the difference with
            this name; ``join`` lists several differences that together are one fact. Missing
            sentences are made from the change.
        words: templates for sentences, as in :class:`~xplain.domains.pddl.facts.Words`.
        features: counts for a labeler, in addition to the atoms: ``{name: pattern, or a list of
            them}``. The count is the number of ways to replace ``?x`` so that all patterns hold,
            such as (at ?package airport).
        starts: start states of traces, equally likely: ``initial``; ``reachable``, every state that
            the robot can reach and finish from; or a number: the states within this number of
            actions of the initial one.
        dead_end_cost: cost of a state without a plan. Plans with this cost or more do not count.
        max_states: maximum number of states.
        name: name of the domain; None: pddl.

    Raises:
        XplainError: Fast Downward's translator is not installed.
        InputError: a file or a value is not allowed, or people who believe one fact incorrectly
            have no plan.
        DomainError: the robot has no plan, or its ties are ambiguous.
        TooLargeError: more than ``max_states`` states.
    """

    def __init__(
        self,
        file: str,
        problem: str,
        believed: str | Mapping[str, str] | None = None,
        facts: Mapping[str, Mapping[str, Any]] | None = None,
        words: Mapping[str, str] | None = None,
        features: Mapping[str, str | Sequence[str]] | None = None,
        starts: str | int = "initial",
        dead_end_cost: Positive = 1000.0,
        max_states: Count = 100_000,
        name: str | None = None,
    ) -> None:
        """Reads the files, explores the states and tries every fact."""
        self.name = "pddl" if name is None else str(name)
        self.dead_end_cost = dead_end_cost
        self.task = read_task(file, problem, ("domain.file", "domain.problem"))
        found, other = self._find_differences(file, problem, believed)
        self.words = Words(
            self.task, mapping("domain.words", words or {}, "{predicate or action: its words}")
        )
        given = mapping("domain.facts", facts or {}, "{name: {change, message, belief}}")
        read = [*self._read_facts(given, found, other)]
        if not read:
            raise InputError("domain.facts", dict(given), "at least one fact, here or in believed")
        self.parameters = tuple(parameter for parameter, _ in read)
        changes = [change for _, change in read]
        given = mapping("domain.features", features or {}, "{name: pattern, or a list of them}")
        counts = {str(name): self._read_patterns(name, given[name]) for name in given}
        self._beliefs = BelievedTask(self.task, changes, dead_end_cost, max_states, counts)
        self._model = cache(self._beliefs.model)
        self.actions = tuple(" ".join(action) for action in self._beliefs.actions)
        table = self._beliefs.table
        varying = np.flatnonzero(table.any(axis=0) & ~table.all(axis=0))
        counted = [self._beliefs.count(name, frozenset()) for name in counts]
        self.feature_names = (*(" ".join(self._beliefs.atoms[i]) for i in varying), *counts)
        if len(set(self.feature_names)) < len(self.feature_names):
            raise InputError("domain.features", list(given), "names that no atom has")
        self.state_features = np.column_stack([table[:, varying], *counted]).astype(float)
        robot = self._model(frozenset())
        robot.require_solution("the robot's model")
        self.starts = self._find_starts(starts, robot)
        self._try_facts(robot)

    def _find_differences(
        self, file: str, problem: str, believed: Any
    ) -> tuple[Mapping[str, Items], Items]:
        """Finds the differences between the robot's task and people's belief. Adds to the robot's
        task the predicates and functions that exist only in the believed task.

        Args:
            file, problem: the robot's files.
            believed: as the class describes it.

        Returns:
            The changes of each difference, by its name; and the items of the believed task. Both
            are empty if ``believed`` is None.
        """
        if believed is None:
            return {}, {}
        both = {"file": believed} if isinstance(believed, str) else believed
        if not isinstance(both, Mapping) or not both or set(both) - {"file", "problem"}:
            raise InputError("domain.believed", believed, "a domain file, or {file, problem}")
        keys = ("domain.believed.file", "domain.believed.problem")
        robot = self.task
        other = read_task(both.get("file", file), both.get("problem", problem), keys)
        self.task = replace(
            robot,
            predicates={**other.predicates, **robot.predicates},
            functions={**other.functions, **robot.functions},
        )
        return find_differences(robot, other, "domain.believed"), other.items

    def _read_facts(
        self, given: Mapping[str, Any], found: Mapping[str, Items], other: Items
    ) -> Iterator[tuple[Parameter, Items]]:
        """Yields each fact as a parameter, with the changes that lead from the robot's task to the
        believed one. Differences come first, then the facts of the configuration. A difference that
        is joined into a fact of the configuration is not yielded itself.

        The robot's value of each parameter is "no change".

        Args:
            given: the facts of the configuration, by name.
            found: the differences between the robot's task and people's belief, by name.
            other: items of the believed task.
        """
        joined = {name for fields in given.values() for name in _read_join(fields)}
        for fact in dict.fromkeys([*(name for name in found if name not in joined), *given]):
            key, fields = f"domain.facts.{fact}", given.get(fact, {})
            for name in mapping(key, fields, "the fields change, message, belief"):
                one_of(key, name, ("change", "join", "message", "belief"), "field")
            names = [one_of(f"{key}.join", n, found, "difference") for n in _read_join(fields)]
            every = (found.get(name, {}).items() for name in names or [fact])
            change: Items = dict(chain.from_iterable(every))
            if "change" in fields:
                change = read_changes(f"{key}.change", fields["change"], self.task, other)
            elif not change:
                raise InputError(key, dict(fields), "lacks change")
            true, believed = describe(self.task, change, self.words)
            texts = fields.get("message", true), fields.get("belief", believed)
            for field, text in zip(("message", "belief"), texts, strict=True):
                sentence(f"{key}.{field}", text)
            # Plain values: they identify the models of a type.
            plain = [
                f"{' '.join(item).strip()}: {value}"
                if value is None or isinstance(value, float | str)
                else f"{' '.join(item).strip()}: True"
                for item, value in change.items()
            ]
            yield Parameter(str(fact), [], plain, *texts), change

    def model(self, values: Mapping[str, Any]) -> GoalTask:
        """Returns the task of a person who believes these values.

        Raises:
            InputError: a value is neither the robot's nor the inaccurate one.
        """
        for parameter in self.parameters:
            if values[parameter.name] not in (parameter.accurate, parameter.inaccurate):
                key = f"domain.facts.{parameter.name}"
                allowed = "the change in the configuration, or none"
                raise InputError(key, values[parameter.name], allowed)
        wrong = (values[parameter.name] == parameter.inaccurate for parameter in self.parameters)
        return self._model(frozenset(np.flatnonzero([*wrong]).tolist()))

    def _read_patterns(self, name: object, given: Any) -> Condition:
        """Reads the patterns of a feature. Returns their variables, and one literal for each
        pattern."""
        key, patterns = f"domain.features.{name}", [given] if isinstance(given, str) else given
        if not isinstance(patterns, Sequence) or not patterns:
            raise InputError(key, given, "an atom such as (on ?x b), or a list of them")
        variables = sorted(set(re.findall(r"\?[^\s()?]+", str(patterns).lower())))
        typed = tuple((variable, "object") for variable in variables)
        sources = [Source(key, pattern, str(pattern).lower()) for pattern in patterns]
        return typed, [read_text(self.task, typed, source) for source in sources]

    def _find_starts(self, starts: object, robot: GoalTask) -> NDArray[np.int64]:
        """Finds the start states of traces, as the class describes ``starts``."""
        steps = (
            {"initial": 0, "reachable": np.inf}.get(starts) if isinstance(starts, str) else starts
        )
        if isinstance(steps, bool) or not isinstance(steps, (int, float)) or steps < 0:
            raise InputError("domain.starts", starts, "initial, reachable, or a number of actions")
        near = robot.steps_from(0) <= min(steps, robot.n_states)
        found = np.flatnonzero(near & np.isfinite(robot.to_go) & ~robot.terminal)
        if not len(found):
            raise InputError("domain.starts", starts, "a state where the goal does not hold yet")
        return found

    def _try_facts(self, robot: GoalTask) -> None:
        """Warns of facts that change no label of the robot's transitions, alone or with other
        facts.

        Raises:
            InputError: people who believe one fact incorrectly have no plan.
        """
        for j, parameter in enumerate(self.parameters):
            try:
                self._model(frozenset({j})).require_solution(
                    f"somebody who believes {parameter.name}"
                )
            except DomainError as error:
                key = f"domain.facts.{parameter.name}"
                raise InputError(key, parameter.inaccurate, str(error)) from None
        transitions, n = robot.on_policy(self.starts), len(self.parameters)
        # Caches labels, not models, because models are large.
        labels = cache(lambda wrong: self._beliefs.model(wrong).labels(transitions).tobytes())
        silent = everything = frozenset(range(n))
        small = chain.from_iterable(combinations(range(n), size) for size in range(n + 1))
        for wrong in map(frozenset, chain([(), everything], islice(small, COMBINATIONS))):
            silent -= {j for j in silent if labels(wrong) != labels(wrong ^ {j})}
            if not silent:
                break
        for j in sorted(silent):
            log.warning(
                "domain.facts.%s has no effect: people who believe it find the same best plans "
                "explicable",
                self.parameters[j].name,
            )

    def describe(self, transition: NDArray[np.int64]) -> str:
        """Describes the action and its arguments: "pick up block a"."""
        name, *arguments = self._beliefs.actions[int(transition[1])]
        return self.words.act(name, arguments)

    def changes(self, transition: NDArray[np.int64]) -> tuple[str, ...]:
        """Describes the effects of a transition: "now holding a", "no longer clear a"."""
        return self.words.changes(*(self._list_atoms(int(state)) for state in transition[[0, 2]]))

    def state(self, number: int) -> tuple[str, ...]:
        """Returns the atoms that hold in a state, in PDDL. Atoms that no action can change are left
        out."""
        return tuple(f"({' '.join(atom)})" for atom in self._list_atoms(number))

    def _list_atoms(self, state: int) -> list[tuple[str, ...]]:
        return [self._beliefs.atoms[i] for i in np.flatnonzero(self._beliefs.table[state])]

    def position(self, state: int) -> None:
        """Returns None: the domain has no map."""

    @property
    def scene(self) -> None:
        """None: the domain has no map."""
        return None


def _read_join(fields: Any) -> list[str]:
    """Reads the field ``join`` of a fact: one name, or a list of names, of differences between the
    robot's task and people's belief. Returns the names as a list; [] without this field.

    Args:
        fields: the fact's fields from the configuration.
    """
    given = fields.get("join", []) if isinstance(fields, Mapping) else []
    return list(given) if isinstance(given, list) else [given]
